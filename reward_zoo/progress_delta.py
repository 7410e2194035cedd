"""Teaches fast laps: rewards the progress in metres since the last call, less a cost of each step.

The sum over a lap is its length less the cost of its steps: of two laps the faster one returns more, by the same amount
for each second on any track, and no detour returns anything. It remembers the last call in a module global, as many
race winners do; for many cars at once the progress before the step comes with the params. Fails where progress itself
misleads: beside a road that runs close by, and on the service where a training is stopped in the middle of an episode.
"""

import numpy as np

PROGRESS_WEIGHT = 1.0  # reward for 1 m along the centre line
STEP_COST = 0.045  # what a step at 0.7 m/s gains; with less, laps at 4 m/s return much the same however long they take
OFF_ROAD_COST = 2.0  # cost of leaving the road

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
