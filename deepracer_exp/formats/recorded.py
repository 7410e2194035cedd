"""Recorded drives of the service, of any generation: its trace CSVs and the SIM_TRACE_LOG lines of its logs."""

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from deepracer_exp.errors import BadInput

_MARKER = "SIM_TRACE_LOG:"
_COMMON = (
    *("episode", "steps", "X", "Y", "yaw", "steer", "throttle", "action", "reward", "done"),
    *("all_wheels_on_track", "progress", "closest_waypoint", "track_len", "tstamp"),
)
# What follows the first 15 fields of a log line, by the number of fields (deepracer-simapp metrics/constants.py and
# deepracer-utils logs/log_utils.py: a line of 18 has no obstacle counter).
_GENERATIONS = {
    15: (),
    16: ("episode_status",),
    17: ("episode_status", "pause_duration"),
    18: ("episode_status", "pause_duration", "wall_clock"),
    19: ("episode_status", "pause_duration", "obstacle_crash_counter", "wall_clock"),
}
_EPISODES_PER_ITERATION = 20
"""The service's default; a log does not say in its trace lines to which iteration an episode belongs."""
_BOOLEANS = ("done", "all_wheels_on_track")
_WHOLE = ("episode", "steps", "closest_waypoint")
RECORDED_COLUMNS = (*_COMMON, "episode_status", "pause_duration", "iteration", "file")


def read_recorded(path: Path) -> pd.DataFrame:
    """Read the recorded drives in a file or anywhere below a folder.

    Where a folder holds trace CSVs, its text logs are left aside: they tell the same drives in fewer digits.

    Args:
        path: an `N-iteration.csv`, a text log with SIM_TRACE_LOG lines, or a folder of either.

    Returns:
        One row a control step in the order of files and lines. Columns `RECORDED_COLUMNS`: names and units as in the
        service's CSV (X, Y in m of the front point; yaw, steer in degrees, those of 2019 turned from radians;
        throttle in m/s; tstamp in s), `action` NaN where it is no number, `episode_status` "" where the generation
        has none, `pause_duration` 0 likewise; `iteration`; `file`, the path read.

    Raises:
        BadInput: nothing is there, nothing is recorded in it, or a line is torn.
    """
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder; accepted: trace CSVs or logs of the service")
    tables = [_read_csv(file) for file in _files(path, ".csv")]
    if not tables:
        tables = [table for file in _files(path, ".log") if (table := _read_log(file)) is not None]
    if not tables:
        raise BadInput(
            f"{path}: no recorded drive; accepted: *-iteration.csv, or text logs with {_MARKER} lines"
        )
    return pd.concat(tables, ignore_index=True)


def _files(path: Path, suffix: str) -> list[Path]:
    if path.is_file():
        # A rolled log ends in .log.1 and the like.
        found = path.suffix == ".csv" if suffix == ".csv" else path.suffix != ".csv"
        return [path] if found else []
    pattern = "*-iteration.csv" if suffix == ".csv" else "*.log*"
    return sorted((file for file in path.rglob(pattern) if file.is_file()), key=_by_number)


def _by_number(path: Path) -> tuple[str, int, str]:
    """Sort 10-iteration.csv after 9-iteration.csv."""
    number = re.match(r"\d+", path.name)
    return str(path.parent), int(number[0]) if number else -1, path.name


def _read_csv(path: Path) -> pd.DataFrame:
    rows = list(csv.reader(io.StringIO(_text(path))))
    if not rows:
        raise BadInput(f"{path}: empty; accepted: a trace with a line of column names")
    header = [name.strip() for name in rows[0]]
    missing = [name for name in _COMMON if name not in header]
    if missing:
        raise BadInput(f"{path}: no column {', '.join(missing)}; accepted: a trace of the service")
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise BadInput(f"{path}:{number}: {len(row)} values under {len(header)} column names")
    number_of_file = re.match(r"(\d+)-iteration", path.name)
    iteration = int(number_of_file[1]) if number_of_file else 0
    return _table(path, rows[1:], header).assign(iteration=iteration, file=str(path))[list(RECORDED_COLUMNS)]


def _read_log(path: Path) -> pd.DataFrame | None:
    """Read the trace lines of a log; None where it has none."""
    lines = _text(path).splitlines()
    rows: list[list[str]] = []
    for number, line in enumerate(lines, start=1):
        _, marker, values = line.partition(_MARKER)
        if not marker:
            continue
        row = values.strip().split(",")
        if len(row) not in _GENERATIONS or (rows and len(row) != len(rows[0])):
            if number == len(lines) and len(row) < 20:
                break  # cut off while it was being written
            raise BadInput(
                f"{path}:{number}: a trace line of {len(row)} values; accepted: {len(rows[0]) if rows else '15 to 19'}"
            )
        rows.append(row)
    if not rows:
        return None
    table = _table(path, rows, [*_COMMON, *_GENERATIONS[len(rows[0])]])
    if len(rows[0]) == min(_GENERATIONS):  # the lines of 2019 have radians
        table[["yaw", "steer"]] *= 180.0 / math.pi
    iteration = table["episode"] // _EPISODES_PER_ITERATION
    return table.assign(iteration=iteration, file=str(path))[list(RECORDED_COLUMNS)]


def _table(path: Path, rows: Sequence[Sequence[str]], header: Sequence[str]) -> pd.DataFrame:
    columns: dict[str, Iterable[object]] = {}
    by_name = dict(zip(header, zip(*rows, strict=True) if rows else ((),) * len(header), strict=True))
    for name in _COMMON:
        values = by_name[name]
        if name in _BOOLEANS:
            columns[name] = [value.strip() in ("True", "1", "true") for value in values]
        elif name == "action":
            # Continuous actions are two numbers in brackets; steer and throttle tell the same.
            columns[name] = [math.nan if "[" in value else _number(path, name, value) for value in values]
        else:
            columns[name] = [_number(path, name, value) for value in values]
    columns["episode_status"] = [status.strip() for status in by_name.get("episode_status", [""] * len(rows))]
    pause = by_name.get("pause_duration")
    columns["pause_duration"] = (
        [0.0] * len(rows) if pause is None else [_number(path, "pause_duration", value) for value in pause]
    )
    return pd.DataFrame(columns).astype(dict.fromkeys(_WHOLE, int))


def _number(path: Path, name: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        raise BadInput(f"{path}: {name} is {value!r}; accepted: a number") from None
    if name in _WHOLE and not math.isfinite(number):
        raise BadInput(f"{path}: {name} is {value!r}; accepted: a whole number")
    return number


def _text(path: Path) -> str:
    try:
        # Logs hold what users print, in any encoding.
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror or error}") from error
