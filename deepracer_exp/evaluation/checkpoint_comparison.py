"""Compare the checkpoints of a run under one race protocol, and recommend one to race with."""

import json
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from rich.console import Console
from rich.table import Table

from deepracer_exp.analysis.charts.runs import speed_and_stability
from deepracer_exp.analysis.page import write_chart
from deepracer_exp.config.evaluation import EvaluateConfig, EvaluationConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.files import atomic_write
from deepracer_exp.runs.checkpoint_files import LINKS, kept_checkpoints, pinned
from deepracer_exp.runs.read_checkpoint import check, read_policy
from deepracer_exp.runs.resolve import StoredRun, resolve
from deepracer_exp.runs.result import CRITERIA

from .evaluate import NOTHING
from .evaluator import Evaluator
from .result import CONFIDENCE, HELD_OUT, USUAL, Evaluation, Group, Metric, Rank


@dataclass(frozen=True, kw_only=True)
class LapStatistics:
    """Lap statistics of a checkpoint; on several tracks times are means over the tracks.

    Times are in seconds, None if a track has no complete lap.
    """

    lap_share: float
    """Complete laps per lap tried on the usual conditions."""
    lap_share_interval: tuple[float, float] | None
    """By bootstrap over the trials."""
    completion: float
    """Per cent of the lap, mean over the laps tried on the usual conditions."""
    held_out_lap_share: float | None
    """None without held-out conditions, like the two below."""
    held_out_completion: float | None
    held_out_lap_time_p25_s: float | None
    lap_time_p25_s: float | None
    """A quarter of the complete laps are faster."""
    lap_time_median_s: float | None
    lap_time_best_s: float | None
    race_score_s: float | None
    """Seconds per complete lap on all conditions, failed laps included."""
    rank: Rank
    """By the run's own metric, higher is better."""


@dataclass(frozen=True, kw_only=True)
class CheckpointResult:
    """A checkpoint and its results."""

    name: str
    labels: tuple[str, ...]
    """`best` and `last`, if it is."""
    pinned: tuple[str, ...]
    """Reasons why it must not be removed."""
    counters: dict[str, Any]
    """Iteration, env steps and the like; empty if it is corrupt."""
    figures: LapStatistics | None
    """None if it cannot be used."""
    fault: str | None
    """The reason why it cannot be used."""


@dataclass(frozen=True)
class Recommendation:
    """The checkpoint to race with, and why."""

    name: str
    why: str


def compare_checkpoints(
    run: StoredRun, evaluator: Evaluator, on_next: Callable[[str], None]
) -> Iterator[CheckpointResult]:
    """Evaluate every kept checkpoint of a run on the same trials, the oldest first.

    Args:
        run: of the checkpoints.
        evaluator: of the trials.
        on_next: called with the name of each checkpoint before it drives.

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
            counters, figures = stored.counters, lap_statistics(evaluation, run.experiment.checkpoints.metric)
        except BadInput as error:
            fault = str(error).removeprefix(f"{path.resolve()}: ")
        yield CheckpointResult(
            name=path.name,
            labels=tuple(label for label, target in leads_to.items() if target == path.resolve()),
            pinned=tuple(pins.get(path.name, ())),
            counters=counters,
            figures=figures,
            fault=fault,
        )


def lap_statistics(evaluation: Evaluation, metric: Metric) -> LapStatistics:
    """Summarise an evaluation.

    Args:
        evaluation: of one policy.
        metric: that it is ranked by.
    """
    usual = evaluation.on(USUAL)
    held_out = evaluation.on(HELD_OUT) if HELD_OUT in evaluation.conditions else None
    share = usual.statistics()["lap_share"]

    def times(what: Callable[[Group], float | None], condition: str = USUAL) -> float | None:
        groups = [group for group in evaluation.groups if group.condition == condition]
        found = [time for time in map(what, groups) if time is not None]
        return float(np.mean(found)) if found and len(found) == len(groups) else None

    return LapStatistics(
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


def recommend(results: Sequence[CheckpointResult], metric: Metric) -> Recommendation | None:
    """Return the best checkpoint by the run's own metric, `Evaluation.rank`; None if none can be used.

    On the trials of the training it is the run's own `best`. Ties go to the oldest, as in the training.

    Args:
        results: the oldest first.
        metric: that the run's evaluations are ranked by.
    """
    driven = [(one, one.figures) for one in results if one.figures is not None]
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


def _words(found: LapStatistics) -> str:
    score = "no complete lap" if found.race_score_s is None else f"race score {found.race_score_s:.2f} s"
    return f"{score}, completion {found.completion:.1f} %"


def _percentile(percent: int) -> Callable[[Group], float | None]:
    def of(group: Group) -> float | None:
        times = group.lap_times_s
        return float(np.percentile(times, percent)) if len(times) else None

    return of


_MINOR = ("median", "score s")
_HELD_OUT = "held-out\ndone %"
_LABELS = "kept as"
_NAMES = ("steps", _LABELS, "laps %", "done %", _HELD_OUT, "p25 s", "median", "best", "score s")


def comparison_table(
    results: Sequence[CheckpointResult], chosen: Recommendation | None, console: Console
) -> Table:
    """Return the comparison as a table, one row per checkpoint, with as many columns as the console fits.

    Args:
        results: the oldest first.
        chosen: the highlighted row.
        console: on which it will be printed.
    """
    hidden = set() if any(_of_held_out(one) is not None for one in results) else {_HELD_OUT}
    endless = console.options.update(max_width=10_000)
    for intervals, left_out in ((True, hidden), (True, hidden.union(_MINOR)), (False, hidden.union(_MINOR))):
        shown = Table(box=None, pad_edge=False)
        names = [name for name in _NAMES if name not in left_out]
        shown.add_column("checkpoint", no_wrap=True)
        for name in names:
            shown.add_column(name, no_wrap=True, justify="left" if name == _LABELS else "right")
        for one in results:
            cells = _cells(one, intervals)
            best = chosen is not None and one.name == chosen.name
            style = "bold green" if best else "dim" if one.figures is None else ""
            shown.add_row(one.name, *(cells[name] for name in names), style=style)
        if console.measure(shown, options=endless).maximum <= console.width:
            break
    return shown


def legend(results: Sequence[CheckpointResult]) -> str:
    """Return the explanation of the table's columns."""
    held_out = any(_of_held_out(one) is not None for one in results)
    return "; ".join(
        [
            f"laps: share of complete laps, with its {CONFIDENCE:.0%} interval in brackets",
            "done: completion, the mean share of the lap driven",
            *["held-out done: the same on held-out conditions"] * held_out,
            "p25: a quarter of the laps are faster",
            "score: race score, seconds per complete lap on all conditions, including failed laps",
        ]
    )


def notes(results: Sequence[CheckpointResult], chosen: Recommendation | None) -> list[str]:
    """Return one line for each corrupt or pinned checkpoint, and one for the recommendation."""
    lines = [f"{one.name} is left out: {one.fault}" for one in results if one.fault is not None]
    lines += [f"{one.name} is pinned: {', '.join(one.pinned)}" for one in results if one.pinned]
    if chosen is not None:
        lines.append(f"recommended: {chosen.name}: {chosen.why}")
    return lines


def write_comparison(
    file: Path,
    run: Path,
    config: EvaluationConfig,
    results: Sequence[CheckpointResult],
    chosen: Recommendation | None,
) -> None:
    """Write the comparison and its protocol as JSON.

    Raises:
        OSError: the file cannot be written.
    """
    content = {
        "run": str(run),
        "evaluation": asdict(config),
        "checkpoints": [asdict(one) for one in results],
        "recommended": None if chosen is None else asdict(chosen),
    }
    atomic_write(file, json.dumps(content, indent=2) + "\n")


def _of_held_out(one: CheckpointResult) -> float | None:
    return None if one.figures is None else one.figures.held_out_completion


def _cells(one: CheckpointResult, intervals: bool) -> dict[str, str]:
    """Return a checkpoint's cells by column."""
    labels = [*one.labels, *["pinned"] * bool(one.pinned), *["bad"] * (one.figures is None)]
    found = one.figures
    if found is None:
        return {name: NOTHING for name in _NAMES} | {_LABELS: ", ".join(labels)}
    return {
        "steps": f"{one.counters['env_steps']:,}",
        _LABELS: ", ".join(labels),
        "laps %": _share(found, intervals),
        "done %": f"{found.completion:.1f}",
        _HELD_OUT: NOTHING if found.held_out_completion is None else f"{found.held_out_completion:.1f}",
        "p25 s": _seconds(found.lap_time_p25_s),
        "median": _seconds(found.lap_time_median_s),
        "best": _seconds(found.lap_time_best_s),
        "score s": _seconds(found.race_score_s),
    }


def _share(found: LapStatistics, intervals: bool) -> str:
    share = f"{100 * found.lap_share:.0f}"
    if found.lap_share_interval is None or not intervals:
        return share
    low, high = (f"{100 * bound:.0f}" for bound in found.lap_share_interval)
    return share if low == high else f"{share} ({low}\N{EN DASH}{high})"


def _seconds(time: float | None) -> str:
    return NOTHING if time is None else f"{time:.2f}"


logger = logging.getLogger("deepracer_exp")


def show_checkpoints(
    config: EvaluateConfig,
    own_trials: bool,
    picture: str | None,
    file: str | None,
    out: Console,
    err: Console,
) -> Recommendation:
    """Evaluate a run's checkpoints under a protocol, print the comparison and recommend one.

    Args:
        config: validated; its checkpoint is ignored.
        own_trials: use the trials of the training instead of those of `config`.
        picture: picture file; None: no picture.
        file: JSON file to write; None: none.
        out: for results.
        err: for progress.

    Raises:
        BadInput: the run, all its checkpoints, a track or a condition cannot be used, or a file cannot be written.
        RunFailed: a car's state became NaN.
    """
    run = resolve(config.run, Path(config.runs_dir), config.tracking.uri)
    kept = kept_checkpoints(run.checkpoints)
    if not kept:
        raise BadInput(f"{run.checkpoints}: contains no checkpoint")
    for link in (run.checkpoints / label for label in LINKS):
        if link.is_symlink() and not link.exists():
            logger.warning("%s is a broken link", link)
    torch.set_num_threads(1)
    protocol = run.experiment.evaluation if own_trials else config.evaluation
    evaluator = Evaluator(run.experiment, protocol)
    err.print(
        f"{run.path.name}: {len(kept)} checkpoint{'s' * (len(kept) > 1)}, {len(evaluator.trials)} trials each",
        soft_wrap=True,
    )
    with err.status("") as status:
        found = list(compare_checkpoints(run, evaluator, lambda name: status.update(f"{name} drives")))
    chosen = recommend(found, run.experiment.checkpoints.metric)
    if chosen is None:
        raise BadInput(f"{found[-1].fault}; no checkpoint in {run.checkpoints} can be used")
    out.print(comparison_table(found, chosen, out))
    out.print(legend(found), style="dim", soft_wrap=not out.is_terminal)
    out.print()
    for line in notes(found, chosen):
        # Lines are wrapped for a terminal, but not for a pipe, whose lines are searched.
        out.print(line, soft_wrap=not out.is_terminal)
    out.print(f"  use it with checkpoint={chosen.name} in evaluate, export and clone")
    try:
        if file is not None:
            write_comparison(Path(file), run.path, protocol, found, chosen)
        if picture is not None:
            rows = [_row(one, one.figures) for one in found if one.figures is not None]
            chart = speed_and_stability(run.path.name, pd.DataFrame(rows), chosen.name)
            write_chart(Path(picture), chart)
            out.print(f"\n{picture}: speed against stability", soft_wrap=True)
    except (OSError, ValueError) as error:
        raise BadInput(f"{picture if file is None else file}: cannot be written: {error}") from error
    return chosen


def _row(one: CheckpointResult, found: LapStatistics) -> dict[str, Any]:
    """Return a checkpoint as `speed_and_stability` takes it."""
    low, high = found.lap_share_interval or (found.lap_share, found.lap_share)
    held_out = found.held_out_lap_share
    return {
        "name": one.name,
        "labels": ", ".join([*one.labels, *["pinned"] * bool(one.pinned)]),
        "lap_time_s": _or_nan(found.lap_time_p25_s),
        "complete": 100 * found.lap_share,
        "low": 100 * low,
        "high": 100 * high,
        "held_out_lap_time_s": _or_nan(found.held_out_lap_time_p25_s),
        "held_out_complete": math.nan if held_out is None else 100 * held_out,
    }


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
