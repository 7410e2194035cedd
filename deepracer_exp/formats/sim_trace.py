"""Lines of the simulation trace, of every generation of the service, as tables."""

import csv
import math
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv as arrow_csv

COMMON = (
    *("episode", "steps", "X", "Y", "yaw", "steer", "throttle", "action", "reward", "done"),
    *("all_wheels_on_track", "progress", "closest_waypoint", "track_len", "tstamp"),
)
"""What every generation tells."""
LATER = ("episode_status", "pause_duration", "obstacle_crash_counter", "wall_clock")
"""What some tell besides."""
_COUNTER_OR_CLOCK = "counter or clock"
# By the number of values of a log line (deepracer-simapp metrics/constants.py). The fourth of 18 is the obstacle
# counter in some versions and the clock in others.
_OF_LINE = {
    15: COMMON,
    16: (*COMMON, "episode_status"),
    17: (*COMMON, "episode_status", "pause_duration"),
    18: (*COMMON, "episode_status", "pause_duration", _COUNTER_OR_CLOCK),
    19: (*COMMON, *LATER),
}
_EARLIEST_CLOCK_S = 1e8
_WHOLE = ("episode", "steps", "closest_waypoint")
_FLAGS = ("done", "all_wheels_on_track")
_TRUE, _FALSE = ("True", "true", "1"), ("False", "false", "0")
_STATUS = re.compile(r"[A-Za-z_ ]{0,40}")
_CHUNK = 1024
_LARGEST = 2**31 - 1

Layout = Callable[[int], Sequence[str] | None]
"""Names of the columns of a line with so many values; None: there is no such line."""
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
"""Columns of a table of rows; `values` is how many the line had."""


class Refused(NamedTuple):
    """A line that is no row."""

    place: int
    """Among the lines given."""
    reason: str


def line_layout(values: int) -> Sequence[str] | None:
    """Return the columns of a log line with so many values."""
    return _OF_LINE.get(values)


def read_rows(
    lines: Sequence[bytes], layout: Layout, before: int | None = None
) -> tuple[pa.Table, list[Refused]]:
    """Read the lines of a trace.

    A single line with fewer values than its neighbours is a torn one, though an older generation may have had so many.

    Args:
        lines: values with commas between them, without what stands before them in a log.
        layout: what the values of a line are.
        before: how many values the line before the first had; None if there was none.

    Returns:
        Rows in the order of lines with the columns of `SCHEMA`, and the lines that are none.
    """
    if not lines:
        return SCHEMA.empty_table(), []
    whole = _at_once(lines, layout) if len(lines) > 1 or before is None else None
    if whole is not None:
        return whole, []
    torn = _torn(np.array([line.count(b",") + 1 for line in lines]), before)
    refused = [Refused(place, _torn_reason(lines[place])) for place in np.flatnonzero(torn).tolist()]
    kept: list[int] = np.flatnonzero(~torn).tolist()
    tables = []
    for start in range(0, len(kept), _CHUNK):
        places = kept[start : start + _CHUNK]
        chunk = [lines[place] for place in places]
        table = _at_once(chunk, layout)
        if table is None:
            table, bad = _one_by_one(chunk, layout)
            refused += [Refused(places[one.place], one.reason) for one in bad]
        tables.append(table)
    table = pa.concat_tables(tables) if tables else SCHEMA.empty_table()
    return table, sorted(refused)


def read_at_once(data: bytes, columns: Sequence[str], lines: int) -> pa.Table | None:
    """Read lines that all have the same columns and nothing wrong; None otherwise.

    What it accepts, it reads as the slow way does line by line.
    """
    kinds = {name: pa.float64() for name in columns}
    kinds |= dict.fromkeys(_FLAGS, pa.bool_()) | {"action": pa.string()}
    if "episode_status" in columns:
        kinds["episode_status"] = pa.dictionary(pa.int32(), pa.string())
    known = [name for name in columns if name in COMMON or name in LATER or name == _COUNTER_OR_CLOCK]
    # Arrow would end a line at a lone carriage return too.
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


def _at_once(lines: Sequence[bytes], layout: Layout) -> pa.Table | None:
    columns = layout(lines[0].count(b",") + 1)
    return None if columns is None else read_at_once(b"\n".join(lines), columns, len(lines))


def _checked(read: dict[str, pa.ChunkedArray], values: int, rows: int) -> pa.Table | None:
    """Return the table of `SCHEMA`, None if a value is out of range."""
    if _COUNTER_OR_CLOCK in read:
        counter, clock = _counter_or_clock(read[_COUNTER_OR_CLOCK].to_numpy())
        read |= {"obstacle_crash_counter": pa.array(counter), "wall_clock": pa.array(clock)}
    columns: list[pa.Array | pa.ChunkedArray] = []
    for name, kind in zip(SCHEMA.names, SCHEMA.types, strict=True):
        column = read.get(name)
        if name == "values":
            column = pa.array(np.full(rows, min(values, 127), np.int8))
        elif column is None:
            column = _default(name, kind, rows)
        elif name in _WHOLE:
            numbers = column.to_numpy()
            # A NaN makes every comparison false.
            if not (((numbers >= 0) & (numbers <= _LARGEST)).all() and (numbers == np.floor(numbers)).all()):
                return None
            column = pa.array(numbers.astype(np.int32))
        elif name == "action":
            column = _actions(column)
            if column is None:
                return None
        elif name == "episode_status":
            words = {word for chunk in column.chunks for word in chunk.dictionary.to_pylist()}
            if any(word != word.strip() or not _STATUS.fullmatch(word) for word in words):
                return None
        elif pa.types.is_floating(kind) and name not in LATER and not np.isfinite(column.to_numpy()).all():
            return None
        columns.append(column)
    return pa.Table.from_arrays([_chunked(column) for column in columns], schema=SCHEMA)


def _chunked(column: pa.Array | pa.ChunkedArray) -> pa.ChunkedArray:
    return column if isinstance(column, pa.ChunkedArray) else pa.chunked_array([column])


def _default(name: str, kind: pa.DataType, rows: int) -> pa.Array:
    if name == "episode_status":
        return pa.DictionaryArray.from_arrays(np.zeros(rows, np.int32), pa.array([""]))
    return pa.array(np.full(rows, 0.0 if name == "pause_duration" else math.nan), kind)


def _counter_or_clock(numbers: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    clock = numbers >= _EARLIEST_CLOCK_S
    return np.where(clock, math.nan, numbers), np.where(clock, numbers, math.nan)


def _actions(column: pa.ChunkedArray) -> pa.ChunkedArray | None:
    """Return action numbers, NaN for a continuous action: [steer speed]."""
    continuous = pc.and_(pc.starts_with(column, "["), pc.ends_with(column, "]"))
    try:
        numbers = pc.cast(pc.if_else(continuous, pa.scalar("nan"), column), pa.float64())
    except pa.ArrowInvalid:
        return None
    told = numbers.to_numpy()[~continuous.to_numpy()]
    return numbers if np.isfinite(told).all() else None


def _torn(counts: NDArray[np.int64], before: int | None) -> NDArray[np.bool_]:
    # Beyond an end the neighbour is taken that there is.
    ahead, after = np.roll(counts, 1), np.roll(counts, -1)
    if before is not None:
        ahead[0] = before
    elif len(counts) > 1:
        ahead[0] = after[0]
    after[-1] = ahead[-1]
    return (counts < ahead) & (counts < after)


def _torn_reason(line: bytes) -> str:
    return f"{line.count(b',') + 1} values, fewer than its neighbours have: torn"


def _one_by_one(lines: Sequence[bytes], layout: Layout) -> tuple[pa.Table, list[Refused]]:
    rows, refused = [], []
    for index, line in enumerate(lines):
        try:
            rows.append(_row(line.decode("utf-8", "replace"), layout))
        except ValueError as error:
            refused.append(Refused(index, str(error)))
    return pa.Table.from_pylist(rows, schema=SCHEMA), refused


def _row(line: str, layout: Layout) -> dict[str, object]:
    """Read one line.

    Raises:
        ValueError: it is no row; one line says why.
    """
    try:
        values = next(csv.reader([line]), []) if '"' in line else line.split(",")
    except csv.Error as error:
        raise ValueError(f"cannot be taken apart ({error})") from error
    columns = layout(len(values))
    if columns is None:
        raise ValueError(f"{len(values)} values; accepted: {_accepted(layout)}")
    # A column that stands there twice counts where it stands first.
    told = dict(zip(reversed(columns), reversed([value.strip() for value in values]), strict=True))
    row: dict[str, object] = {"values": min(len(values), 127), "episode_status": "", "pause_duration": 0.0}
    row |= {"obstacle_crash_counter": math.nan, "wall_clock": math.nan}
    for name, value in told.items():
        if name in COMMON or name in LATER:
            row[name] = _value(name, value)
        elif name == _COUNTER_OR_CLOCK:
            number = _number("the value before the last", value)
            row["wall_clock" if number >= _EARLIEST_CLOCK_S else "obstacle_crash_counter"] = number
    return row


def _accepted(layout: Layout) -> str:
    known = [count for count in range(1, 128) if layout(count) is not None]
    return f"{known[0]} to {known[-1]}" if len(known) > 1 else str(known[0] if known else "a longer header")


def _value(name: str, value: str) -> float | bool | str:
    if name in _FLAGS:
        if value not in (*_TRUE, *_FALSE):
            raise ValueError(f"{name} is {_short(value)}; accepted: True or False")
        return value in _TRUE
    if name == "episode_status":
        if not _STATUS.fullmatch(value):
            raise ValueError(f"{name} is {_short(value)}; accepted: a word of the service")
        return value
    if name == "action" and value.startswith("[") and value.endswith("]"):
        return math.nan
    number = _number(name, value)
    if name in _WHOLE:
        if not (0 <= number <= _LARGEST and number == math.floor(number)):
            raise ValueError(f"{name} is {_short(value)}; accepted: a whole number from 0")
        return int(number)
    if name not in LATER and not math.isfinite(number):
        raise ValueError(f"{name} is {_short(value)}; accepted: a finite number")
    return number


def _number(name: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise ValueError(f"{name} is {_short(value)}; accepted: a number") from None


def _short(value: str) -> str:
    return repr(value if len(value) <= 40 else f"{value[:39]}…")
