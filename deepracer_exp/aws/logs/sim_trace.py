"""The simulation trace of every generation of the service, as tables: lines of a log, or a CSV file."""

import csv
import math
import re
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv as arrow_csv

from .blocks import Blocks

COMMON = (
    *("episode", "steps", "X", "Y", "yaw", "steer", "throttle", "action", "reward", "done"),
    *("all_wheels_on_track", "progress", "closest_waypoint", "track_len", "tstamp"),
)
"""Columns of every generation."""
LATER = ("episode_status", "pause_duration", "obstacle_crash_counter", "wall_clock")
"""Columns of some generations."""
_COUNTER_OR_CLOCK = "counter or clock"
Layouts = Mapping[int, Sequence[str]]
"""Names of the columns by the number of values of a line."""
# deepracer-simapp, metrics/constants.py. The fourth of 18 later values is the obstacle counter in some versions and
# the clock in others.
LOG_LAYOUTS: Layouts = {
    15: COMMON,
    16: (*COMMON, "episode_status"),
    17: (*COMMON, "episode_status", "pause_duration"),
    18: (*COMMON, "episode_status", "pause_duration", _COUNTER_OR_CLOCK),
    19: (*COMMON, *LATER),
}
_EARLIEST_CLOCK_S = 1e8
# Figures and tables have a place for every waypoint and action up to the highest.
_WHOLE = {"episode": 2**31 - 1, "steps": 2**31 - 1, "closest_waypoint": 99_999}
"""Columns of whole numbers and their largest values."""
_LARGEST_ACTION = 9_999
# Beyond any track, clock and reward; sums and squares of larger numbers are infinite.
_LARGEST = dict.fromkeys((*COMMON, *LATER), 1e9) | {"reward": 1e100, "tstamp": 1e12, "wall_clock": 1e12}
"""Largest absolute values of the other columns."""
_FLAGS = ("done", "all_wheels_on_track")
_TRUE, _FALSE = ("True", "true", "1"), ("False", "false", "0")
_STATUS = re.compile(r"[A-Za-z_ ]{0,40}")
_CHUNK = 1024
_HEADER = b"episode"
MOST_REFUSED = 1000
"""Lines without a row at the beginning of a file after which the rest is not read: that would take minutes."""
MOST_STEPS = 4_000_000
"""Control steps of a recording that are held in memory: 74 hours of driving at 15 a second. A report of so many takes
about 2.5 GB."""

SCHEMA = pa.schema(
    [
        *(
            (name, pa.int32() if name in _WHOLE else pa.bool_() if name in _FLAGS else pa.float64())
            for name in COMMON
        ),
        ("episode_status", pa.dictionary(pa.int32(), pa.string())),
        *((name, pa.float64()) for name in LATER[1:]),
        ("values", pa.int8()),
    ]
)
"""Columns of a table of rows; `values` is the number of values of the line."""


def left_out_reason(steps: int) -> str:
    """Return the message about steps that were left out because there are too many."""
    return f"{steps:,} steps are left out: only the last {MOST_STEPS:,} of a recording are kept"


class StepTables:
    """Tables of `SCHEMA` in the order of reading; beyond `MOST_STEPS` rows the first tables are dropped."""

    def __init__(self, tables: Iterable[pa.Table] = (), left_out: int = 0) -> None:
        self._tables = deque(tables)
        self.rows = sum(table.num_rows for table in self._tables)
        """Rows held."""
        self.left_out = left_out
        """Rows dropped."""

    @classmethod
    def joined(cls, pieces: Sequence["StepTables"]) -> "StepTables":
        """Return the tables of several files, one after the other."""
        return cls(
            (table for piece in pieces for table in piece._tables), sum(piece.left_out for piece in pieces)
        )

    def add(self, table: pa.Table) -> None:
        """Append rows, and drop the first tables while there are too many rows."""
        self._tables.append(table)
        self.rows += table.num_rows
        while self.rows > MOST_STEPS and len(self._tables) > 1:
            self.drop_first()

    def drop_first(self) -> int:
        """Drop the first table, and return its rows: dropping a part of it would not free its memory."""
        dropped: int = self._tables.popleft().num_rows
        self.rows -= dropped
        self.left_out += dropped
        return dropped

    @property
    def found_rows(self) -> bool:
        """Whether the file had any rows."""
        return self.rows + self.left_out > 0

    @property
    def found(self) -> bool:
        """Whether the file had any rows, or lines that should have been rows."""
        return bool(self._tables) or self.left_out > 0

    @property
    def whole(self) -> pa.Table:
        """All rows held."""
        return pa.concat_tables(self._tables) if self._tables else SCHEMA.empty_table()


_LISTED_ACTION = re.compile(rb"(\[[^\[\],\n]*),")


def with_one_value_an_action(rows: bytes) -> bytes:
    """Return rows of a trace in which no comma separates the two numbers of a continuous action.

    The console wrote `[-30.0, 1.2]` from November 2022 to June 2023, `[-30.0 1.2]` before and since.
    """
    return _LISTED_ACTION.sub(rb"\1 ", rows) if b"[" in rows else rows


Refused = list[tuple[int | None, str]]
"""Line (None: from an unknown line on) and reason of what is not a row."""


def is_hopeless(steps: "StepTables", refused: Refused) -> bool:
    """Return whether a trace has no rows and so many lines that are none that the rest is not worth reading."""
    return not steps.found_rows and len(refused) >= MOST_REFUSED


REST_REFUSED = f"the rest is not read: none of the first {MOST_REFUSED:,} lines is a row"


def read_trace_csv(stream: IO[bytes]) -> tuple[StepTables, Refused]:
    """Read a CSV trace; several files one after the other, each with its header, are read as one.

    Raises:
        ValueError: the first line does not name the columns of a trace; the message names the missing ones.
    """
    steps, blocks = StepTables(), Blocks(stream)
    refused: Refused = []
    header: Sequence[str] | None = None
    for block in blocks:
        at, number = 0, blocks.lines + 1
        while header is None and at < len(block):
            end = block.find(b"\n", at) + 1 or len(block)
            line, at, number = block[at:end], end, number + 1
            if line.strip():
                header = _column_names(line)
        if header is None:
            continue
        data = with_one_value_an_action(block[at:])
        count = data.count(b"\n") + (not data.endswith(b"\n"))
        table = _read_fast(data, header, count) if data else SCHEMA.empty_table()
        if table is not None:
            steps.add(table)
        else:
            header = _read_csv_lines(steps, refused, data, number, header)
            if is_hopeless(steps, refused):
                refused.append((None, REST_REFUSED))
                break
    if header is None:
        raise ValueError("empty" if not blocks.refused else blocks.refused[0][1])
    return steps, refused + blocks.refused


def _column_names(line: bytes) -> list[str]:
    names = [name.strip().strip('"') for name in line.decode("utf-8", "replace").split(",")]
    missing = [name for name in COMMON if name not in names]
    if missing:
        raise ValueError(f"no column {', '.join(missing)}")
    return names


def _read_csv_lines(
    steps: StepTables, refused: Refused, data: bytes, first: int, header: Sequence[str]
) -> Sequence[str]:
    """Read lines of which some are not rows; return the header in force at the end."""
    lines: list[bytes] = []
    numbers: list[int] = []

    def flush() -> None:
        table, bad = read_rows(lines, {len(header): header}, may_stop=not steps.found_rows)
        steps.add(table)
        refused.extend((numbers[at], reason) for at, reason in bad)
        lines.clear()
        numbers.clear()

    for number, line in enumerate(data.split(b"\n"), start=first):
        line = line.rstrip(b"\r")
        if not line.strip():
            continue
        if line.lstrip(b'" ').startswith(_HEADER):
            flush()
            try:
                header = _column_names(line)
            except ValueError as error:
                refused.append((number, str(error)))
            continue
        lines.append(line)
        numbers.append(number)
    flush()
    return header


def read_rows(
    lines: Sequence[bytes], layouts: Layouts, before: int | None = None, *, may_stop: bool = False
) -> tuple[pa.Table, list[tuple[int, str]]]:
    """Read the lines of a trace.

    A single line with fewer values than its neighbours is incomplete, even if an older generation had so many.

    Args:
        lines: comma-separated values, without what precedes them in a log.
        layouts: the columns by the number of values.
        before: how many values the line before the first had; None if there was none.
        may_stop: stop at `MOST_REFUSED` lines if none of them is a row.

    Returns:
        Rows in the order of lines with the columns of `SCHEMA`; and of the lines that are not rows, the index among
        `lines` and the reason.
    """
    if not lines:
        return SCHEMA.empty_table(), []
    whole = _read_chunk(lines, layouts) if len(lines) > 1 or before is None else None
    if whole is not None:
        return whole, []
    incomplete = _incomplete(np.array([line.count(b",") + 1 for line in lines]), before)
    refused = [
        (at, f"incomplete: {lines[at].count(b',') + 1} values, fewer than the lines around it")
        for at in np.flatnonzero(incomplete).tolist()
    ]
    kept: list[int] = np.flatnonzero(~incomplete).tolist()
    tables = []
    for start in range(0, len(kept), _CHUNK):
        places = kept[start : start + _CHUNK]
        chunk = [lines[place] for place in places]
        table = _read_chunk(chunk, layouts)
        if table is None:
            table, bad = _read_slowly(chunk, layouts)
            refused += [(places[at], reason) for at, reason in bad]
        tables.append(table)
        if may_stop and len(refused) >= MOST_REFUSED and not any(one.num_rows for one in tables):
            break
    table = pa.concat_tables(tables) if tables else SCHEMA.empty_table()
    return table, sorted(refused)


def _incomplete(counts: NDArray[np.int64], before: int | None) -> NDArray[np.bool_]:
    # At either end the only neighbour counts twice.
    ahead, after = np.roll(counts, 1), np.roll(counts, -1)
    if before is not None:
        ahead[0] = before
    elif len(counts) > 1:
        ahead[0] = after[0]
    after[-1] = ahead[-1]
    return (counts < ahead) & (counts < after)


def _read_chunk(lines: Sequence[bytes], layouts: Layouts) -> pa.Table | None:
    columns = layouts.get(lines[0].count(b",") + 1)
    return None if columns is None else _read_fast(b"\n".join(lines), columns, len(lines))


def _read_fast(data: bytes, columns: Sequence[str], lines: int) -> pa.Table | None:
    """Read flawless lines of the same columns; None if they are anything else.

    What it accepts, it reads exactly as `_read_slowly` does.
    """
    kinds = {name: pa.float64() for name in columns}
    kinds |= dict.fromkeys(_FLAGS, pa.bool_()) | {"action": pa.string()}
    if "episode_status" in columns:
        kinds["episode_status"] = pa.dictionary(pa.int32(), pa.string())
    known = [name for name in columns if name in COMMON or name in LATER or name == _COUNTER_OR_CLOCK]
    # Arrow would end a line at a lone carriage return, too.
    if len(set(known)) != len(known) or (b"\r" in data and b"\r" in data.replace(b"\r\n", b"")):
        return None
    try:
        read = arrow_csv.read_csv(
            pa.BufferReader(data),
            arrow_csv.ReadOptions(column_names=list(columns), use_threads=False, block_size=len(data) + 1),
            arrow_csv.ParseOptions(quote_char='"' if b'"' in data else False),
            arrow_csv.ConvertOptions(
                column_types={name: kinds[name] for name in known},
                include_columns=known,
                null_values=[],
                true_values=_TRUE,
                false_values=_FALSE,
            ),
        )
    except (pa.ArrowInvalid, UnicodeDecodeError):
        return None
    if read.num_rows != lines:
        return None
    return _checked({name: read[name] for name in known}, len(columns), lines)


def _checked(read: dict[str, pa.ChunkedArray], values: int, rows: int) -> pa.Table | None:
    """Return the table of `SCHEMA`, None if a value is out of range."""
    if _COUNTER_OR_CLOCK in read:
        numbers = read[_COUNTER_OR_CLOCK].to_numpy()
        clock = numbers >= _EARLIEST_CLOCK_S
        read["obstacle_crash_counter"] = pa.chunked_array([np.where(clock, math.nan, numbers)])
        read["wall_clock"] = pa.chunked_array([np.where(clock, numbers, math.nan)])
    columns: list[pa.ChunkedArray] = []
    for name, kind in zip(SCHEMA.names, SCHEMA.types, strict=True):
        column = read.get(name)
        if name == "values":
            column = np.full(rows, min(values, 127), np.int8)
        elif column is None and name == "episode_status":
            column = pa.DictionaryArray.from_arrays(np.zeros(rows, np.int32), pa.array([""]))
        elif column is None:
            column = np.full(rows, 0.0 if name == "pause_duration" else math.nan)
        elif name in _WHOLE:
            numbers = column.to_numpy()
            # A NaN makes every comparison false.
            if not (
                ((numbers >= 0) & (numbers <= _WHOLE[name])).all() and (numbers == np.floor(numbers)).all()
            ):
                return None
            column = numbers.astype(np.int32)
        elif name == "action":
            column = _actions(column)
            if column is None:
                return None
        elif name == "episode_status":
            words = {word for chunk in column.chunks for word in chunk.dictionary.to_pylist()}
            if any(word != word.strip() or not _STATUS.fullmatch(word) for word in words):
                return None
        elif name == "track_len":
            numbers = column.to_numpy()
            if not ((numbers > 0) & (numbers <= _LARGEST[name])).all():
                return None
        elif pa.types.is_floating(kind):
            numbers = column.to_numpy()
            known = np.abs(numbers) <= _LARGEST[name]
            if not (known | (np.isnan(numbers) & (name in LATER))).all():
                return None
        columns.append(column if isinstance(column, pa.ChunkedArray) else pa.chunked_array([column]))
    return pa.Table.from_arrays(columns, schema=SCHEMA)


def _actions(column: pa.ChunkedArray) -> pa.ChunkedArray | None:
    """Return action numbers, NaN for a continuous action: [steer speed]."""
    continuous = pc.and_(pc.starts_with(column, "["), pc.ends_with(column, "]"))
    try:
        numbers = pc.cast(pc.if_else(continuous, pa.scalar("nan"), column), pa.float64())
    except pa.ArrowInvalid:
        return None
    discrete = numbers.to_numpy()[~continuous.to_numpy()]
    return numbers if (np.abs(discrete) <= _LARGEST_ACTION).all() else None


def _read_slowly(lines: Sequence[bytes], layouts: Layouts) -> tuple[pa.Table, list[tuple[int, str]]]:
    """Read line by line, and say what is wrong with those that are not rows."""
    rows, refused = [], []
    for index, line in enumerate(lines):
        try:
            rows.append(_row(line.decode("utf-8", "replace"), layouts))
        except ValueError as error:
            refused.append((index, str(error)))
    return pa.Table.from_pylist(rows, schema=SCHEMA), refused


def _row(line: str, layouts: Layouts) -> dict[str, object]:
    """Read one line.

    Raises:
        ValueError: it is not a row; the message gives the reason.
    """
    try:
        values = next(csv.reader([line]), []) if '"' in line else line.split(",")
    except csv.Error as error:
        raise ValueError(f"cannot be split into values ({error})") from error
    columns = layouts.get(len(values))
    if columns is None:
        least, most = min(layouts), max(layouts)
        accepted = f"{least} to {most}" if most > least else str(least)
        raise ValueError(f"{len(values)} values; accepted: {accepted}")
    # Of a column that appears twice the first one counts.
    by_name = dict(zip(reversed(columns), reversed([value.strip() for value in values]), strict=True))
    row: dict[str, object] = {"values": min(len(values), 127), "episode_status": "", "pause_duration": 0.0}
    row |= {"obstacle_crash_counter": math.nan, "wall_clock": math.nan}
    for name, value in by_name.items():
        if name in COMMON or name in LATER:
            row[name] = _value(name, value)
        elif name == _COUNTER_OR_CLOCK:
            number = _number("the value before the last", value)
            named = "wall_clock" if number >= _EARLIEST_CLOCK_S else "obstacle_crash_counter"
            row[named] = _value(named, value)
    return row


def _value(name: str, value: str) -> float | bool | str:
    if name in _FLAGS:
        if value not in (*_TRUE, *_FALSE):
            raise ValueError(f"{name} is {_short(value)}; accepted: True or False")
        return value in _TRUE
    if name == "episode_status":
        if not _STATUS.fullmatch(value):
            raise ValueError(f"{name} is {_short(value)}; accepted: a status of the service")
        return value
    if name == "action" and value.startswith("[") and value.endswith("]"):
        return math.nan
    number = _number(name, value)
    if name in _WHOLE:
        if not (0 <= number <= _WHOLE[name] and number == math.floor(number)):
            raise ValueError(f"{name} is {_short(value)}; accepted: a whole number from 0 to {_WHOLE[name]}")
        return int(number)
    if name == "action" and not abs(number) <= _LARGEST_ACTION:
        raise ValueError(f"{name} is {_short(value)}; accepted: an action up to {_LARGEST_ACTION}")
    if not abs(number) <= _LARGEST[name] and not (name in LATER and math.isnan(number)):
        largest = _LARGEST[name]
        raise ValueError(f"{name} is {_short(value)}; accepted: a number from {-largest:g} to {largest:g}")
    if name == "track_len" and number <= 0:
        raise ValueError(f"{name} is {_short(value)}; accepted: a length above 0")
    return number


def _number(name: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise ValueError(f"{name} is {_short(value)}; accepted: a number") from None


def _short(value: str) -> str:
    return repr(value if len(value) <= 40 else f"{value[:39]}…")
