"""Teaches the car to follow the centre line with small steering angles, so that it does not weave.

Helps once a car gets round but swings from side to side. Fails on tracks with tight corners when the free
angle is set too small: turning in costs more than leaving the line does, and the car runs wide.
"""

import numpy as np

FREE_STEERING_DEG = 15.0  # steering up to this angle costs nothing
FULL_STEERING_DEG = 30.0  # steering at this angle costs STEERING_COST of the reward
STEERING_COST = 0.5
FLOOR = 0.001


def reward_function(params: dict) -> float:
    """Reward nearness to the centre line, less a share for hard steering."""
    share = params["distance_from_center"] / (0.5 * params["track_width"])
    excess = (abs(params["steering_angle"]) - FREE_STEERING_DEG) / (FULL_STEERING_DEG - FREE_STEERING_DEG)
    calm = 1.0 - STEERING_COST * min(1.0, max(0.0, excess))
    return max(FLOOR, (1.0 - share * share) * calm)


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    share = params["distance_from_center"] / (0.5 * params["track_width"])
    excess = (np.abs(params["steering_angle"]) - FREE_STEERING_DEG) / (FULL_STEERING_DEG - FREE_STEERING_DEG)
    calm = 1.0 - STEERING_COST * np.clip(excess, 0.0, 1.0)
    return np.maximum(FLOOR, (1.0 - share * share) * calm)
