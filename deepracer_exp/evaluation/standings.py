"""The kept checkpoints of a run put to the same test: how fast each of them is, and how often it arrives."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepracer_exp.errors import BadInput
from deepracer_exp.formats.checkpoint_files import pinned

from .checkpoint import LINKS, check, kept_checkpoints, read_policy
from .evaluator import Evaluator
from .result import HELD_OUT, USUAL, Evaluation, Group
from .run import StoredRun

TOLERANCE = 0.05
"""Share of complete laps that a faster checkpoint may lose to the surest one: one lap in twenty."""
_SAME_S = 2
"""Decimals of a lap time beyond which nobody is faster."""


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
    """Seconds per complete lap, failed laps included."""


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
            counters, figures = stored.counters, figures_of(evaluator(stored.networks.policy))
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


def figures_of(evaluation: Evaluation) -> Figures:
    """Sum up an evaluation."""
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
        race_score_s=times(lambda group: group.race_score_s),
    )


def recommend(standings: Sequence[Standing]) -> Recommendation | None:
    """Return the fastest of the checkpoints that arrive about as often as the surest one; None: all are torn.

    A race is lost off the track: a lap that is not completed costs more than a fast one wins. But single laps of
    twenty are chance, so that within `TOLERANCE` of the best share the 25th percentile of the lap times decides: it
    is what a policy drives on a good lap, and unlike the best lap no single stroke of luck.
    """
    driven = {one.name: one.figures for one in standings if one.figures is not None}
    if not driven:
        return None
    timed = {name: found for name, found in driven.items() if found.lap_time_p25_s is not None}
    if not timed:
        name = max(reversed(driven), key=lambda name: driven[name].completion)
        part = f"{driven[name].completion:.0f}%"
        return Recommendation(
            name, f"no checkpoint completes a lap; this one drives {part} of it, on average"
        )
    surest = max(timed.values(), key=lambda found: found.lap_share)
    sure = [n for n, found in timed.items() if found.lap_share >= surest.lap_share - TOLERANCE - 1e-9]
    name = min(reversed(sure), key=lambda name: _order(timed[name]))
    return Recommendation(name, "; ".join(_reasons(name, timed)))


def _reasons(name: str, timed: dict[str, Figures]) -> Iterator[str]:
    chosen = timed[name]
    yield f"{_laps(chosen)} complete laps, 25th percentile {_p25_s(chosen):.2f} s"
    fastest = min(timed, key=lambda other: _order(timed[other]))
    gain_s = _p25_s(chosen) - _p25_s(timed[fastest])
    if round(gain_s, _SAME_S) > 0:
        yield f"{fastest} is {gain_s:.2f} s faster but completes only {_laps(timed[fastest])}"
    surest = max(timed, key=lambda other: (timed[other].lap_share, -_p25_s(timed[other])))
    loss_s = _p25_s(timed[surest]) - _p25_s(chosen)
    if timed[surest].lap_share > chosen.lap_share:
        yield f"{surest} completes {_laps(timed[surest])} but is {loss_s:.2f} s slower"
    steadiest = max(timed, key=lambda other: timed[other].held_out_lap_share or 0.0)
    own, held_out = chosen.held_out_lap_share, timed[steadiest].held_out_lap_share
    if own is not None and held_out is not None and held_out > own + TOLERANCE + 1e-9:
        yield f"on held-out conditions {steadiest} completes {held_out:.0%} and this one {own:.0%}"


def _order(found: Figures) -> tuple[float, ...]:
    return round(_p25_s(found), _SAME_S), -found.lap_share, -(found.held_out_completion or 0.0)


def _p25_s(found: Figures) -> float:
    assert found.lap_time_p25_s is not None
    return found.lap_time_p25_s


def _percentile(percent: int) -> Callable[[Group], float | None]:
    def of(group: Group) -> float | None:
        times = group.lap_times_s
        return float(np.percentile(times, percent)) if len(times) else None

    return of


def _laps(found: Figures) -> str:
    return f"{found.lap_share:.0%}"
