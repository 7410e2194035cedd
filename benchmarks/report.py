"""What all benchmarks share: tables, medians, JSON files."""

import json
import math
import os
import platform
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any


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


def machine() -> dict[str, Any]:
    """Return what the figures depend on besides the code."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"cores": cores, "system": platform.platform(), "python": platform.python_version()}


def write_json(path: Path | None, data: dict[str, Any]) -> None:
    """Write `data`, with the machine it was measured on, if a path is given."""
    if path is not None:
        path.write_text(json.dumps({**data, "machine": machine()}, indent=2) + "\n", encoding="utf-8")
