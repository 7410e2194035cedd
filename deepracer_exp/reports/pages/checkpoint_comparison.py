"""Compare the checkpoints of a run under one race protocol, and recommend one to race with."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich.console import Console
from rich.table import Table

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.errors import BadInput, count, writing
from deepracer_exp.evaluation.evaluator import Evaluator, evaluator_against
from deepracer_exp.evaluation.results import (
    CONFIDENCE,
    HELD_OUT,
    NOTHING,
    USUAL,
    Evaluation,
    Metric,
    Rank,
    number,
)
from deepracer_exp.evaluation.run_evaluation import fit
from deepracer_exp.reports.charts.run_charts import evaluated_laps, speed_and_stability
from deepracer_exp.reports.tables.log_tables import Table as PageTable
from deepracer_exp.runs.checkpoint_files import (
    LINKS,
    checkpoint_number,
    checkpoint_words,
    kept_checkpoints,
    pinned,
)
from deepracer_exp.runs.checkpoints import check, read_policy
from deepracer_exp.runs.run_result import BOTH, CRITERIA, of_conditions
from deepracer_exp.runs.stored_run import StoredRun

from .comparison_page import write_comparison

logger = logging.getLogger("deepracer_exp")

_MINOR = ("median", "score s")
_HELD_OUT = "held-out\ndone %"
_LABELS = "kept as"
_NAMES = ("steps", _LABELS, "laps %", "done %", _HELD_OUT, "p25 s", "median", "best", "score s")


@dataclass(frozen=True, kw_only=True)
class LapStatistics:
    """Lap statistics of a checkpoint; on several tracks times are means over the tracks.

    Times are in seconds, NaN if a track has no complete lap; all figures of held-out conditions are NaN without these.
    """

    complete: float
    """Complete laps per lap tried on the usual conditions, per cent."""
    low: float
    """Interval of the share by bootstrap over the trials; the share itself where there is none."""
    high: float
    completion: float
    """Per cent of the lap, mean over the laps tried on the usual conditions."""
    lap_time_s: float
    """A quarter of the complete laps are faster."""
    median_s: float
    best_s: float
    laps_s: tuple[float, ...]
    """Times of all complete laps on the usual conditions, in the order of the trials; none on several tracks."""
    held_out_complete: float
    held_out_completion: float
    held_out_lap_time_s: float
    race_score_s: float | None
    """Seconds per complete lap on usual and held-out conditions together, failed laps included."""
    rank: Rank
    """By the run's own metric, higher is better."""


@dataclass(frozen=True, kw_only=True)
class CheckpointResult:
    """A checkpoint and its results."""

    name: str
    labels: tuple[str, ...]
    """`best`, `last` and `fastest`, if it is."""
    pinned: tuple[str, ...]
    """Reasons why it must not be removed."""
    env_steps: int | None
    """None if it is corrupt."""
    figures: LapStatistics | None
    """None if it cannot be used."""
    fault: str | None
    """The reason why it cannot be used."""


def compare_checkpoints(
    run: StoredRun, evaluator: Evaluator, on_next: Callable[[str], None]
) -> Iterator[CheckpointResult]:
    """Evaluate every kept checkpoint of a run on the same trials, the oldest first.

    Raises:
        RunFailed: a car's state became NaN.
    """
    folder = run.checkpoints
    pins = pinned(folder)
    leads_to = {label: (folder / label).resolve() for label in LINKS if (folder / label).is_symlink()}
    for path in reversed(kept_checkpoints(folder)):
        on_next(checkpoint_words(path.name))
        env_steps, figures, fault = None, None, None
        try:
            stored = read_policy(run.experiment, check(path))
            evaluation = evaluator(stored.networks.policy)
            env_steps = stored.counters["env_steps"]
            figures = lap_statistics(evaluation, run.experiment.checkpoints.metric)
        except BadInput as error:
            fault = error.without(path.resolve())
        yield CheckpointResult(
            name=checkpoint_number(path.name),
            labels=tuple(label for label, target in leads_to.items() if target == path.resolve()),
            pinned=tuple(pins.get(path.name, ())),
            env_steps=env_steps,
            figures=figures,
            fault=fault,
        )


def lap_statistics(evaluation: Evaluation, metric: Metric) -> LapStatistics:
    """Summarise an evaluation."""
    usual = evaluation.on(USUAL)
    held_out = evaluation.on(HELD_OUT) if HELD_OUT in evaluation.conditions else None
    share = usual.statistics()["lap_share"]
    low, high = share["interval"] or (share["mean"], share["mean"])

    def time_s(percent: int, condition: str = USUAL) -> float:
        groups = [group for group in evaluation.groups if group.condition == condition]
        times = [group.lap_times_s for group in groups]
        times_s = [np.percentile(some, percent) if len(some) else math.nan for some in times]
        return float(np.mean(times_s)) if times_s else math.nan

    return LapStatistics(
        complete=100 * share["mean"],
        low=100 * low,
        high=100 * high,
        completion=usual.completion,
        lap_time_s=time_s(25),
        median_s=time_s(50),
        best_s=time_s(0),
        laps_s=tuple(usual.lap_times_s.tolist()) if len(evaluation.tracks) == 1 else (),
        held_out_complete=math.nan if held_out is None else 100 * held_out.lap_share,
        held_out_completion=math.nan if held_out is None else held_out.completion,
        held_out_lap_time_s=time_s(25, HELD_OUT),
        race_score_s=evaluation.race_score_s,
        rank=evaluation.rank(metric),
    )


def recommend(results: Sequence[CheckpointResult], metric: Metric) -> tuple[str, str] | None:
    """Return the best checkpoint by the run's own metric, and why; None if none can be used.

    On the trials of the training it is the run's own `best`. Ties go to the oldest, as in the training.
    """
    driven = [(result, result.figures) for result in results if result.figures is not None]
    if not driven:
        return None
    (best, statistics), *others = sorted(driven, key=lambda pair: pair[1].rank, reverse=True)
    criterion = of_conditions(CRITERIA[metric], math.isfinite(statistics.held_out_completion))
    why = f"best by {criterion}: {_words(statistics)}"
    if others:
        why += f"; next is checkpoint {others[0][0].name}: {_words(others[0][1])}"
    for marked, of_marked in driven:
        if "best" in marked.labels and marked is not best:
            why += f"; `best`, chosen in the trials of the training, is checkpoint {marked.name}: {_words(of_marked)}"
    return best.name, why


def _words(statistics: LapStatistics) -> str:
    name = of_conditions(BOTH, math.isfinite(statistics.held_out_completion))
    score = (
        "no complete lap" if statistics.race_score_s is None else f"{name} {statistics.race_score_s:.2f} s"
    )
    lap = "" if math.isnan(statistics.median_s) else f", median usual lap {statistics.median_s:.2f} s"
    return f"{score}, usual completion {statistics.completion:.1f}%{lap}"


def comparison_table(results: Sequence[CheckpointResult], chosen: str, console: Console) -> Table:
    """Return the comparison as a table, one row per checkpoint, with as many columns as the console fits."""

    def lay_out(intervals: bool, left_out: Sequence[str]) -> Table:
        shown = Table(box=None, pad_edge=False)
        names = [name for name in _NAMES if name not in left_out]
        for name in ("checkpoint", *names):
            shown.add_column(
                name, no_wrap=True, justify="left" if name in ("checkpoint", _LABELS) else "right"
            )
        for result in results:
            cells = _cells(result, intervals)
            style = "bold green" if result.name == chosen else "dim" if result.figures is None else ""
            shown.add_row(result.name, *(cells[name] for name in names), style=style)
        return shown

    return fit(console, lay_out, () if _has_held_out(results) else (_HELD_OUT,), _MINOR)


def _has_held_out(results: Sequence[CheckpointResult]) -> bool:
    return any(
        result.figures is not None and math.isfinite(result.figures.held_out_completion) for result in results
    )


def _labels(result: CheckpointResult) -> list[str]:
    return [*result.labels, *["pinned"] * bool(result.pinned), *["bad"] * (result.figures is None)]


def _cells(result: CheckpointResult, intervals: bool) -> dict[str, str]:
    """Return a checkpoint's cells by column."""
    labels, figures = _labels(result), result.figures
    if figures is None:
        return {name: NOTHING for name in _NAMES} | {_LABELS: ", ".join(labels)}
    share = f"{figures.complete:.0f}"
    if intervals and figures.low < figures.high:
        share += f" ({figures.low:.0f}\N{EN DASH}{figures.high:.0f})"
    return {
        "steps": f"{result.env_steps:,}",
        _LABELS: ", ".join(labels),
        "laps %": share,
        "done %": number(figures.completion, 1),
        _HELD_OUT: number(figures.held_out_completion, 1),
        "p25 s": number(figures.lap_time_s, 2),
        "median": number(figures.median_s, 2),
        "best": number(figures.best_s, 2),
        "score s": number(figures.race_score_s, 2),
    }


def _page_table(results: Sequence[CheckpointResult]) -> PageTable:
    """Return the comparison as the table of a page."""
    names = [name for name in _NAMES if name != _HELD_OUT or _has_held_out(results)]
    # Words before numbers.
    order = [_LABELS, *(name for name in names if name != _LABELS)]
    cells = [(result.name, _cells(result, intervals=True)) for result in results]
    rows = tuple((name, *(columns[column] for column in order)) for name, columns in cells)
    return PageTable(("checkpoint", *(name.replace("\n", " ") for name in order)), rows, 2)


_LEGEND = (
    f"laps: share of complete laps on usual conditions, with its {CONFIDENCE:.0%} interval in brackets",
    "done: completion, the mean share of the lap driven on usual conditions",
    "p25: a quarter of the usual laps are faster",
    "score: race score, seconds per complete lap, usual and held-out laps together, including failed ones",
)


def show_checkpoints(
    run: StoredRun,
    protocol: EvaluationConfig,
    picture: str | None,
    out: Console,
    err: Console,
    rival: StoredRun | None = None,
) -> None:
    """Evaluate a run's checkpoints, print the comparison, recommend one, and draw them on the page `picture`.

    `rival` is as for `evaluator_against`.

    Raises:
        BadInput: all its checkpoints, a track or a condition cannot be used, or a file cannot be written.
        RunFailed: a car's state became NaN.
    """
    kept = kept_checkpoints(run.checkpoints)
    if not kept:
        raise BadInput(run.checkpoints, "contains no checkpoint")
    for link in (run.checkpoints / label for label in LINKS):
        if link.is_symlink() and not link.exists():
            logger.warning("%s is a broken link", link)
    torch.set_num_threads(1)
    evaluator = evaluator_against(rival, run.experiment, protocol)
    err.print(
        f"{run.path.name}: {count(len(kept), 'checkpoint')}, {count(len(evaluator.trials), 'trial')} each",
        soft_wrap=True,
    )
    with err.status("") as status:
        results = list(compare_checkpoints(run, evaluator, lambda name: status.update(f"{name} drives")))
    chosen = recommend(results, run.experiment.checkpoints.metric)
    if chosen is None:
        raise BadInput(f"{results[-1].fault}; no checkpoint in {run.checkpoints} can be used")
    best, why = chosen
    # Lines are wrapped for a terminal, but not for a pipe, whose lines are searched.
    whole = not out.is_terminal
    out.print(comparison_table(results, best, out))
    held_out = ["held-out done: the same on held-out conditions"] * _has_held_out(results)
    out.print("; ".join([*_LEGEND[:2], *held_out, *_LEGEND[2:]]), "", style="dim", soft_wrap=whole)
    for result in results:
        if result.fault is not None:
            out.print(f"checkpoint {result.name} is left out: {result.fault}", soft_wrap=whole)
        if result.pinned:
            out.print(f"checkpoint {result.name} is pinned: {', '.join(result.pinned)}", soft_wrap=whole)
    out.print(f"recommended: checkpoint {best}: {why}", soft_wrap=whole)
    out.print(f"  use it with checkpoint={best} in evaluate, export and clone")
    if picture is not None:
        rows = [
            {**vars(result.figures), "name": result.name, "labels": ", ".join(_labels(result))}
            for result in results
            if result.figures is not None
        ]
        drawn = pd.DataFrame(rows)
        charts = (speed_and_stability(drawn, best), evaluated_laps(drawn))
        legend = "; ".join([*_LEGEND[:2], *held_out, *_LEGEND[2:]])
        with writing(picture):
            write_comparison(
                Path(picture),
                f"Checkpoints of {run.experiment.name}",
                [f"Recommended: checkpoint {best}, {why}.", run.path.name],
                [("Evaluated laps", _page_table(results), f"{legend[0].upper()}{legend[1:]}.")],
                [chart for chart in charts if chart is not None],
            )
        out.print(f"\n{picture}: this table, speed against stability, and all evaluated laps", soft_wrap=True)
