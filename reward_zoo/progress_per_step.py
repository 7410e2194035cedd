"""Teaches the car to be ahead of time: returns progress divided by steps.

The classic of lap time races; it needs nothing but two numbers and transfers to any track. Fails early in
training, where the average of the first steps is noise, and late in a lap, where a single step hardly moves
the average any more. A car that crawls off the road still earns what its past was worth.
"""

import numpy as np

WEIGHT = 1.0  # reward for one hundred steps a lap (1 per cent a step)
OFF_ROAD_FACTOR = 0.1  # share of the reward that is left with a wheel off the road
FLOOR = 0.001


def reward_function(params: dict) -> float:
    """Reward progress over steps."""
    reward = WEIGHT * params["progress"] / max(1.0, params["steps"])
    return max(FLOOR, reward if params["all_wheels_on_track"] else reward * OFF_ROAD_FACTOR)


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    reward = WEIGHT * params["progress"] / np.maximum(1.0, params["steps"])
    return np.maximum(FLOOR, np.where(params["all_wheels_on_track"], reward, reward * OFF_ROAD_FACTOR))
