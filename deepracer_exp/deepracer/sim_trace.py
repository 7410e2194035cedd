"""The simulation trace of every generation of the service, as tables: lines of a log, or a CSV file."""

import codecs
import contextlib
import math
import re
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv as arrow_csv

from deepracer_exp.files import LOG_BYTES

from .log_archive import READ_ERRORS, reason_of

BLOCK_BYTES = 2**23
_PIECE_BYTES = 2**16
_LONGEST_LINE = 2**24
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
COMMON = (
    *("episode", "steps", "X", "Y", "yaw", "steer", "throttle", "action", "reward", "done"),
    *("all_wheels_on_track", "progress", "closest_waypoint", "track_len", "tstamp"),
)
"""Columns of every generation."""
LATER = ("episode_status", "pause_duration", "obstacle_crash_counter", "wall_clock")
"""Columns of some generations."""
_COUNTER_OR_CLOCK = "counter or clock"
# deepracer-simapp, metrics/constants.py. The fourth of 18 later values is the obstacle counter in some versions and
# the clock in others.
_LOG_LAYOUTS: Mapping[int, Sequence[str]] = {
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
_LARGEST = 2**31 - 1
_HEADER = b"episode"
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


Refused = list[tuple[int | None, str]]
"""Line (None: from an unknown line on) and reason of what cannot be read."""


class Blocks:
    """Reads a stream in blocks of whole lines, so that memory does not grow with the file.

    A file with the byte order mark of UTF-16, as PowerShell writes logs, is converted to UTF-8.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self.stream = stream
        self.lines = 0
        """Lines before the current block."""
        self.refused: Refused = []

    def __iter__(self) -> Iterator[bytes]:
        """Yield blocks; only the last may end without a line break."""
        rest = b""
        for chunk in self._chunks():
            end = chunk.rfind(b"\n") + 1
            if end:
                block = rest + chunk[:end]
                yield block
                self.lines += block.count(b"\n")
                rest = b""
            rest += chunk[end:]
            if len(rest) > _LONGEST_LINE:
                reason = f"a line of more than {_LONGEST_LINE // 2**20} MiB; the rest is not read"
                self.refused.append((self.lines + 1, reason))
                return
        if rest:
            yield rest

    def _chunks(self) -> Iterator[bytes]:
        decoder = None
        for number, chunk in enumerate(self._bytes()):
            if not number and chunk[:2] in _UTF_16:
                decoder = codecs.getincrementaldecoder("utf-16")(errors="replace")
            elif not number:
                chunk = chunk.removeprefix(codecs.BOM_UTF8)
            yield chunk if decoder is None else decoder.decode(chunk).encode("utf-8", "replace")

    def _bytes(self) -> Iterator[bytes]:
        # In pieces: a truncated archive loses only the piece that fails, not what was read before.
        pieces: list[bytes] = []
        size = total = 0
        while True:
            try:
                piece = self.stream.read(_PIECE_BYTES)
            except READ_ERRORS as error:
                self.refused.append((None, f"cannot be read to its end ({reason_of(error)})"))
                piece = b""
            if total > LOG_BYTES:
                self.refused.append((None, f"longer than {LOG_BYTES // 2**30} GiB; the rest is not read"))
                piece = b""
            pieces.append(piece)
            size += len(piece)
            if size >= BLOCK_BYTES or (size and not piece):
                yield b"".join(pieces)
                total += size
                pieces, size = [], 0
            if not piece:
                return


class StepTables:
    """Tables of `SCHEMA` in the order of reading; beyond `MOST_STEPS` rows the first tables are dropped."""

    def __init__(self) -> None:
        self._tables: deque[pa.Table] = deque()
        self.rows = 0
        """Rows held."""
        self.left_out = 0
        """Rows dropped."""

    def add(self, table: pa.Table) -> None:
        """Append rows, and drop the first tables while there are too many rows."""
        self._tables.append(table)
        self.rows += table.num_rows
        while self.rows > MOST_STEPS and len(self._tables) > 1:
            self.drop_first()

    def extend(self, other: "StepTables") -> None:
        """Append the tables of another file."""
        self._tables += other._tables
        self.rows += other.rows
        self.left_out += other.left_out

    def drop_first(self) -> None:
        """Drop the first table: dropping a part of one would not free its memory."""
        dropped = self._tables.popleft().num_rows
        self.rows -= dropped
        self.left_out += dropped

    @property
    def found(self) -> bool:
        """Whether the file had any rows, or lines that should have been rows."""
        return bool(self._tables) or self.left_out > 0

    @property
    def whole(self) -> pa.Table:
        """All rows held."""
        return pa.concat_tables(self._tables) if self._tables else SCHEMA.empty_table()


def left_out_reason(steps: int) -> str:
    """Return the message about steps that were left out because there are too many."""
    return f"{steps:,} steps are left out: only the last {MOST_STEPS:,} of a recording are kept"


def read_trace_csv(stream: IO[bytes]) -> tuple[StepTables, Refused]:
    """Read a CSV trace; several files one after the other, each with its header, are read as one.

    Returns:
        The rows, and the lines that are not rows.

    Raises:
        ValueError: the first line does not name the columns of a trace; the message names the missing ones.
    """
    steps, refused, blocks = StepTables(), Refused(), Blocks(stream)
    header: Sequence[str] | None = None
    for block in blocks:
        first = blocks.lines + 1
        while header is None and block:
            line, _, block = block.partition(b"\n")
            first += 1
            header = _column_names(line) if line.strip() else None
        if header is None or not block:
            continue
        count = block.count(b"\n") + (not block.endswith(b"\n"))
        try:
            steps.add(_read_rows(block, header, count))
        except ValueError:
            _read_csv_lines(steps, refused, block, first, header)
    if header is None:
        raise ValueError(blocks.refused[0][1] if blocks.refused else "empty")
    return steps, refused + blocks.refused


def _column_names(line: bytes) -> list[str]:
    names = [name.strip().strip('"') for name in line.decode("utf-8", "replace").split(",")]
    missing = [name for name in COMMON if name not in names]
    if missing:
        raise ValueError(f"no column {', '.join(missing)}; accepted: a trace of the service")
    # Of a column that appears twice the first one counts.
    return [name if name not in names[:at] else f"{name} {at}" for at, name in enumerate(names)]


def _read_csv_lines(
    steps: StepTables, refused: Refused, data: bytes, first: int, header: Sequence[str]
) -> None:
    """Read lines of which some are not rows, such as the headers of further files."""
    lines: list[bytes] = []
    numbers: list[int] = []
    for number, line in enumerate(data.split(b"\n"), start=first):
        line = line.rstrip(b"\r")
        is_header = line.lstrip(b'" ').startswith(b"episode")
        if is_header and line.count(b",") + 1 != len(header):
            refused.append((number, "another header than before"))
        elif line.strip() and not is_header:
            lines.append(line)
            numbers.append(number)
    table, bad = read_rows(lines, header)
    steps.add(table)
    refused += [(numbers[at], reason) for at, reason in bad]


def columns_of(lines: Sequence[bytes]) -> Sequence[str]:
    """Return the columns of the generation that most trace lines of a log belong to."""
    counts = Counter(line.count(b",") + 1 for line in lines)
    return _LOG_LAYOUTS[max(_LOG_LAYOUTS, key=lambda values: counts[values])]


def read_rows(lines: Sequence[bytes], columns: Sequence[str]) -> tuple[pa.Table, list[tuple[int, str]]]:
    """Read the lines of a trace.

    Args:
        lines: comma-separated values, without what precedes them in a log.
        columns: their names.

    Returns:
        Rows in the order of lines with the columns of `SCHEMA`, and index and reason of each line that is not a row.
    """
    with contextlib.suppress(ValueError):  # some line is not a row
        return _read_rows(b"\n".join(lines), columns, len(lines)), []
    tables: list[pa.Table] = [SCHEMA.empty_table()]
    refused: list[tuple[int, str]] = []

    def read(places: Sequence[int]) -> None:
        """Read some lines; where one is not a row, halve them to find out which."""
        try:
            tables.append(_read_rows(b"\n".join([lines[at] for at in places]), columns, len(places)))
        except ValueError as error:
            half = len(places) // 2
            if not half:
                refused.append((places[0], str(error)))
                return
            read(places[:half])
            read(places[half:])

    whole = []
    for at, line in enumerate(lines):
        values = line.count(b",") + 1
        if values == len(columns) or b'"' in line:
            whole.append(at)
        else:
            refused.append((at, f"{values} values; accepted: {len(columns)}"))
    if whole:
        read(whole)
    return pa.concat_tables(tables), sorted(refused)


def _read_rows(data: bytes, columns: Sequence[str], lines: int) -> pa.Table:
    """Read flawless lines of the same columns.

    Raises:
        ValueError: a line is not a row; the message says why.
    """
    kinds = {name: pa.float64() for name in columns}
    kinds |= dict.fromkeys(_FLAGS, pa.bool_()) | {"action": pa.string()}
    if "episode_status" in columns:
        kinds["episode_status"] = pa.dictionary(pa.int32(), pa.string())
    known = [name for name in columns if name in COMMON or name in LATER or name == _COUNTER_OR_CLOCK]
    # Arrow would end a line at a lone carriage return, too.
    if b"\r" in data and b"\r" in data.replace(b"\r\n", b""):
        raise ValueError("has a carriage return")
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
    except (pa.ArrowInvalid, UnicodeDecodeError) as error:
        raise ValueError(_reason(str(error), columns)) from error
    if read.num_rows != lines:
        raise ValueError("is not one line of values")
    return _checked({name: read[name] for name in known}, len(columns), lines)


def _reason(error: str, columns: Sequence[str]) -> str:
    """Return in our words why Arrow cannot read a line."""
    found = re.search(
        r"column #(\d+): (?:Row #\d+: )?CSV conversion error to (\w+): invalid value '(.*)'", error
    )
    if found is None:
        return " ".join(error.split())
    value = found[3] if len(found[3]) <= 40 else f"{found[3][:39]}…"
    accepted = "True or False" if found[2] == "bool" else "a number"
    return f"{columns[int(found[1])]} is {value!r}; accepted: {accepted}"


def _checked(read: dict[str, pa.ChunkedArray], values: int, rows: int) -> pa.Table:
    """Return the table of `SCHEMA`.

    Raises:
        ValueError: a value is out of range.
    """
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
            if not (((numbers >= 0) & (numbers <= _LARGEST)).all() and (numbers == np.floor(numbers)).all()):
                raise ValueError(f"{name} is {numbers[0]:g}; accepted: a whole number from 0")
            column = numbers.astype(np.int32)
        elif name == "action":
            column = _actions(column)
        elif name == "episode_status":
            words = {word for chunk in column.chunks for word in chunk.dictionary.to_pylist()}
            if any(word != word.strip() or not _STATUS.fullmatch(word) for word in words):
                raise ValueError("episode_status is not a status of the service")
        elif pa.types.is_floating(kind) and name not in LATER and not np.isfinite(column.to_numpy()).all():
            raise ValueError(f"{name} is {column[0]}; accepted: a finite number")
        columns.append(column if isinstance(column, pa.ChunkedArray) else pa.chunked_array([column]))
    return pa.Table.from_arrays(columns, schema=SCHEMA)


def _actions(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return action numbers, NaN for a continuous action: [steer speed].

    Raises:
        ValueError: one is neither.
    """
    continuous = pc.and_(pc.starts_with(column, "["), pc.ends_with(column, "]"))
    try:
        numbers = pc.cast(pc.if_else(continuous, pa.scalar("nan"), column), pa.float64())
    except pa.ArrowInvalid:
        numbers = None
    if numbers is None or not np.isfinite(numbers.to_numpy()[~continuous.to_numpy()]).all():
        raise ValueError(f"action is {column[0]}; accepted: a number or [steer speed]")
    return numbers
