"""The physical car's conversion of a model's actions to controls.

Sources: deepracer-custom-car 2.1.9.9 (as AWS's own software does), deepracer_navigation_pkg for the scales,
servo_pkg/src/servo_mgr.cpp for the limits.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .model_metadata import Action, ModelMetadata

Floats = NDArray[np.float64]

HALF_SPEED_THROTTLE = 0.8
"""Throttle at half of the highest speed; at the highest it is 1 (deepracer_navigation_pkg, DEFAULT_SPEED_SCALES)."""


def full_scale(metadata: ModelMetadata) -> Action:
    """Return the angle in degrees that is full lock, and the speed in m/s that is full throttle.

    They are relative: a space of at most 20 degrees turns the wheels as far as one of 30. Of a continuous space only
    the high ends count.
    """
    if metadata.high is not None:
        return metadata.high
    steering_deg, speed_mps = np.abs(metadata.actions).max(axis=0).tolist()
    return Action(steering_deg, speed_mps)


def steering_share(steering_deg: ArrayLike, full_lock_deg: float) -> Floats:
    """Return steering as a share of full lock; beyond 1 where a continuous space reaches further to the right.

    With a `full_lock_deg` of 0 or less, of `full_scale`, the car only drives straight ahead.
    """
    steering_deg = np.asarray(steering_deg, np.float64)
    return steering_deg / full_lock_deg if full_lock_deg > 0 else np.zeros_like(steering_deg)


def speed_share(speed_mps: ArrayLike, full_throttle_mps: float) -> Floats:
    """Return speed as a share of that at full throttle; with a `full_throttle_mps` of 0, of `full_scale`, 0."""
    speed_mps = np.asarray(speed_mps, np.float64)
    return speed_mps / full_throttle_mps if full_throttle_mps > 0 else np.zeros_like(speed_mps)


def throttle(speed_mps: ArrayLike, full_throttle_mps: float) -> Floats:
    """Return the throttle, 0 to 1: a parabola through 0, `HALF_SPEED_THROTTLE` at half speed and 1 at full speed.

    With a `full_throttle_mps` of 0, of `full_scale`, the car stands.
    """
    share = speed_share(speed_mps, full_throttle_mps)
    a, b = 2.0 - 4.0 * HALF_SPEED_THROTTLE, 4.0 * HALF_SPEED_THROTTLE - 1.0
    curve: Floats = np.clip((a * share + b) * share, -1.0, 1.0)
    return curve


def servo_value(requested: Floats, last: Floats) -> Floats:
    """Return the servo's position after a request: the servo node refuses values outside -1..1 and keeps the last."""
    return np.where(np.abs(requested) <= 1.0, requested, last)
