"""The features of an observation."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from deepracer_exp.config.driving import ObservationConfig, ObservationShape
from deepracer_exp.config.own_class import OwnClass, build_own
from deepracer_exp.errors import BadInput, reading
from deepracer_exp.jit import compiled
from deepracer_exp.sim.batch import CarState
from deepracer_exp.tracks.segments import pose_at
from deepracer_exp.tracks.track import TrackIndex, Tracks

from .state import Measures

OF_CAR = (
    "offset",
    "heading_error_sin",
    "heading_error_cos",
    "speed",
    "yaw_rate",
    "last_steering",
    "last_speed",
)
"""Features of the car on the road, in the order in which `_features` writes them."""
OTHERS = ("gap", "side", "closing", "bot")
"""Features of each of the next boxes and bots, see `RaceOthers.features`."""
SLIDING = ("side_speed", "wheel_angle")
"""Features of a car that slides: its speed to the left, and the angle that its front wheels have reached."""
_ABSENT = np.array([1, 0, 0, 0], np.float32)
"""Values of these features where there is no box or bot."""


class ObservationPart:
    """Features of your own, appended to ours; it keeps no state, because a resumed run builds it again.

    Attributes:
        names: of its features, in their order.
    """

    names: tuple[str, ...] = ()

    def compute(self, now: Measures, steering_deg: np.ndarray, commanded_mps: np.ndarray) -> np.ndarray:
        """Return the features of N cars, shape (N, len(names)), each scaled to about -1..1.

        Args:
            now: poses against the track, arrays with one row per car.
            steering_deg: last commanded steering (N,).
            commanded_mps: last commanded speed (N,).
        """
        raise NotImplementedError


def build_parts(config: ObservationConfig) -> tuple[ObservationPart, ...]:
    """Build the user's own parts.

    Raises:
        BadInput: a class cannot be used.
    """
    return tuple(map(_build_part, config.parts))


def _build_part(described: OwnClass) -> ObservationPart:
    """Build a part and check its features for two cars: NumPy would broadcast a single column over missing ones."""
    part, what = (
        build_own(described, "observation.target", ObservationPart),
        f"observation.target={described.target}",
    )
    names = part.names
    if not isinstance(names, tuple | list) or not names or not all(isinstance(name, str) for name in names):
        raise BadInput(what, f"names={names!r}", 'a tuple of text, as in names = ("side_force",)')
    with reading(what):
        shape = np.shape(part.compute(Measures.example(2), np.zeros(2), np.zeros(2)))
    if shape != (2, len(names)):
        raise BadInput(
            f"{what}: compute returns the shape {shape} for two cars; accepted: (2, {len(names)}), as many columns as "
            "names"
        )
    return part


def feature_names(config: ObservationConfig) -> tuple[str, ...]:
    """Return the names of the features, in their order.

    Raises:
        BadInput: one of the user's own parts cannot be used.
    """
    return _names(config, build_parts(config))


def observation_shape(config: ObservationConfig) -> ObservationShape:
    """Return the shape of the observation.

    Raises:
        BadInput: one of the user's own parts cannot be used.
    """
    return ObservationShape(
        len(feature_names(config)),
        None if config.camera is None else config.camera.shape,
        None if config.lidar is None else config.lidar.size,
    )


def _names(config: ObservationConfig, parts: Sequence[ObservationPart]) -> tuple[str, ...]:
    return (
        *OF_CAR,
        *(f"ahead_{axis}_{distance:g}" for distance in config.lookahead_m for axis in "xy"),
        *(SLIDING if config.sliding else ()),
        *(f"next_{number}_{what}" for number in range(1, config.next_objects + 1) for what in OTHERS),
        *(name for part in parts for name in part.names),
    )


class Features:
    """Feature vector of a car, each entry scaled to about -1..1.

    In order: `offset` from the centre line over half the road's width, positive to the left; `heading_error_sin`
    and `heading_error_cos` of the car's yaw against the centre line; `speed` and `yaw_rate` as measured;
    `last_steering` and `last_speed` as last commanded, over the largest of the action space; then for each
    look-ahead distance `ahead_x_D` and `ahead_y_D`: the centre line's point D metres further on in the frame
    of the car's front point, x forward and y to the left; then, with `sliding`, `side_speed` to the left of the heading
    and `wheel_angle` over the largest of the action space; then `next_N_gap` and so on of the next boxes and bots
    (`RaceOthers.features`); then those of the parts.
    """

    def __init__(
        self,
        config: ObservationConfig,
        tracks: Tracks,
        steering_max_deg: float,
        speed_max_mps: float,
        parts: Sequence[ObservationPart] = (),
    ):
        self._config, self._tracks = config, tracks
        self._ahead_ndist = np.asarray(config.lookahead_m) / tracks.length_m[:, None]
        self._scales = _Scales(
            float(config.speed_scale_mps),
            float(config.yaw_rate_scale_radps),
            float(steering_max_deg),
            float(speed_max_mps),
            float(config.lookahead_scale_m),
        )
        self._parts = parts
        self.names = _names(config, parts)

    def compute(
        self,
        now: Measures,
        track_index: TrackIndex,
        steering_deg: np.ndarray,
        commanded_mps: np.ndarray,
        car: CarState,
        others: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the features, shape (N, len(names)), float32.

        Args:
            now: poses against the track.
            track_index: index of each car's track, (N,).
            steering_deg: last commanded steering (N,).
            commanded_mps: last commanded speed (N,).
            car: motion of each car, as measured for `now`.
            others: features of the next boxes and bots, (N, len(OTHERS) * next_objects); None: there are none.
        """
        config = self._config
        out = np.empty((len(now.front), len(self.names)), np.float32)
        observed = _Observed(
            now.front,
            now.yaw_rad,
            now.speed_mps,
            now.yaw_rate_radps,
            now.ndist,
            now.offset_m,
            now.heading_error_rad,
            now.track_width_m,
            track_index,
            steering_deg,
            commanded_mps,
        )
        center, closed = self._tracks.lines[0], self._tracks.closed
        _features(observed, self._scales, center, closed, self._ahead_ndist, out)
        end = len(OF_CAR) + 2 * len(config.lookahead_m)
        if config.sliding:
            out[:, end] = car.lateral_mps / self._scales.speed_mps
            out[:, end + 1] = np.degrees(car.wheel_angle_rad) / self._scales.steering_deg
            end += len(SLIDING)
        if config.next_objects:
            begin, end = end, end + len(OTHERS) * config.next_objects
            out[:, begin:end] = np.tile(_ABSENT, config.next_objects) if others is None else others
        for part in self._parts:
            begin, end = end, end + len(part.names)
            out[:, begin:end] = part.compute(now, steering_deg, commanded_mps)
        return out


class _Scales(NamedTuple):
    """Divisors that scale the features."""

    speed_mps: float
    yaw_rate_radps: float
    steering_deg: float
    commanded_mps: float
    lookahead_m: float


class _Observed(NamedTuple):
    """Inputs of the features; arrays as in `Measures` and `Features.compute`."""

    front: np.ndarray
    yaw_rad: np.ndarray
    speed_mps: np.ndarray
    yaw_rate_radps: np.ndarray
    ndist: np.ndarray
    offset_m: np.ndarray
    heading_error_rad: np.ndarray
    track_width_m: np.ndarray
    track_index: np.ndarray
    steering_deg: np.ndarray
    commanded_mps: np.ndarray


@compiled
def _features(observed, scales, center, closed, ahead_ndist, out):  # type: ignore[no-untyped-def]
    """Write the features up to those of the look-ahead distances.

    `center` are the centre lines, of which some are closed, `ahead_ndist` the distances as shares of them, (W, D).
    """
    front = observed.front
    for car in range(len(out)):
        line, yaw_rad = observed.track_index[car], observed.yaw_rad[car]
        out[car, 0] = 2 * observed.offset_m[car] / observed.track_width_m[car]
        out[car, 1] = math.sin(observed.heading_error_rad[car])
        out[car, 2] = math.cos(observed.heading_error_rad[car])
        out[car, 3] = observed.speed_mps[car] / scales.speed_mps
        out[car, 4] = observed.yaw_rate_radps[car] / scales.yaw_rate_radps
        out[car, 5] = observed.steering_deg[car] / scales.steering_deg
        out[car, 6] = observed.commanded_mps[car] / scales.commanded_mps
        cos, sin = math.cos(yaw_rad) / scales.lookahead_m, math.sin(yaw_rad) / scales.lookahead_m
        for number in range(ahead_ndist.shape[1]):
            x, y, _ = pose_at(center, closed[line], line, observed.ndist[car] + ahead_ndist[line, number])
            dx, dy = x - front[car, 0], y - front[car, 1]
            out[car, len(OF_CAR) + 2 * number] = dx * cos + dy * sin
            out[car, len(OF_CAR) + 2 * number + 1] = dy * cos - dx * sin
