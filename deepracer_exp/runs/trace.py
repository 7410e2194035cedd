"""The Parquet files of a run's trace, each with the steps of consecutive iterations."""

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import TypeAdapter

from deepracer_exp.config.racing import RaceConfig
from deepracer_exp.env.others.placement import SCHEMA as OTHERS_SCHEMA
from deepracer_exp.env.others.placement import PlacedOthers, read_placements
from deepracer_exp.env.trace_columns import SCHEMA, TRACE_COLUMNS
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.files import LOG_BYTES, plain_file

from .run_files import read_config

if TYPE_CHECKING:
    import pandas as pd

_ENDING, _OTHERS_ENDING, _OPEN_ENDING = "-iteration.parquet", "-others.parquet", "-open.parquet"
EVALUATION_OTHERS = "others.parquet"
"""File of the boxes, bots and rival of an evaluation, beside the control steps in its folder."""
_ACCEPTED = "a complete Parquet file of a run"
_RACE: TypeAdapter[RaceConfig] = TypeAdapter(RaceConfig)
DECIMALS = {
    **dict.fromkeys(("X", "Y", "yaw", "track_len"), 4),
    **dict.fromkeys(("steer", "throttle", "pause_duration"), 2),
    **{"progress": 6, "tstamp": 6, "speed_mps": 3},
}
"""Decimals kept: those of the service's log lines, with more for progress and time, which are differenced. Rounding
shrinks a row from 63 bytes to 16."""
MOST_ROWS = 2**17
"""Steps after which a file is complete, if no checkpoint comes first: few enough to buffer in memory, and enough that
Parquet's metadata is negligible."""
# A level at which zstd packs the bytes of a column by their rank: 1.5 bytes less a row than the usual one.
_LEVELS = dict.fromkeys(("X", "Y", "yaw", "steer", "throttle", "progress", "speed_mps", "tstamp"), 11)
_LEVELS |= {"reward": 4, "closest_waypoint": 4}
# Columns with few repeated values are smaller and faster to write byte-split than as dictionaries.
_SPLIT = [*_LEVELS, "steps", "car"]
_ENCODINGS = {**dict.fromkeys(_SPLIT, "BYTE_STREAM_SPLIT"), "episode": "DELTA_BINARY_PACKED"}
_REPEATING = [name for name in TRACE_COLUMNS if name not in _ENCODINGS]


def _stored(field: pa.Field) -> pa.Field:
    if field.name in DECIMALS:
        # A number of nine digits takes four bytes; the clock of a long episode has more.
        digits = pa.decimal64(18, 6) if field.name == "tstamp" else pa.decimal32(9, DECIMALS[field.name])
        return field.with_type(digits)
    return field.with_type(pa.float32()) if field.name == "reward" else field


_STORED = pa.schema([_stored(field) for field in SCHEMA])
"""Types of the columns in a file; they are read as those of `SCHEMA`."""


class TraceWriter:
    """Writes the steps of consecutive iterations into one Parquet file after the other, each atomically.

    A file has the number of its last iteration, `00012-iteration.parquet`. It is complete when it has `MOST_ROWS`, or
    when `flush` is called: before each checkpoint from which the run can be resumed, so that no file has steps of
    before and after it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._iteration = self._rows = 0
        self._steps: list[pa.Table] = []
        self._others: list[pa.Table] = []

    def add(self, iteration: int, steps: pa.Table, others: pa.Table | None = None) -> None:
        """Add the rows of an iteration, and `placement.placements_table` where there are boxes or bots.

        Raises:
            RunFailed: a file is complete and cannot be written (disk full, folder read-only).
        """
        self._keep(iteration, steps.cast(_STORED), others)

    def _keep(self, iteration: int, rounded: pa.Table, others: pa.Table | None) -> None:
        self._steps.append(rounded)
        if others is not None:
            self._others.append(others)
        self._iteration, self._rows = iteration, self._rows + len(rounded)
        if self._rows >= MOST_ROWS:
            self.flush()

    def resume(self, iteration: int) -> None:
        """Resume after an iteration: nothing to restore, every step was written."""

    def flush(self) -> None:
        """Write the rows added since the last file.

        Raises:
            RunFailed: a file cannot be written.
        """
        steps, others, self._steps, self._others, self._rows = self._steps, self._others, [], [], 0
        if steps:
            self._write(
                _ENDING,
                pa.concat_tables(steps).unify_dictionaries().combine_chunks(),
                use_dictionary=_REPEATING,
                column_encoding=_ENCODINGS,
                compression_level=_LEVELS,
                store_decimal_as_integer=True,
                write_statistics=False,
            )
        if others:
            self._write(_OTHERS_ENDING, pa.concat_tables(others))

    def _write(self, ending: str, table: pa.Table, **how: Any) -> None:
        path = self.folder / f"{self._iteration:05d}{ending}"
        unfinished = path.with_name(f".{path.name}")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            pq.write_table(table, unfinished, compression="zstd", **how)
            unfinished.replace(path)
        except OSError as error:
            # Where a file cannot be written, deleting one may fail, too.
            with contextlib.suppress(OSError):
                unfinished.unlink(missing_ok=True)
            raise RunFailed(f"{path}: the trace cannot be written: {error.strerror or error}") from error


class LapWriter(TraceWriter):
    """Writes the steps of complete laps only.

    Those of the episodes under way at a checkpoint wait in `00012-open.parquet`, for a run that is resumed from there.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._open: list[pa.Table] = []

    def resume(self, iteration: int) -> None:
        """Restore the episodes that were under way after an iteration."""
        self._iteration = iteration
        path = self.folder / f"{iteration:05d}{_OPEN_ENDING}"
        if path.is_file():
            self._open = [pq.read_table(path).cast(_STORED)]

    def add(self, iteration: int, steps: pa.Table, others: pa.Table | None = None) -> None:
        """Add the rows of an iteration; raises as `TraceWriter.add`."""
        rows = pa.concat_tables([*self._open, steps.cast(_STORED)]).unify_dictionaries()
        episode, is_last = (rows[name].to_numpy() for name in ("episode", "done"))
        is_lap = pc.equal(pc.cast(rows["episode_status"], pa.string()), "lap_complete").to_numpy()
        laps = np.isin(episode, episode[is_last & is_lap])
        self._open = [rows.filter(pa.array(~np.isin(episode, episode[is_last])))]
        # The rows of a lap were driven in several iterations.
        lap_rows = rows.filter(pa.array(laps))
        self._keep(iteration, lap_rows.take(pa.array(np.argsort(episode[laps], kind="stable"))), others)
        if not laps.any():
            self._steps.pop()  # a run without a lap has no trace

    def flush(self) -> None:
        """Write the laps since the last file, and the episodes under way; raises as `TraceWriter.flush`."""
        super().flush()
        if self._open:
            self._write(_OPEN_ENDING, self._open[0].combine_chunks(), store_decimal_as_integer=True)
            # The one before belongs to the newest checkpoint until there is another.
            for path in sorted(self.folder.glob(f"[!.]*{_OPEN_ENDING}"))[:-2]:
                path.unlink()


def trace_writer(folder: Path, kept: str) -> TraceWriter | None:
    """Return the writer for `full` or `laps`, None for `off`."""
    return {"full": TraceWriter, "laps": LapWriter}[kept](folder) if kept != "off" else None


def has_trace(folder: Path) -> bool:
    """Return whether there is a complete file of a trace."""
    return any(folder.glob(f"[!.]*{_ENDING}"))


def trace_files(folder: Path) -> list[Path]:
    """Return the complete files of a trace, in the order of iterations.

    Raises:
        BadInput: there is none; the line says why.
    """
    files = sorted(folder.glob(f"[!.]*{_ENDING}"))
    if not files:
        raise BadInput(folder, missing_trace(folder.parent), "the folder of a run with its trace")
    return files


def missing_trace(run: Path) -> str:
    """Return in words why a run has no steps to read."""
    try:
        kept = read_config(run).get("trace")
    except BadInput:
        kept = None
    reasons = {
        "off": "has no trace: it was trained with trace=off",
        "laps": "has no trace: trace=laps keeps complete laps, and the run drove none",
    }
    return reasons.get(
        str(kept), "has no trace: `deepracer-exp runs clean` removed it, or the run never drove"
    )


def read_others(folder: Path) -> pa.Table | None:
    """Read the boxes, bots and rivals of a trace, `env.others.placement.SCHEMA`; None where the car was alone.

    Raises:
        BadInput: a file is incomplete or of another kind.
    """
    tables = [_read_others(path) for path in sorted(folder.glob(f"[!.]*{_OTHERS_ENDING}"))]
    return pa.concat_tables(tables) if tables else None


def write_evaluation_others(folder: Path, table: pa.Table, race: RaceConfig, period_s: float) -> Path:
    """Write `placement.placements_table` of an evaluation, whose control period is in seconds, and return the file.

    Raises:
        OSError: it cannot be written.
    """
    written = {"race": json.dumps(asdict(race)), "period_s": repr(period_s)}
    file = folder / EVALUATION_OTHERS
    pq.write_table(table.replace_schema_metadata(written), file, compression="zstd")
    return file


def read_evaluation_others(folder: Path) -> PlacedOthers | None:
    """Read the boxes, bots and rival of an evaluation; None where the car was alone.

    Raises:
        BadInput: the file is incomplete or of another kind.
    """
    file = folder / EVALUATION_OTHERS
    if not os.path.lexists(file):
        return None
    table = _read_others(file)
    try:
        written = pq.read_schema(plain_file(file, _ACCEPTED, LOG_BYTES)).metadata or {}
        race = _RACE.validate_json(written[b"race"])
        period_s = float(written[b"period_s"])
    except (KeyError, ValueError) as error:
        raise BadInput(file, "does not say among whom the car raced", "a file of evaluate --trace") from error
    return PlacedOthers(race=race, episodes=read_placements(table), period_s=period_s)


def _read_others(path: Path) -> pa.Table:
    try:
        table = pq.read_table(plain_file(path, _ACCEPTED, LOG_BYTES))
        return table.select(OTHERS_SCHEMA.names).cast(OTHERS_SCHEMA)
    except (OSError, pa.ArrowInvalid, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise BadInput(path, f"not where the others were ({reason})", _ACCEPTED) from error


def rewind_trace(folder: Path, iteration: int) -> None:
    """Remove files written after an iteration, and incomplete ones."""
    for file in folder.glob("*"):
        number = file.name.partition("-")[0]
        if not number.isdigit() or int(number) > iteration:
            file.unlink()


UNREADABLE = (OSError, pa.ArrowException, KeyError, ValueError)
"""Errors of a file that is incomplete or of another kind."""


def open_trace_file(path: Path) -> pq.ParquetFile:
    """Open one file of a trace for `stored_column`; raises `UNREADABLE`."""
    return pq.ParquetFile(plain_file(path, _ACCEPTED, LOG_BYTES), pre_buffer=False)


def stored_column(file: pq.ParquetFile, name: str) -> pa.ChunkedArray:
    """Read a column of a file with its stored type, a decimal, or that of `SCHEMA`; raises `UNREADABLE`."""
    column = file.read(columns=[name], use_threads=False)[name]
    # Runs of earlier versions have no decimals.
    return column if column.type == _STORED.field(name).type else column.cast(SCHEMA.field(name).type)


def join_stored(name: str, parts: Sequence[pa.ChunkedArray]) -> pa.ChunkedArray:
    """Join the parts of a column, one after the other."""
    if any(part.type != parts[0].type for part in parts):
        parts = [part.cast(SCHEMA.field(name).type) for part in parts]
    return pa.chunked_array([chunk for part in parts for chunk in part.chunks], parts[0].type)


def stored_values(
    column: pa.ChunkedArray, rows: NDArray[np.intp] | None = None
) -> "NDArray[Any] | pd.Categorical":
    """Return rows (None: all) of a stored column: numbers, NaN where one is missing, flags, or words."""
    kind = column.type
    if pa.types.is_dictionary(kind):
        words = column.unify_dictionaries().to_pandas().array
        return words if rows is None else words.take(rows)
    if pa.types.is_decimal(kind):
        # Arrow divides each number by itself, which takes fifty times as long.
        digits = column.combine_chunks().view(f"int{kind.bit_width}")
        values: NDArray[Any] = digits.to_numpy(zero_copy_only=False) / 10.0**kind.scale
    else:
        values = column.to_numpy()
    return values if rows is None else values[rows]


def read_trace(folder: Path, columns: Sequence[str] = TRACE_COLUMNS) -> "pd.DataFrame":
    """Read the trace of a run, in the order of iterations.

    An episode may continue in the next iteration: its rows need not be adjacent.

    Raises:
        BadInput: there is no trace, or a file is incomplete or of another kind.
    """
    import pandas as pd

    read: dict[str, Any] = {}
    paths = trace_files(folder)
    path = paths[0]
    with contextlib.ExitStack() as stack:
        try:
            files = {}
            for path in paths:
                files[path] = stack.enter_context(open_trace_file(path))
            # Column by column, so that the memory in which one was unpacked is used again for the next.
            for name in columns:
                parts = []
                for path in paths:
                    parts.append(stored_column(files[path], name))
                read[name] = stored_values(join_stored(name, parts))
        except UNREADABLE as error:
            reason = " ".join(str(error).split())
            raise BadInput(path, f"not a trace ({reason})", "a complete Parquet file of a run") from error
    for name, values in read.items():
        kind = SCHEMA.field(name).type
        if pa.types.is_floating(kind):
            read[name] = values.astype(kind.to_pandas_dtype(), copy=False)
    return pd.DataFrame(read, copy=False)
