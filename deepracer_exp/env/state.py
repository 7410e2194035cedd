"""Positions of cars relative to the track, and arrays of cars read back from a checkpoint."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.errors import BadInput
from deepracer_exp.jit import compiled
from deepracer_exp.sim.batch import CarState
from deepracer_exp.tracks.segments import border_point, project_point
from deepracer_exp.tracks.track import TrackIndex, Tracks

Floats = NDArray[np.float64]

STILL_M = 0.01
"""Movement below which a car has no direction of travel."""
_PAIRS = ("front", "closest_waypoints")
"""Arrays with two numbers per car."""
_TYPES = {"closest_waypoints": np.int64, "is_left": np.bool_}
"""Types of the arrays that are not float64."""


def checked_array(state: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of the array `name` of a state_dict.

    Raises:
        BadInput: there is none, or it has another shape.
    """
    array = state.get(name)
    actual = f"shape {array.shape}" if isinstance(array, np.ndarray) else "no array"
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise BadInput(
            f"the checkpoint does not fit: '{name}' of its cars has {actual}, these cars need {shape}; accepted: a "
            "checkpoint of as many cars, on the same tracks, with the same features"
        )
    return array.copy()


@dataclass(frozen=True, eq=False)
class Measures:
    """Poses, and where they are on the track; arrays with one row per car.

    All geometry is that of the car's front point, as on the service (deepracer-simapp: model origin + 0.14 m).
    """

    x_m: Floats
    """Chassis origin."""
    y_m: Floats
    yaw_rad: Floats
    speed_mps: Floats
    yaw_rate_radps: Floats
    front: Floats
    """Front point, (N, 2)."""
    ndist: Floats
    """Projection on the centre line over its length."""
    distance_m: Floats
    """Distance from the centre line."""
    offset_m: Floats
    """Distance from the centre line, positive to the left."""
    closest_waypoints: NDArray[np.int64]
    """Index of the waypoint behind and of the one ahead, (N, 2)."""
    heading_error_rad: Floats
    """Yaw against the centre line's heading, -pi to pi."""
    track_width_m: Floats
    is_left: NDArray[np.bool_]

    @classmethod
    def of(cls, car: CarState, front_point_m: float, tracks: Tracks, track_index: TrackIndex) -> "Measures":
        """Measure cars (N,), whose front point is `front_point_m` ahead of the origin, each against its course (N,)."""
        poses = car.x_m, car.y_m, car.yaw_rad
        measured = _measure(poses, front_point_m, tracks.lines, tracks.clockwise, track_index)
        return cls(car.x_m, car.y_m, car.yaw_rad, car.speed_mps, car.yaw_rate_radps, *measured)

    @classmethod
    def example(cls, n_cars: int) -> "Measures":
        """Return dummy measures, all 1, with consistent shapes."""
        return cls(
            **{
                field.name: np.ones((n_cars, 2) if field.name in _PAIRS else n_cars, _TYPES.get(field.name))
                for field in fields(cls)
            }
        )

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all arrays."""
        return {field.name: getattr(self, field.name).copy() for field in fields(self)}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], n_cars: int) -> "Measures":
        """Restore a `state_dict`."""
        return cls(
            **{
                field.name: checked_array(
                    state, field.name, (n_cars, 2) if field.name in _PAIRS else (n_cars,)
                )
                for field in fields(cls)
            }
        )

    def replace(self, ids: NDArray[np.intp], those: "Measures") -> None:
        """Replace the rows of the cars `ids` by those of `those`."""
        mine, others = vars(self), vars(those)
        for name, values in mine.items():
            values[ids] = others[name]


@compiled
def _measure(poses, front_point_m, lines, clockwise, track_index):  # type: ignore[no-untyped-def]
    """Return the arrays of `Measures` from `front` on; `lines` are those of `Tracks`."""
    x_m, y_m, yaw_rad = poses
    center, inner, outer = lines
    cars = len(x_m)
    front, ndist, closest = np.empty((cars, 2)), np.empty(cars), np.empty((cars, 2), np.int64)
    distance_m, offset_m, error_rad = np.empty(cars), np.empty(cars), np.empty(cars)
    width_m, is_left = np.empty(cars), np.empty(cars, np.bool_)
    for car in range(cars):
        line = track_index[car]
        x = x_m[car] + front_point_m * math.cos(yaw_rad[car])
        y = y_m[car] + front_point_m * math.sin(yaw_rad[car])
        share, _, offset, previous, following, center_x, center_y, heading_rad = project_point(
            center, line, x, y
        )
        width_m[car], is_left[car] = border_point(
            inner, outer, line, x, y, center_x, center_y, clockwise[line]
        )
        front[car, 0], front[car, 1], ndist[car] = x, y, share
        distance_m[car], offset_m[car] = abs(offset), offset
        closest[car, 0], closest[car, 1] = previous, following
        error_rad[car] = (yaw_rad[car] - heading_rad + math.pi) % (2 * math.pi) - math.pi
    return front, ndist, distance_m, offset_m, closest, error_rad, width_m, is_left
