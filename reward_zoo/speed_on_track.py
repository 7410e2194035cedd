"""Teaches the car to ask for speed as long as all wheels are on the road.

Best as a second stage, for a car that already gets round. Fails from scratch: flat out into the first corner
earns more per step than anything else, and only the end of the episode teaches otherwise. `speed` is what the
action asks for, not what the car does.
"""

import numpy as np

TOP_SPEED_MPS = 4.0  # reward 1
SHARPNESS = 2.0  # larger: only high speeds are rewarded
FLOOR = 0.001  # reward at standstill and with a wheel off the road


def reward_function(params: dict) -> float:
    """Reward commanded speed on the road."""
    if not params["all_wheels_on_track"]:
        return FLOOR
    return FLOOR + (params["speed"] / TOP_SPEED_MPS) ** SHARPNESS


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    reward = FLOOR + (params["speed"] / TOP_SPEED_MPS) ** SHARPNESS
    return np.where(params["all_wheels_on_track"], reward, FLOOR)
