"""Teaches laps that are reliable on unknown tyres and light: as progress_delta, but leaving the road costs more.

It costs five metres instead of two, so that a policy that becomes faster fails less often. For policies of a real car
(experiment=real_car). Fails where each tenth of a second counts, and as progress_delta does.
"""

import numpy as np

PROGRESS_WEIGHT = 1.0  # reward for 1 m along the centre line
STEP_COST = 0.045  # what a step at 0.7 m/s gains
OFF_ROAD_COST = 5.0  # cost of leaving the road

_last = {"progress": 0.0, "steps": 0.0}


def terms(params: dict) -> dict:
    """Return the parts of the reward; a log analysis shows them one by one."""
    gained = params["progress"] - _last["progress"]
    # Anything but the very next step belongs to another episode, whose first step gained nothing yet.
    if params["steps"] != _last["steps"] + 1.0:
        gained = 0.0
    _last["progress"], _last["steps"] = params["progress"], params["steps"]
    return {
        "progress": PROGRESS_WEIGHT * gained / 100.0 * params["track_length"],
        "time": -STEP_COST,
        "off_road": -OFF_ROAD_COST if params["is_offtrack"] else 0.0,
    }


def reward_function(params: dict) -> float:
    """Reward progress since the last call."""
    parts = terms(params)
    return parts["progress"] + (parts["time"] + parts["off_road"])


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    gained = params["progress"] - params["previous_progress"]
    costs = STEP_COST + OFF_ROAD_COST * params["is_offtrack"]
    return PROGRESS_WEIGHT * gained / 100.0 * params["track_length"] - costs
