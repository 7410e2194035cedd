"""The simulation trace of a run: one row a control step, with the service's columns and our own."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from deepracer_exp.config.driving import QUANTITIES

EPISODE_STATUS = (
    "prepare",
    "in_progress",
    "lap_complete",
    "off_track",
    "crashed",
    "immobilized",
    "reversed",
    "pause",
    "park",
    "time_up",
)
"""The service's names; the position is the code in packed rows. An episode that reaches the limit of steps is
`time_up`."""
STATUS_CODE = {status: code for code, status in enumerate(EPISODE_STATUS)}

_STATUS = pa.dictionary(pa.int8(), pa.string())
_TRACK = pa.dictionary(pa.int16(), pa.string())
_COLUMNS: tuple[tuple[str, pa.DataType, str], ...] = (
    # The service's columns, in its order (deepracer-simapp, markov/metrics/constants.py).
    ("episode", pa.int32(), "counted from 0 over the whole run, in the order in which episodes begin"),
    ("steps", pa.int32(), "control step of the episode, 1 is the prepare step"),
    ("X", pa.float64(), "m, front of the car"),
    ("Y", pa.float64(), "m, front of the car"),
    ("yaw", pa.float64(), "degrees, -180 to 180, counter-clockwise from +x"),
    ("steer", pa.float64(), "degrees commanded, positive to the left"),
    ("throttle", pa.float64(), "m/s commanded"),
    ("action", pa.int32(), "action number; null for a continuous action space"),
    ("reward", pa.float64(), "reward units"),
    ("done", pa.bool_(), "last step of the episode"),
    ("all_wheels_on_track", pa.bool_(), "every wheel centre on the road"),
    ("progress", pa.float64(), "per cent of the lap"),
    ("closest_waypoint", pa.int32(), "index of the nearer of the two waypoints around"),
    ("track_len", pa.float64(), "m"),
    ("tstamp", pa.float64(), "s, simulated time"),
    ("episode_status", _STATUS, " ".join(EPISODE_STATUS)),
    ("pause_duration", pa.float64(), "s of penalty left"),
    ("obstacle_crash_counter", pa.int32(), "obstacles hit"),
    # Ours.
    ("car", pa.int32(), "number of the car over all processes"),
    ("track", _TRACK, "name of the course"),
    ("iteration", pa.int32(), "policy update that used the row, from 1"),
    ("speed_mps", pa.float32(), "m/s measured"),
    *((name, pa.float32(), unit) for name, unit in QUANTITIES.items()),
)
TRACE_COLUMNS = tuple(name for name, _, _ in _COLUMNS)
"""Columns of a written trace."""
PACKED_COLUMNS = (
    *(
        name
        for name in TRACE_COLUMNS
        if name not in ("pause_duration", "obstacle_crash_counter", "iteration")
    ),
    "episode_return",
)
"""Columns of packed rows, the float64 matrix in which a trace is passed between processes; booleans are 0 or 1,
`episode_status` is its code, `track` the course's index in the experiment, `action` is NaN for a continuous action
space, and `episode_return` the sum of the episode's rewards up to here."""
PACKED = {name: place for place, name in enumerate(PACKED_COLUMNS)}
"""Column number of each packed column."""
OTHERS_PACKED = ("own_episode", "bots_stopped")
"""Further columns with boxes or bots: the episode's number among those of its car, and whether all bots stopped in this
step because one had hit the car."""
RIVAL_PACKED = ("rival_x", "rival_y", "rival_yaw")
"""Further columns in a race against a rival: x and y of its origin in metres, and its yaw in radians."""
SCHEMA = pa.schema([pa.field(name, kind, metadata={"unit": unit}) for name, kind, unit in _COLUMNS])


def to_table(packed: NDArray[np.float64], iteration: int, tracks: Sequence[str]) -> pa.Table:
    """Turn packed rows into a table with the types and units of `SCHEMA`.

    `packed` is (n, len(PACKED_COLUMNS)); `iteration` is the policy update that used the rows, from 1.

    Raises:
        ValueError: the shape is wrong, or a code of a status or course is unknown.
    """
    if packed.ndim != 2 or packed.shape[1] != len(PACKED_COLUMNS):
        raise ValueError(f"packed rows of shape {packed.shape}; accepted: (n, {len(PACKED_COLUMNS)})")
    rows = len(packed)
    extra = {"pause_duration": 0.0, "obstacle_crash_counter": 0, "iteration": iteration}
    columns = []
    for name, kind, _ in _COLUMNS:
        values = packed[:, PACKED[name]] if name in PACKED else np.full(rows, extra[name])
        if kind is _STATUS:
            columns.append(_words(name, values, EPISODE_STATUS, np.int8))
        elif kind is _TRACK:
            columns.append(_words(name, values, tracks, np.int16))
        else:
            columns.append(_column(values, kind))
    return pa.Table.from_arrays(columns, schema=SCHEMA)


def _words(name: str, codes: NDArray[np.float64], words: Sequence[str], dtype: type) -> pa.Array:
    # Arrow would accept a code out of range and fail only when it is read.
    unknown = ~np.isin(codes, np.arange(len(words)))
    if unknown.any():
        raise ValueError(f"{name} code {codes[unknown][0]:g}; known: 0 to {len(words) - 1}")
    return pa.DictionaryArray.from_arrays(codes.astype(dtype), pa.array(words, pa.string()))


def _column(values: NDArray[np.float64], kind: pa.DataType) -> pa.Array:
    if pa.types.is_floating(kind):
        return pa.array(np.ascontiguousarray(values), kind)
    missing = np.isnan(values)
    if pa.types.is_boolean(kind):
        return pa.array(values != 0, kind)
    return pa.array(np.where(missing, 0, values).astype(kind.to_pandas_dtype()), kind, mask=missing)
