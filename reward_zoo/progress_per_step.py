"""Teaches the car to be ahead of time: pays the share of the lap done, over the steps it took.

The classic of lap time races; it needs nothing but two numbers and transfers to any track. Fails early in
training, where the average of the first steps is noise, and late in a lap, where a single step hardly moves
the average any more. A car that crawls off the road still earns what its past was worth.
"""

import numpy as np

WEIGHT = 1.0  # pay for one hundred steps a lap (1 per cent a step)
OFF_ROAD_FACTOR = 0.1  # share of the pay that is left with a wheel off the road
FLOOR = 0.001


def reward_function(params: dict) -> float:
    """Pay for progress over steps."""
    pay = WEIGHT * params["progress"] / max(1.0, params["steps"])
    return max(FLOOR, pay if params["all_wheels_on_track"] else pay * OFF_ROAD_FACTOR)


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    pay = WEIGHT * params["progress"] / np.maximum(1.0, params["steps"])
    return np.maximum(FLOOR, np.where(params["all_wheels_on_track"], pay, pay * OFF_ROAD_FACTOR))
