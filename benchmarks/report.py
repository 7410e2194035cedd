"""What all benchmarks share: arguments, exit codes, tables, means, JSON files."""

import argparse
import json
import math
import os
import platform
import statistics
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ttest_1samp

from deepracer_exp.errors import BadInput
from deepracer_exp.reports.tables.evidence import estimate

CONFIDENCE = 0.95


def benchmark_parser(
    name: str, doc: str | None, command: str | None = "train", json: bool = True
) -> argparse.ArgumentParser:
    """Return a parser with --json and, unless `command` is None, overrides for that command of deepracer-exp."""
    parser = argparse.ArgumentParser(
        prog=f"benchmarks.{name}", description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if json:
        parser.add_argument("--json", type=Path, help="also write the figures as JSON to this file")
    if command is not None:
        what = f"as for deepracer-exp {command}"
        parser.add_argument("overrides", nargs="*", metavar="OVERRIDE", help=what)
    return parser


def with_exit_code(main: Callable[[Sequence[str] | None], None]) -> Callable[..., int]:
    """Let a benchmark's `main` print bad input as one line, and return the exit code."""

    @wraps(main)
    def guarded(arguments: Sequence[str] | None = None) -> int:
        try:
            main(arguments)
        except BadInput as error:
            print(error, file=sys.stderr)
            return error.exit_code
        return 0

    return guarded


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with its columns aligned; the first column to the left, the others to the right."""
    widths = [max(3, *(len(line[column]) for line in (head, *rows))) for column in range(len(head))]

    def line(cells: Sequence[str]) -> str:
        padded = [
            cells[0].ljust(widths[0]),
            *(c.rjust(w) for c, w in zip(cells[1:], widths[1:], strict=True)),
        ]
        return f"| {' | '.join(padded)} |"

    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    return "\n".join([line(head), line(rule), *map(line, rows)])


def median(values: Sequence[float | None]) -> float | None:
    """Return the median, where None stands for something that never happened: longer than any number."""
    middle = statistics.median(math.inf if value is None else value for value in values)
    return middle if math.isfinite(middle) else None


def number(value: float | None, digits: int = 0) -> str:
    """Return a number for a table, a dash for None."""
    return "-" if value is None else f"{value:,.{digits}f}"


def percent(share: float | None, digits: int = 0) -> str:
    """Return a share for a table."""
    return "-" if share is None else f"{share:.{digits}%}"


def mean_and_interval(values: Sequence[float | None]) -> dict[str, Any]:
    """Return `mean` and `interval` of the values that are known, for JSON.

    Runs differ by their seeds only, and there are few of them: Student's interval of the mean. It is None with fewer
    than two values, the mean with none.
    """
    known = np.array([value for value in values if value is not None])
    if len(known) < 2:
        return {"mean": round(float(known[0]), 4) if len(known) else None, "interval": None}
    mean = float(known.mean())
    if np.ptp(known) == 0:  # no interval is defined for what does not vary
        return {"mean": round(mean, 4), "interval": [round(mean, 4)] * 2}
    low, high = ttest_1samp(known, 0.0).confidence_interval(CONFIDENCE)
    return {"mean": round(mean, 4), "interval": [round(float(low), 4), round(float(high), 4)]}


def interval_text(figure: dict[str, Any], show: Callable[[float | None], str]) -> str:
    """Return what `mean_and_interval` found, for a table."""
    mean, *ends = map(show, (figure["mean"], *(figure["interval"] or ())))
    return f"{mean} ({' to '.join(ends)})" if ends else mean


def over_seeds(values: Sequence[float | None]) -> dict[str, Any]:
    """Return `seeds`, the values, with what `over_strata` finds of them."""
    return {"seeds": list(values), **over_strata([values])}


def over_strata(strata: Sequence[Sequence[float | None]]) -> dict[str, Any]:
    """Return the `iqm` (interquartile mean) of all values with its bootstrap `interval`, for JSON.

    Args:
        strata: values of the seeds of each track. None is longer than any number; so is null in the mean and the
            interval.
    """
    found = estimate([np.array([math.inf if v is None else v for v in values]) for values in strata])
    ends = None if found.interval is None else [_finite(end) for end in found.interval]
    return {"iqm": _finite(found.iqm), "interval": ends}


def iqm_text(figure: dict[str, Any], show: Callable[[float | None], str]) -> str:
    """Return what `over_strata` found, for a table."""
    middle, *ends = map(show, (figure["iqm"], *(figure["interval"] or ())))
    return f"{middle} ({' to '.join(ends)})" if ends else middle


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None


def machine() -> dict[str, Any]:
    """Return what the figures depend on besides the code."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"cores": cores, "system": platform.platform(), "python": platform.python_version()}


def write_json(path: Path | None, data: dict[str, Any]) -> None:
    """Write `data`, with the machine it was measured on, if a path is given."""
    if path is not None:
        path.write_text(json.dumps({**data, "machine": machine()}, indent=2) + "\n", encoding="utf-8")
