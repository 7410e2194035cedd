"""The simulation trace of every generation of the service, as tables: lines of a log, or a CSV file."""

import math
import re
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd
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
_COUNTER_OR_CLOCK = "the value before the last"
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
EARLIEST_CLOCK_S = 1e8
"""Time stamps from this value are unix time, not that of a simulation."""
# Figures and tables have a place for every waypoint and action up to the highest.
_WHOLE = {"episode": 2**31 - 1, "steps": 2**31 - 1, "closest_waypoint": 99_999}
"""Columns of whole numbers and their largest values."""
_LARGEST_ACTION = 9_999
# Beyond any track, clock and reward; sums and squares of larger numbers are infinite.
_LARGEST = dict.fromkeys((*COMMON, *LATER), 1e9) | {"reward": 1e100, "tstamp": 1e12, "wall_clock": 1e12}
"""Largest absolute values of the other columns."""
_FLAGS = ("done", "all_wheels_on_track")
_FLAG_OF = dict.fromkeys(("True", "true", "1"), True) | dict.fromkeys(("False", "false", "0"), False)
_STATUS = re.compile(r"[A-Za-z_ ]{0,40}")
_READ = {*COMMON, *LATER, _COUNTER_OR_CLOCK}
_HEADER = re.compile(rb'[" ]*episode')
_BEFORE_HEADER = re.compile(rb'\n(?=[" ]*episode)')
MOST_REFUSED = 1000
"""Leading lines without a row after which a file is given up: reading the rest would take minutes."""
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
    """Return the message about steps beyond the limit, which are left out."""
    return f"{steps:,} steps are left out: only the last {MOST_STEPS:,} of a recording are kept"


Refused = list[tuple[int | None, str]]
"""Line (None: from an unknown line on) and reason of each line that is not a row."""


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

    def give_up(self, refused: Refused) -> bool:
        """Return whether to stop reading a file with many lines but no rows; the last reason says so."""
        if self.rows + self.left_out or len(refused) < MOST_REFUSED:
            return False
        rest = f"the rest is not read: none of the first {MOST_REFUSED:,} lines is a row"
        refused[MOST_REFUSED:] = [(None, rest)]
        return True

    @property
    def has_lines(self) -> bool:
        """Whether the file had any rows, or lines that should have been rows."""
        return bool(self._tables) or self.left_out > 0

    @property
    def whole(self) -> pa.Table:
        """All rows held."""
        return pa.concat_tables(self._tables) if self._tables else SCHEMA.empty_table()


_LISTED_ACTION = re.compile(rb"(\[[^\[\],\n]*),")
_QUOTED = re.compile(rb'"([^"\n]*)"')


def step_keys(table: pa.Table) -> NDArray[np.int64]:
    """Return episode and step of each row in one number."""
    episode, steps = (table[name].to_numpy().astype(np.int64) for name in ("episode", "steps"))
    return (episode << 32) | steps


def with_plain_commas(rows: bytes) -> bytes:
    """Return rows of a trace in which every comma separates two columns.

    The console wrote the two numbers of a continuous action as `[-30.0, 1.2]` from November 2022 to June 2023, and as
    `[-30.0 1.2]` before and since. Other programs put values in quotes.
    """
    rows = _LISTED_ACTION.sub(rb"\1 ", rows) if b"[" in rows else rows
    return _QUOTED.sub(lambda match: match[1].replace(b",", b" "), rows) if b'"' in rows else rows


def read_trace_csv(stream: IO[bytes]) -> tuple[StepTables, Refused]:
    """Read a CSV trace; several files one after the other, each with its header, are read as one.

    Raises:
        ValueError: the first line does not name the columns of a trace; the message names the missing ones.
    """
    steps, blocks = StepTables(), Blocks(stream)
    refused: Refused = []
    header: Sequence[str] | None = None
    for block in blocks:
        if steps.give_up(refused):
            break
        # The pattern takes a hundred times as long as the search, and few files have a second header.
        again = block.find(b"episode", block.find(b"\n") + 1) >= 0
        headers = [match.end() for match in _BEFORE_HEADER.finditer(block)] if again else []
        for start, end in pairwise([0, *headers, len(block)]):
            rows = block[start:end]
            if header is None or _HEADER.match(rows):
                line, _, rows = rows.lstrip().partition(b"\n")
                if not line:
                    continue
                try:
                    header = _column_names(line)
                except ValueError as error:
                    if header is None:
                        raise
                    refused.append((blocks.line(start), str(error)))
            table, bad = read_rows(with_plain_commas(rows), {len(header): header}, skip_blank=True)
            steps.add(table)
            if bad:
                first = blocks.line(end - len(rows))
                refused += [(first + place, reason) for place, reason in bad]
    if header is None:
        raise ValueError("empty" if not blocks.refused else blocks.refused[0][1])
    return steps, refused + blocks.refused


def _column_names(line: bytes) -> list[str]:
    names = [name.strip().strip('"') for name in line.decode("utf-8", "replace").split(",")]
    missing = [name for name in COMMON if name not in names]
    if missing:
        raise ValueError(f"no column {', '.join(missing)}")
    return names


def read_rows(
    data: bytes, layouts: Layouts, before: int | None = None, *, skip_blank: bool = False
) -> tuple[pa.Table, list[tuple[int, str]]]:
    """Read the lines of a trace.

    `data` are lines of comma-separated values, without the text before them in a log. `layouts` has the columns by the
    number of values, `before` how many of these the line before the first had; blank lines are ignored with
    `skip_blank`, else refused.

    A single line with fewer values than its neighbours is incomplete, even if an older generation had so many.

    Returns:
        Rows in the order of lines with the columns of `SCHEMA`; and of the lines that are not rows, the index and the
        reason.
    """
    if not data:
        return SCHEMA.empty_table(), []
    end = data.find(b"\n") + 1 or len(data)
    width = data.count(b",", 0, end) + 1
    if width in layouts and (end < len(data) or before is None):
        alike = _read_alike(data, layouts[width])
        if alike is not None and not alike.refused:
            return alike.table(), []
    # Arrow would end a line at a lone carriage return, too.
    lines = data.replace(b"\r", b" ").removesuffix(b"\n").split(b"\n")
    places = np.array([place for place, line in enumerate(lines) if not skip_blank or line.strip()], np.int64)
    if not len(places):
        return SCHEMA.empty_table(), []
    widths = np.array([lines[place].count(b",") + 1 for place in places])
    incomplete = _incomplete(widths, before)
    refused = [
        (place, f"incomplete: {width} values, fewer than the lines around it")
        for place, width in zip(places[incomplete].tolist(), widths[incomplete].tolist(), strict=True)
    ]
    tables, order = [SCHEMA.empty_table()], [places[:0]]
    for width in np.unique(widths[~incomplete]).tolist():
        chosen = places[(widths == width) & ~incomplete]
        if width not in layouts:
            least, most = min(layouts), max(layouts)
            reason = f"{width} values; accepted: {f'{least} to {most}' if most > least else least}"
            refused += [(place, reason) for place in chosen.tolist()]
            continue
        alike = _read_alike(b"\n".join([lines[place] for place in chosen]), layouts[width])
        assert alike is not None, "lines with as many values as the columns"
        tables.append(alike.table())
        order.append(np.delete(chosen, list(alike.refused)))
        refused += [(int(chosen[place]), reason) for place, reason in alike.refused.items()]
    whole = pa.concat_tables(tables).unify_dictionaries()
    return whole.take(np.argsort(np.concatenate(order))), sorted(refused)


def _incomplete(counts: NDArray[np.int64], before: int | None) -> NDArray[np.bool_]:
    # At either end the only neighbour counts twice.
    ahead, after = np.roll(counts, 1), np.roll(counts, -1)
    if before is not None:
        ahead[0] = before
    elif len(counts) > 1:
        ahead[0] = after[0]
    after[-1] = ahead[-1]
    return (counts < ahead) & (counts < after)


def _read_alike(data: bytes, columns: Sequence[str]) -> "_Rows | None":
    """Read lines that all have the same columns; None if they have not."""
    # Of a column that appears twice the first one counts.
    places = {name: str(place) for place, name in reversed(list(enumerate(columns))) if name in _READ}
    names = [str(place) for place in range(len(columns))]
    try:
        read = arrow_csv.read_csv(
            pa.BufferReader(data),
            arrow_csv.ReadOptions(column_names=names, use_threads=False, block_size=len(data) + 1),
            arrow_csv.ParseOptions(quote_char=False),
            arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.binary()), include_columns=list(places.values())
            ),
        )
    except pa.ArrowInvalid:
        return None
    rows = _Rows(read.num_rows, len(columns), has_lists=b"[" in data)
    for name, place in places.items():
        rows.add(name, read[place].chunk(0))
    return rows


class _Rows:
    """Converts the columns of lines to values, and collects the reasons of lines that are not rows."""

    def __init__(self, count: int, width: int, has_lists: bool) -> None:
        self.count = count
        self.has_lists = has_lists
        """Whether an action may be a list: [steering angle, speed]."""
        self.refused: dict[int, str] = {}
        """Reasons by the index of the line."""
        self._columns: dict[str, Any] = {
            "episode_status": pa.repeat("", count),
            **{name: np.full(count, math.nan) for name in LATER[1:]},
            "pause_duration": np.zeros(count),
            "values": np.full(count, min(width, 127), np.int8),
        }

    def add(self, name: str, texts: pa.Array) -> None:
        """Add a column of texts."""
        if name in _FLAGS:
            codes, words = _dictionary_encode(texts)
            flags = np.array([_FLAG_OF.get(word, -1) for word in words])[codes]
            self._refuse(name, texts, flags < 0, "True or False")
            self._columns[name] = flags > 0
        elif name == "episode_status":
            codes, words = _dictionary_encode(texts)
            is_status = np.array([_STATUS.fullmatch(word) is not None for word in words])
            self._refuse(name, texts, ~is_status[codes], "a status of the service")
            self._columns[name] = pa.array(words, pa.string()).take(codes)
        else:
            listed = np.zeros(self.count, np.bool_)
            if name == "action" and self.has_lists:
                is_list = pc.match_substring_regex(texts, rb"^\s*\[.*\]\s*$")
                listed = is_list.to_numpy(zero_copy_only=False)
                texts = pc.if_else(is_list, pa.scalar(b"nan"), texts)
            numbers, unreadable = _numbers(texts)
            self._refuse(name, texts, unreadable, "a number")
            if name == _COUNTER_OR_CLOCK:
                clock = numbers >= EARLIEST_CLOCK_S
                self._add_numbers("obstacle_crash_counter", texts, np.where(clock, math.nan, numbers))
                self._add_numbers("wall_clock", texts, np.where(clock, numbers, math.nan))
            elif name == "action":
                accepted = f"an action up to {_LARGEST_ACTION}"
                self._refuse(name, texts, ~(np.abs(numbers) <= _LARGEST_ACTION) & ~listed, accepted)
                self._columns[name] = numbers
            else:
                self._add_numbers(name, texts, numbers)

    def _add_numbers(self, name: str, texts: pa.Array, numbers: NDArray[np.float64]) -> None:
        # A NaN makes every comparison false.
        if name in _WHOLE:
            last = _WHOLE[name]
            bad = ~((numbers >= 0) & (numbers <= last) & (numbers == np.floor(numbers)))
            self._refuse(name, texts, bad, f"a whole number from 0 to {last}")
            numbers = np.where(bad, 0, numbers).astype(np.int32)
        else:
            most = _LARGEST[name]
            bad = ~(np.abs(numbers) <= most) & ~(np.isnan(numbers) & (name in LATER))
            self._refuse(name, texts, bad, f"a number from {-most:g} to {most:g}")
            if name == "track_len":
                self._refuse(name, texts, numbers <= 0, "a length above 0")
        self._columns[name] = numbers

    def _refuse(self, name: str, texts: pa.Array, bad: NDArray[np.bool_], accepted: str) -> None:
        for place in np.flatnonzero(bad).tolist():
            value = _text(texts[place].as_py())
            shown = repr(value if len(value) <= 40 else f"{value[:39]}…")
            self.refused.setdefault(place, f"{name} is {shown}; accepted: {accepted}")

    def table(self) -> pa.Table:
        """Return the lines that are rows, with the columns of `SCHEMA`."""
        arrays = [pa.array(self._columns[name]) for name in SCHEMA.names]
        if self.refused:
            kept = np.delete(np.arange(self.count), list(self.refused))
            arrays = [array.take(kept) for array in arrays]
        status = SCHEMA.get_field_index("episode_status")
        arrays[status] = arrays[status].dictionary_encode()
        return pa.Table.from_arrays(arrays, schema=SCHEMA)


def _dictionary_encode(texts: pa.Array) -> tuple[NDArray[np.int32], list[str]]:
    """Dictionary-encode repeated strings: return the index of each, and the distinct strings."""
    encoded = texts.dictionary_encode()
    return encoded.indices.to_numpy(), [_text(word) for word in encoded.dictionary.to_pylist()]


def _numbers(texts: pa.Array) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Parse texts as numbers, NaN where that fails; and return where it fails."""
    try:
        return pc.cast(texts, pa.float64()).to_numpy(), np.zeros(len(texts), np.bool_)
    except pa.ArrowInvalid:  # one text is not a number, or has blanks around it
        numbers = [_number(_text(text)) for text in texts.to_pylist()]
        unreadable = np.array([number is None for number in numbers])
        return np.array(numbers, np.float64), unreadable


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "replace").strip()


def write_trace(steps: pd.DataFrame, file: Path) -> None:
    """Write steps with our trace's columns as a CSV of the service of 2022; create its folder."""
    table = steps[list(LOG_LAYOUTS[17])].astype({"steps": np.float64})
    if steps["action"].isna().any():  # of a continuous action space, as the service has it
        commands = zip(steps["steer"].tolist(), steps["throttle"].tolist(), strict=True)
        table["action"] = [f"[{steering_deg} {speed_mps}]" for steering_deg, speed_mps in commands]
    else:
        table["action"] = table["action"].astype(np.int64)
    file.parent.mkdir()
    table.to_csv(file, index=False)
