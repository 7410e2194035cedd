"""Teaches the car to finish within a number of steps: rewards being ahead of an even schedule for the lap.

Sets a goal in the unit of lap times, with a bonus at the finish that grows the earlier it comes. Fails when
TARGET_STEPS is far from what the car can do: always late returns the floor, always early rewards anything. Set it per
track, a little below the best lap so far.
"""

import numpy as np

TARGET_STEPS = 300.0  # steps of a lap on schedule (15 a second)
SCHEDULE_WEIGHT = 5.0  # extra reward for being a whole lap ahead
FINISH_BONUS = 20.0  # reward for a finish on schedule
FLOOR = 0.001


def terms(params: dict) -> dict:
    """Return the parts of the reward; a log analysis shows them one by one."""
    steps = max(1.0, params["steps"])
    ahead = params["progress"] / 100.0 - steps / TARGET_STEPS
    finished = params["progress"] >= 100.0
    return {
        "schedule": max(FLOOR, 1.0 + SCHEDULE_WEIGHT * ahead) if params["all_wheels_on_track"] else FLOOR,
        "finish": FINISH_BONUS * TARGET_STEPS / steps if finished else 0.0,
    }


def reward_function(params: dict) -> float:
    """Reward being ahead of schedule, and the finish."""
    return sum(terms(params).values())


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    steps = np.maximum(1.0, params["steps"])
    ahead = params["progress"] / 100.0 - steps / TARGET_STEPS
    reward = np.where(params["all_wheels_on_track"], np.maximum(FLOOR, 1.0 + SCHEDULE_WEIGHT * ahead), FLOOR)
    return reward + np.where(params["progress"] >= 100.0, FINISH_BONUS * TARGET_STEPS / steps, 0.0)
