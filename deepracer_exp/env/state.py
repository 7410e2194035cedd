"""Positions of cars relative to the track, and arrays of cars read back from a checkpoint."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.errors import BadInput
from deepracer_exp.sim.batch import CarState
from deepracer_exp.tracks.track import TrackIndex, Tracks

Floats = NDArray[np.float64]

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
        front = np.empty((len(car.x_m), 2))
        front[:, 0] = car.x_m + front_point_m * np.cos(car.yaw_rad)
        front[:, 1] = car.y_m + front_point_m * np.sin(car.yaw_rad)
        projection = tracks.project(front, track_index)
        track_width_m, is_left = tracks.border_distances(front, projection.center, track_index)
        error = car.yaw_rad - projection.heading_rad
        closest = np.empty((len(front), 2), np.int64)
        closest[:, 0], closest[:, 1] = projection.previous, projection.next
        return cls(
            x_m=car.x_m,
            y_m=car.y_m,
            yaw_rad=car.yaw_rad,
            speed_mps=car.speed_mps,
            yaw_rate_radps=car.yaw_rate_radps,
            front=front,
            ndist=projection.ndist,
            distance_m=np.abs(projection.offset_m),
            offset_m=projection.offset_m,
            closest_waypoints=closest,
            heading_error_rad=np.mod(error + np.pi, 2 * np.pi) - np.pi,
            track_width_m=track_width_m,
            is_left=is_left,
        )

    @classmethod
    def example(cls, n_cars: int) -> "Measures":
        """Return measures that fit together in shape only, all 1."""
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
        for field in fields(self):
            getattr(self, field.name)[ids] = getattr(those, field.name)
