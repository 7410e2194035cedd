"""Teaches the car to improve on itself: rewards its average progress per step and the square of its speed.

Nothing about lines or angles is prescribed, so the car finds a way of its own, and often a quick one. Fails
from scratch on winding tracks, where the speed term leads straight off the road, and wherever the two weights
do not fit the track: on a long one progress per step is small beside speed squared.
"""

import numpy as np

PROGRESS_WEIGHT = 5.0  # reward for 1 per cent of the lap a step
SPEED_WEIGHT = 0.3  # reward for 1 m/s, squared
FLOOR = 0.001  # reward with a wheel off the road


def terms(params: dict) -> dict:
    """Return the parts of the reward; a log analysis shows them one by one."""
    pace = max(0.0, params["progress"]) / max(1.0, params["steps"])
    on_road = params["all_wheels_on_track"]
    return {
        "floor": FLOOR,
        "progress": PROGRESS_WEIGHT * pace if on_road else 0.0,
        "speed": SPEED_WEIGHT * params["speed"] ** 2 if on_road else 0.0,
    }


def reward_function(params: dict) -> float:
    """Reward average progress and speed squared."""
    return sum(terms(params).values())


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    pace = np.maximum(0.0, params["progress"]) / np.maximum(1.0, params["steps"])
    reward = FLOOR + PROGRESS_WEIGHT * pace + SPEED_WEIGHT * params["speed"] ** 2
    return np.where(params["all_wheels_on_track"], reward, FLOOR)
