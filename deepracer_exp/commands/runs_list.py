"""`deepracer-exp runs`: the runs there are, with their state and results."""

import argparse
import datetime
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepracer_exp.errors import BadInput
from deepracer_exp.runs.files import CONFIG, SUMMARY

from .arguments import read_stores
from .output import table_console

_NONE = "\N{EN DASH}"
_STAMP = len("20260101-120000")


@dataclass(frozen=True)
class _Run:
    """A line of the list."""

    name: str
    """EXPERIMENT/FOLDER, which commands accept as RUN."""
    began_s: float
    """Unix time."""
    state: str
    summary: dict[str, Any]


def list_runs(args: argparse.Namespace) -> int:
    """Print the runs of `runs_dir`, newest first."""
    from rich.table import Table

    runs_dir = read_stores(args.overrides).runs_dir
    if not runs_dir.is_dir():
        raise BadInput(f"runs_dir={runs_dir}: is not a folder; `deepracer-exp train` creates it")
    folders = [file.parent for file in runs_dir.glob(f"*/*/{CONFIG}")]
    if not folders:
        print(f"no runs in {runs_dir}")
        return 0
    table = Table("run", "state", box=None, pad_edge=False, header_style="dim")
    table.columns[0].overflow = "fold"
    for name in ("score (s)", "laps", "best lap (s)", "age"):
        table.add_column(name, justify="right")
    now_s = time.time()
    for run in sorted(map(_read, folders), key=lambda run: (run.began_s, run.name), reverse=True):
        best = run.summary.get("best") or {}
        table.add_row(
            run.name,
            run.state,
            _number(best.get("eval_race_score_s"), ".2f"),
            _number(run.summary.get("laps"), ",.0f"),
            _number(run.summary.get("best_lap_time_s"), ".2f"),
            _age(now_s - run.began_s),
        )
    table_console().print(table)
    return 0


def _read(folder: Path) -> _Run:
    from deepracer_exp.runs.files import read_object

    name = f"{folder.parent.name}/{folder.name}"
    try:
        summary = read_object(folder / SUMMARY)
        state = str(summary["status"]) if "status" in summary else _state_without_end(folder)
    except BadInput:  # one damaged run does not hide the others
        summary, state = {}, "unreadable"
    return _Run(name, _began_s(folder), state, summary)


def _state_without_end(folder: Path) -> str:
    from deepracer_exp.runs.folder import is_held

    return "running" if is_held(folder) else "killed"


def _began_s(folder: Path) -> float:
    """Return when a run began: its folder's name says so, unless it was renamed."""
    try:
        return datetime.datetime.strptime(folder.name[:_STAMP], "%Y%m%d-%H%M%S").timestamp()
    except ValueError:
        return (folder / CONFIG).stat().st_mtime


def _number(value: Any, form: str) -> str:
    known = isinstance(value, int | float) and math.isfinite(value)
    return format(value, form) if known else _NONE


def _age(seconds: float) -> str:
    """Return an age in its largest unit: ``40 s``, ``12 min``, ``5 h``, ``3 d``."""
    for unit, length_s in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= length_s:
            return f"{seconds // length_s:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
