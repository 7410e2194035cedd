"""The params dict that a reward function gets, as AWS DeepRacer defines it."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.tracks.track import Track

Waypoints = list[tuple[float, float]]
Row = tuple[Any, ...]

_DTYPES: dict[str, type] = {
    **dict.fromkeys(("x", "y", "heading", "distance_from_center", "projection_distance"), np.float64),
    **dict.fromkeys(("progress", "steps", "speed", "steering_angle", "track_width", "sim_time"), np.float64),
    **dict.fromkeys(("all_wheels_on_track", "is_left_of_center", "is_offtrack"), np.bool_),
    "closest_waypoints": np.int64,
}
COLUMNS = tuple(_DTYPES)
"""The keys that differ from car to car: one row per car, two numbers a row in `closest_waypoints`."""
_WAYPOINTS_PLACE = COLUMNS.index("closest_waypoints")
BATCH_COLUMNS = (*COLUMNS, "previous_progress")
"""Columns of `reward_batch`, with the progress at the last step, which a `reward_function` remembers by itself.

It is in per cent of the lap; at an episode's first rewarded step, it is the progress itself.
"""


MASK = "objects_mask"
"""The extra key of `reward_batch`: the mask of the filled entries in the arrays about others, (N, K); those of a car
come first."""
_ALONE: dict[str, tuple[tuple[int, ...], type]] = {
    "is_crashed": ((), np.bool_),
    "closest_objects": ((2,), np.int64),
    "objects_location": ((0, 2), np.float64),
    "objects_left_of_center": ((0,), np.bool_),
    "object_in_camera": ((), np.bool_),
    "objects_speed": ((0,), np.float64),
    "objects_heading": ((0,), np.float64),
    "objects_distance_from_center": ((0,), np.float64),
    "objects_distance": ((0,), np.float64),
    MASK: ((0,), np.bool_),
}
"""Shape for each car and type of the columns about others where a car is alone."""
OBJECT_COLUMNS = tuple(_ALONE)[:-1]
"""The keys about boxes and bots, one row per car: of K others (N, K), `objects_location` (N, K, 2); `is_crashed` and
`object_in_camera` (N,), `closest_objects` (N, 2). Columns have them only where there are others."""


class TrackParams(NamedTuple):
    """The keys that are constant on a course."""

    waypoints: Waypoints
    """Centre line of the direction driven, closing point included."""
    track_length: float
    """Metres."""
    is_reversed: bool
    """Whether the track is driven against its waypoint order."""

    @classmethod
    def of(cls, track: Track) -> "TrackParams":
        """Return the constant keys of a course."""
        return cls([(x, y) for x, y in track.waypoints.tolist()], track.length_m, track.reversed)


def select(columns: Mapping[str, np.ndarray], cars: NDArray[np.intp] | None) -> dict[str, np.ndarray]:
    """Return the columns of the given cars (None: all), each as a copy of its documented type."""
    chosen: dict[str, np.ndarray] = {}
    for key in BATCH_COLUMNS:
        column, dtype = columns[key], _DTYPES.get(key, np.float64)
        chosen[key] = np.array(column, dtype) if cars is None else column[cars].astype(dtype, copy=False)
    if MASK in columns:
        for key in (*OBJECT_COLUMNS, MASK):
            chosen[key] = columns[key].copy() if cars is None else columns[key][cars]
    return chosen


def rows(selected: Mapping[str, np.ndarray]) -> Iterable[Row]:
    """Return one tuple of Python values per car, in the order of `row_keys`."""
    return zip(*(selected[key].tolist() for key in row_keys(selected)), strict=True)


def row_keys(selected: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Return the keys of rows: `COLUMNS`, and after them `OBJECT_COLUMNS` where there are others."""
    return (*COLUMNS, *OBJECT_COLUMNS) if MASK in selected else COLUMNS


def scalar_params(row: Row, road: TrackParams, keys: tuple[str, ...] = COLUMNS) -> dict[str, Any]:
    """Build the 27 keys for one car.

    Every list is a new one, so that a reward function cannot change those of another call; the keys about other objects
    that the row has not hold the defaults of an empty road (deepracer-simapp agent_ctrl/constants.py).

    Args:
        row: One tuple of `rows`; lengths in metres, angles in degrees, speeds in m/s, time in seconds.
        road: The keys that are constant on the course.
        keys: The `row_keys` of the row.
    """
    params: dict[str, Any] = dict(
        track_length=road.track_length,
        waypoints=road.waypoints[:],
        is_reversed=road.is_reversed,
        is_crashed=False,
        closest_objects=[0, 0],
        objects_location=[],
        objects_left_of_center=[],
        object_in_camera=False,
        objects_speed=[],
        objects_heading=[],
        objects_distance_from_center=[],
        objects_distance=[],
    )
    params.update(zip(keys, row, strict=True))
    params["closest_waypoints"] = row[_WAYPOINTS_PLACE][:]
    return params


def batch_params(
    selected: Mapping[str, np.ndarray],
    road: TrackParams,
    waypoints: np.ndarray,
) -> dict[str, Any]:
    """Build the same 27 keys, `previous_progress` and `objects_mask` for n cars at once, for `reward_batch`.

    Arrays about K others have a column for each of them, none where the cars are alone.

    Args:
        selected: Columns of `select`, shape (n,), `closest_waypoints` (n, 2).
        road: The keys that are constant on the course.
        waypoints: Those of the course as an array, (W, 2); copied.
    """
    n = len(selected["x"])
    params: dict[str, Any] = dict(selected)
    params["track_length"], params["is_reversed"] = road.track_length, road.is_reversed
    params["waypoints"] = waypoints.copy()
    for key, (shape, dtype) in _ALONE.items():
        if key not in params:
            params[key] = np.zeros((n, *shape), dtype)
    return params
