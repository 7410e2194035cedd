"""The params of reward functions about boxes and bots, on request with the service's mistakes."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.env.rules import Bools, RaceRules
from deepracer_exp.env.state import Floats, Measures

from .boxes_and_bots import Others
from .nearby import closest

_VIEW = np.tan(0.5 * 1.13)
"""Tangent of half the horizontal angle of view, of which 480/640 is visible vertically (deepracer-simapp,
cameras/frustum.py)."""
_EYE_M, _EYE_PITCH_RAD, _NEAREST_M = (0.14529379, 0.13032555), 0.2618, 0.2
"""The camera ahead of and above the origin, its pitch, and the distance from which it sees (the same file)."""


class ObjectParams:
    """Computes the columns `rewards.params.OBJECT_COLUMNS` of N cars.

    Args:
        others: boxes and bots around the cars.
        rules: race rules of the same cars.
        quirks: `service` for params with the mistakes of the service.
        bots_mps: speed of bots in m/s; None: there are none.
    """

    def __init__(
        self, others: Others, rules: RaceRules, quirks: Literal["fixed", "service"], bots_mps: float | None
    ):
        self._others, self._rules = others, rules
        self._as_service, self._bots_mps = quirks == "service", bots_mps
        self._everyone = np.arange(rules.n_cars)
        self._mask = np.ones(others.distance_m.shape, bool)

    def columns(self, now: Measures, time_s: Floats) -> dict[str, np.ndarray]:
        """Return all columns except `is_crashed`, which is not known yet, and `objects_mask`; one row per car.

        Args:
            now: poses of the cars.
            time_s: since each episode's begin, (N,).
        """
        others = self._others
        nearest = closest(others.distance_m, now.ndist * self._rules.length_m)
        return {
            "closest_objects": nearest,
            # The service counts the agent's own car as number 0 here but not there.
            "object_in_camera": self._in_camera(now, nearest[:, 1] - self._as_service),
            "objects_location": others.poses[..., :2].copy(),
            "objects_left_of_center": others.offset_m > 0,
            "objects_distance_from_center": np.abs(others.offset_m),
            "objects_distance": others.distance_m.copy(),
            "objects_heading": self._heading(),
            "objects_speed": self._speeds_mps(time_s),
            "objects_mask": self._mask,
        }

    def _heading(self) -> Floats:
        yaw_rad = self._others.poses[..., 2]
        if self._as_service:
            return np.zeros(yaw_rad.shape) if self._bots_mps is None else yaw_rad.copy()
        degrees = np.degrees(np.mod(yaw_rad + np.pi, 2 * np.pi) - np.pi)
        return np.where(self._others.is_bot, degrees, 0.0)

    def _speeds_mps(self, time_s: Floats) -> Floats:
        if self._as_service:
            return np.full(self._mask.shape, self._bots_mps or 0.0)
        return self._others.speeds_mps(self._everyone, time_s)

    def _in_camera(self, now: Measures, tested: NDArray[np.int64]) -> Bools:
        """Return whether an other's origin or a corner of its crash rectangle is in the camera's view, (N,).

        Nothing hides anything. -1 is no other.
        """
        row = np.arange(len(tested))
        poses, half_m = self._others.poses[row, tested], self._others.half_m[tested]
        cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
        along = half_m[:, :1] * np.array([0, 1, 1, -1, -1])
        across = half_m[:, 1:] * np.array([0, 1, -1, -1, 1])
        dx = poses[:, :1] + cos * along - sin * across - now.x_m[:, None]
        dy = poses[:, 1:2] + sin * along + cos * across - now.y_m[:, None]
        cos, sin = np.cos(now.yaw_rad)[:, None], np.sin(now.yaw_rad)[:, None]
        ahead, left = cos * dx + sin * dy - _EYE_M[0], cos * dy - sin * dx
        depth = np.cos(_EYE_PITCH_RAD) * ahead + np.sin(_EYE_PITCH_RAD) * _EYE_M[1]
        down = np.sin(_EYE_PITCH_RAD) * -ahead + np.cos(_EYE_PITCH_RAD) * _EYE_M[1]
        seen = (depth > _NEAREST_M) & (np.abs(left) < _VIEW * depth) & (np.abs(down) < 0.75 * _VIEW * depth)
        return np.asarray(seen.any(axis=1) & (tested >= 0))
