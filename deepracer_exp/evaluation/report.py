"""An evaluation told: a table for people, a JSON file for everything else."""

import datetime
import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.errors import RunFailed
from deepracer_exp.formats.whole_file import write_whole

from .checkpoint import StoredPolicy
from .result import CONFIDENCE, Evaluation

NOTHING = "\N{EN DASH}"
_TIMES = ("lap s", "median", "best", "std", "score s")
_MINOR = ("median", "std", "score s")
_Row = tuple[str, str, dict[str, str]]


def table(
    evaluation: Evaluation, config: EvaluationConfig, trained_on: Container[str], console: Console
) -> Table:
    """Return the evaluation as a table, a line for each track and condition, as full as the console is wide.

    Args:
        evaluation: what was found.
        config: the protocol.
        trained_on: names of the run's own tracks.
        console: where it will be shown.
    """
    unseen = [track for track in evaluation.tracks if track not in trained_on]
    groups = [(f"{group.track}{' *' * (group.track in unseen)}", group) for group in evaluation.groups]
    if len(evaluation.tracks) > 1:
        groups += [("all", evaluation.on(condition)) for condition in evaluation.conditions]
    found = [(label, group.condition.replace("_", " "), group.statistics()) for label, group in groups]
    penalties = any(vars(config.penalty_s).values())
    hidden = (() if config.resets_per_lap else ("resets",)) + (() if penalties else ("penalty s",))
    endless = console.options.update(max_width=10_000)
    for intervals, left_out in ((True, hidden), (True, hidden + _MINOR), (False, hidden + _MINOR)):
        rows = [(label, condition, _cells(numbers, intervals)) for label, condition, numbers in found]
        shown = _lay_out(rows, left_out)
        if console.measure(shown, options=endless).maximum <= console.width:
            break
    notes = [f"in brackets: {CONFIDENCE:.0%} interval of the mean, by bootstrap over the trials"] * intervals
    notes += ["*: not trained on"] * bool(unseen)
    shown.caption, shown.caption_justify = "; ".join(notes), "left"
    return shown


def _lay_out(rows: Sequence[_Row], left_out: Sequence[str]) -> Table:
    names = [name for name in rows[0][2] if name not in left_out]
    shown = Table(box=None, pad_edge=False)
    for name in ("track", "on", *names):
        shown.add_column(name, no_wrap=True, justify="right" if name in names else "left")
    for label, condition, cells in rows:
        whole = label == "all"
        # Laps of different lengths have no mean time.
        texts = [NOTHING if whole and name in _TIMES else cells[name] for name in names]
        shown.add_row(label, condition, *texts, style="bold" * whole)
    return shown


def write_json(folder: Path, evaluation: Evaluation, config: EvaluationConfig, stored: StoredPolicy) -> Path:
    """Write `evaluations/<time>.json` into a run's folder and return it.

    Raises:
        RunFailed: the file cannot be written.
    """
    now = datetime.datetime.now()
    content: dict[str, Any] = {
        "time": now.isoformat(timespec="seconds"),
        "checkpoint": {"name": stored.path.name, **stored.counters},
        "evaluation": asdict(config),
        **evaluation.as_dict(),
    }
    target = folder / "evaluations"
    try:
        target.mkdir(exist_ok=True)
        # Two within a second: neither is lost.
        name = now.strftime("%Y%m%d-%H%M%S-%f")
        return write_whole(target / f"{name}.json", json.dumps(content, indent=2) + "\n")
    except OSError as error:
        raise RunFailed(f"{target}: the evaluation cannot be written: {error.strerror or error}") from error


def _cells(found: Mapping[str, Any], intervals: bool) -> dict[str, str]:
    """Return what is shown of a group's statistics, by column."""
    times = found["lap_time_s"]
    return {
        "laps": f"{found['laps']} of {found['laps_tried']}",
        "done %": _mean(found["completion"], 1, intervals),
        "lap s": _mean(times, 2, intervals),
        "median": _number(times["median"], 2),
        "best": _number(times["best"], 2),
        "std": _number(times["std"], 2),
        "resets": _mean(found["resets"], 1, intervals),
        "penalty s": _mean(found["penalty_s"], 1, intervals),
        "score s": _number(found["race_score_s"], 2),
    }


def _number(value: float | None, digits: int) -> str:
    return NOTHING if value is None else f"{value:.{digits}f}"


def _mean(found: Mapping[str, Any], digits: int, intervals: bool) -> str:
    mean = _number(found["mean"], digits)
    if found["interval"] is None or not intervals:
        return mean
    low, high = (_number(bound, digits) for bound in found["interval"])
    return mean if low == high else f"{mean} ({low}\N{EN DASH}{high})"
