"""The kept checkpoints of a run put to the same test: how fast each of them is, and how often it arrives."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepracer_exp.errors import BadInput
from deepracer_exp.formats.checkpoint_files import LINKS, kept_checkpoints, pinned
from deepracer_exp.formats.run_result import CRITERIA

from .checkpoint import check, read_policy
from .evaluator import Evaluator
from .result import HELD_OUT, USUAL, Evaluation, Group, Metric, Rank
from .run import StoredRun


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What the laps of a checkpoint come to; on several tracks times are means over the tracks.

    Times are in seconds, None where there is no complete lap (on one of the tracks).
    """

    lap_share: float
    """Complete laps per lap tried on the usual conditions."""
    lap_share_interval: tuple[float, float] | None
    """By bootstrap over the trials."""
    completion: float
    """Per cent of the lap, mean over the laps tried on the usual conditions."""
    held_out_lap_share: float | None
    """None: nobody drove on held-out conditions, as for the two below."""
    held_out_completion: float | None
    held_out_lap_time_p25_s: float | None
    lap_time_p25_s: float | None
    """A quarter of the complete laps are faster."""
    lap_time_median_s: float | None
    lap_time_best_s: float | None
    race_score_s: float | None
    """Seconds per complete lap on all conditions, failed laps included."""
    rank: Rank
    """By the run's own criterion, higher is better."""


@dataclass(frozen=True, kw_only=True)
class Standing:
    """A checkpoint, and how it did."""

    name: str
    labels: tuple[str, ...]
    """`best` and `last`, if it is."""
    pinned: tuple[str, ...]
    """Why nobody may remove it."""
    counters: dict[str, Any]
    """Iteration, env steps and the like; nothing if it is torn."""
    figures: Figures | None
    """None: it cannot be used."""
    fault: str | None
    """Why not."""


@dataclass(frozen=True)
class Recommendation:
    """The checkpoint to race with."""

    name: str
    why: str


def standings(run: StoredRun, evaluator: Evaluator, on_next: Callable[[str], None]) -> Iterator[Standing]:
    """Let every kept checkpoint of a run drive the evaluator's trials, the oldest first.

    Args:
        run: where they are.
        evaluator: gives each of them the same trials.
        on_next: called with the name of a checkpoint before it drives.

    Raises:
        RunFailed: a car's state became NaN.
    """
    folder = run.checkpoints
    pins = pinned(folder)
    leads_to = {label: (folder / label).resolve() for label in LINKS if (folder / label).is_symlink()}
    for path in reversed(kept_checkpoints(folder)):
        on_next(path.name)
        counters, figures, fault = {}, None, None
        try:
            stored = read_policy(run.experiment, check(path))
            evaluation = evaluator(stored.networks.policy)
            counters, figures = stored.counters, figures_of(evaluation, run.experiment.checkpoints.metric)
        except BadInput as error:
            fault = str(error).removeprefix(f"{path.resolve()}: ")
        yield Standing(
            name=path.name,
            labels=tuple(label for label, target in leads_to.items() if target == path.resolve()),
            pinned=tuple(pins.get(path.name, ())),
            counters=counters,
            figures=figures,
            fault=fault,
        )


def figures_of(evaluation: Evaluation, metric: Metric) -> Figures:
    """Sum up an evaluation.

    Args:
        evaluation: of one policy.
        metric: what it is ranked by.
    """
    usual = evaluation.on(USUAL)
    held_out = evaluation.on(HELD_OUT) if HELD_OUT in evaluation.conditions else None
    share = usual.statistics()["lap_share"]

    def times(what: Callable[[Group], float | None], condition: str = USUAL) -> float | None:
        groups = [group for group in evaluation.groups if group.condition == condition]
        found = [time for time in map(what, groups) if time is not None]
        return float(np.mean(found)) if found and len(found) == len(groups) else None

    return Figures(
        lap_share=share["mean"],
        lap_share_interval=share["interval"],
        completion=usual.completion,
        held_out_lap_share=None if held_out is None else held_out.statistics()["lap_share"]["mean"],
        held_out_completion=None if held_out is None else held_out.completion,
        held_out_lap_time_p25_s=times(_percentile(25), HELD_OUT),
        lap_time_p25_s=times(_percentile(25)),
        lap_time_median_s=times(_percentile(50)),
        lap_time_best_s=times(_percentile(0)),
        race_score_s=evaluation.race_score_s,
        rank=evaluation.rank(metric),
    )


def recommend(standings: Sequence[Standing], metric: Metric) -> Recommendation | None:
    """Return the checkpoint that is the best by the run's own criterion, `Evaluation.rank`; None: all are torn.

    In the trials of the training it is the run's `best`: all that are kept were evaluated in these. Of equals it is
    the oldest, as there.

    Args:
        standings: the oldest first.
        metric: what the run's evaluations are ranked by.
    """
    driven = [(one, one.figures) for one in standings if one.figures is not None]
    if not driven:
        return None
    ranked = sorted(driven, key=lambda pair: pair[1].rank, reverse=True)
    (best, found), *others = ranked
    why = f"best by {CRITERIA[metric]}: {_words(found)}"
    if others:
        why += f"; next is {others[0][0].name}: {_words(others[0][1])}"
    marked = next((pair for pair in driven if "best" in pair[0].labels), None)
    if marked is not None and marked[0] is not best:
        why += f"; `best`, chosen in the trials of the training, is {marked[0].name}: {_words(marked[1])}"
    return Recommendation(best.name, why)


def _words(found: Figures) -> str:
    score = "no complete lap" if found.race_score_s is None else f"race score {found.race_score_s:.2f} s"
    return f"{score}, completion {found.completion:.1f} %"


def _percentile(percent: int) -> Callable[[Group], float | None]:
    def of(group: Group) -> float | None:
        times = group.lap_times_s
        return float(np.percentile(times, percent)) if len(times) else None

    return of
