"""The files of a run's trace: one Parquet file an iteration."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from deepracer_exp.env.placement import SCHEMA as OTHERS_SCHEMA
from deepracer_exp.env.trace import SCHEMA, TRACE_COLUMNS
from deepracer_exp.errors import BadInput, RunFailed

if TYPE_CHECKING:
    import pandas as pd

_ENDING, _OTHERS_ENDING = "-iteration.parquet", "-others.parquet"
_CONTINUOUS = (
    *("X", "Y", "yaw", "reward", "progress", "tstamp"),
    *("speed_mps", "yaw_rate_radps", "offset_m", "heading_error_rad", "episode_return"),
)
# Columns with few repeated values take a quarter less space byte-split than as dictionaries (49 instead of 68 bytes
# a row on a console training), and are written twice as fast.
_REPEATING = [name for name in TRACE_COLUMNS if name not in _CONTINUOUS]


class TraceWriter:
    """Writes one Parquet file an iteration, atomically."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, iteration: int, table: pa.Table) -> Path:
        """Write the rows of one iteration and return the file, `00012-iteration.parquet`.

        Raises:
            RunFailed: the file cannot be written (disk full, folder read-only).
        """
        encoding = dict.fromkeys(_CONTINUOUS, "BYTE_STREAM_SPLIT")
        name = f"{iteration:05d}{_ENDING}"
        return self._write(name, table, use_dictionary=_REPEATING, column_encoding=encoding)

    def write_others(self, iteration: int, table: pa.Table) -> Path:
        """Write `placement.placements_table` of an iteration and return the file, `00012-others.parquet`.

        Raises:
            RunFailed: the file cannot be written.
        """
        return self._write(f"{iteration:05d}{_OTHERS_ENDING}", table)

    def _write(self, name: str, table: pa.Table, **how: Any) -> Path:
        path = self.folder / name
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
        return path


def trace_files(folder: Path) -> list[Path]:
    """Return the complete files of a trace, in the order of iterations.

    Raises:
        BadInput: there is none.
    """
    files = sorted(path for path in folder.glob(f"*{_ENDING}") if not path.name.startswith("."))
    if not files:
        raise BadInput(folder, f"no *{_ENDING}", "the folder of a run with its trace")
    return files


def read_others(folder: Path, least_iteration: int = 0) -> pa.Table | None:
    """Read where the boxes and bots of a trace were, `env.placement.SCHEMA`; None where nobody else was on the road.

    Raises:
        BadInput: a file is incomplete or of another kind.
    """
    tables = []
    for path in sorted(folder.glob(f"*{_OTHERS_ENDING}")):
        if path.name.startswith(".") or int(path.name.partition("-")[0]) < least_iteration:
            continue
        try:
            tables.append(pq.read_table(path).cast(OTHERS_SCHEMA))
        except (OSError, pa.ArrowInvalid, ValueError) as error:
            reason = " ".join(str(error).split())
            raise BadInput(
                path, f"not where the others were ({reason})", "a complete Parquet file of a run"
            ) from error
    return pa.concat_tables(tables) if tables else None


def rewind_trace(folder: Path, iteration: int) -> None:
    """Remove what was written after an iteration, and files that were not completed."""
    for file in folder.glob("*"):
        number = file.name.partition("-")[0]
        if not number.isdigit() or int(number) > iteration:
            file.unlink()


def read_trace(folder: Path, columns: Sequence[str] = TRACE_COLUMNS) -> "pd.DataFrame":
    """Read the trace of a run, in the order of iterations.

    An episode may continue in the next iteration: its rows need not be adjacent.

    Raises:
        BadInput: there is no trace, or a file is incomplete or of another kind.
    """
    schema = pa.schema([SCHEMA.field(name) for name in columns])
    tables = []
    for path in trace_files(folder):
        try:
            tables.append(pq.read_table(path, columns=list(columns)).cast(schema))
        except (OSError, pa.ArrowInvalid, ValueError) as error:
            reason = " ".join(str(error).split())
            raise BadInput(path, f"not a trace ({reason})", "a complete Parquet file of a run") from error
    return pa.concat_tables(tables).to_pandas()
