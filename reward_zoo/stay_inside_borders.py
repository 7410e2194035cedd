"""Teaches the car to keep all wheels on the road and a margin to the border, and leaves it free in between.

Unlike the centre line rewards it does not forbid cutting a corner. Fails where learning needs a hint of the right
direction: it is flat over the whole road, says nothing until the border is reached, and rewards a slow car as much as a
fast one.
"""

import numpy as np

MARGIN_M = 0.05  # least distance from the car's front to the border
FLOOR = 0.001  # reward without that margin


def reward_function(params: dict) -> float:
    """Reward being inside the borders with a margin."""
    margin = 0.5 * params["track_width"] - params["distance_from_center"]
    return 1.0 if params["all_wheels_on_track"] and margin >= MARGIN_M else FLOOR


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    margin = 0.5 * params["track_width"] - params["distance_from_center"]
    return np.where(params["all_wheels_on_track"] & (margin >= MARGIN_M), 1.0, FLOOR)
