"""Teaches the car to stay near the centre line: 1 on the line, less towards the border, next to none beyond.

Learned within minutes and hard to get wrong, so a good first reward. Fails to make the car fast: a slow step returns as
much as a quick one, so crawling in the middle of the road is the best policy.
"""

import numpy as np

SHARPNESS = 2.0  # 1: falls off evenly; larger: flat in the middle, steep near the border
FLOOR = 0.001  # reward at and beyond the border


def reward_function(params: dict) -> float:
    """Reward nearness to the centre line."""
    share = params["distance_from_center"] / (0.5 * params["track_width"])
    return max(FLOOR, 1.0 - share**SHARPNESS)


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    share = params["distance_from_center"] / (0.5 * params["track_width"])
    return np.maximum(FLOOR, 1.0 - share**SHARPNESS)
