"""The simulation trace as CSV: a line of column names, then a line a control step."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import IO

from .log_blocks import Blocks
from .sim_trace import COMMON, SCHEMA, read_at_once, read_rows
from .step_tables import StepTables

_HEADER = b"episode"


@dataclass
class TraceCsv:
    """The rows of one file."""

    steps: StepTables = field(default_factory=StepTables)
    refused: list[tuple[int | None, str]] = field(default_factory=list)
    """Line (None: from somewhere on) and reason of what is no row."""


def read_trace_csv(stream: IO[bytes]) -> TraceCsv:
    """Read a trace; several files one after the other, each with its line of names, are read as one.

    Raises:
        ValueError: the first line does not name the columns of a trace; one line says what is missing.
    """
    trace, blocks = TraceCsv(), Blocks(stream)
    header: Sequence[str] | None = None
    for block in blocks:
        at, number = 0, blocks.lines + 1
        while header is None and at < len(block):
            end = block.find(b"\n", at) + 1 or len(block)
            line, at, number = block[at:end], end, number + 1
            if line.strip():
                header = _names(line)
        if header is None:
            continue
        data = block[at:]
        count = data.count(b"\n") + (not data.endswith(b"\n"))
        table = read_at_once(data, header, count) if data else SCHEMA.empty_table()
        if table is not None:
            trace.steps.add(table)
        else:
            header = _read_slowly(trace, data, number, header)
    if header is None:
        raise ValueError("empty" if not blocks.refused else blocks.refused[0][1])
    trace.refused += blocks.refused
    return trace


def _names(line: bytes) -> list[str]:
    names = [name.strip().strip('"') for name in line.decode("utf-8", "replace").split(",")]
    missing = [name for name in COMMON if name not in names]
    if missing:
        raise ValueError(f"no column {', '.join(missing)}")
    return names


def _read_slowly(trace: TraceCsv, data: bytes, first: int, header: Sequence[str]) -> Sequence[str]:
    """Read lines among which some are no rows; return the names of the columns at the end."""
    lines: list[bytes] = []
    numbers: list[int] = []

    def flush() -> None:
        names = header
        table, refused = read_rows(lines, lambda count: names if count == len(names) else None)
        trace.steps.add(table)
        trace.refused += [(numbers[one.place], one.reason) for one in refused]
        lines.clear()
        numbers.clear()

    for number, line in enumerate(data.split(b"\n"), start=first):
        line = line.rstrip(b"\r")
        if not line.strip():
            continue
        if line.lstrip(b'" ').startswith(_HEADER):
            flush()
            try:
                header = _names(line)
            except ValueError as error:
                trace.refused.append((number, str(error)))
            continue
        lines.append(line)
        numbers.append(number)
    flush()
    return header
