"""Teaches a compromise: near the centre line and fast, each with a weight of its own.

A step on from following the centre line once that works; raise SPEED_WEIGHT from one training to the next. Fails when
one weight drowns the other: too much speed runs wide, too little crawls. The sum may also reward speed at the very
border; `prevent_zig_zag` or `racing_line` are stricter.
"""

import numpy as np

CENTER_WEIGHT = 1.0
SPEED_WEIGHT = 1.0
TOP_SPEED_MPS = 4.0  # its reward is SPEED_WEIGHT
FLOOR = 0.001  # reward with a wheel off the road


def terms(params: dict) -> dict:
    """Return the parts of the reward; a log analysis shows them one by one."""
    share = min(1.0, params["distance_from_center"] / (0.5 * params["track_width"]))
    on_road = params["all_wheels_on_track"]
    return {
        "floor": FLOOR,
        "center": CENTER_WEIGHT * (1.0 - share * share) if on_road else 0.0,
        "speed": SPEED_WEIGHT * (params["speed"] / TOP_SPEED_MPS) if on_road else 0.0,
    }


def reward_function(params: dict) -> float:
    """Reward nearness to the centre line and speed."""
    return sum(terms(params).values())


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    share = np.minimum(1.0, params["distance_from_center"] / (0.5 * params["track_width"]))
    speed = params["speed"] / TOP_SPEED_MPS
    reward = FLOOR + CENTER_WEIGHT * (1.0 - share * share) + SPEED_WEIGHT * speed
    return np.where(params["all_wheels_on_track"], reward, FLOOR)
