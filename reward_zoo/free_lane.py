"""Teaches to drive in the free lane: rewards progress, less a cost of each step behind a near object in its lane.

A lane is one side of the centre line. As progress_delta it adds up to what a lap is worth; on top, each step costs in
which the next object is near and on the same side of the centre line as the car, the more the nearer. So the car
changes sides early and drives its own line elsewhere. Fails on narrow roads, where the own lane is no room to pass in,
where objects block both lanes, and as progress_delta does.
"""

import numpy as np

PROGRESS_WEIGHT = 1.0  # reward for 1 m along the centre line
STEP_COST = 0.045  # what a step at 0.7 m/s gains
OFF_ROAD_COST = 2.0  # cost of leaving the road
CRASH_COST = 4.0  # cost of running into a box or bot
BLOCKED_COST = 0.1  # cost of a step right behind an object in the own lane
NEAR_M = 1.5  # how far ahead an object is near

_last = {"progress": 0.0, "steps": 0.0}


def terms(params: dict) -> dict:
    """Return the parts of the reward; a log analysis shows them one by one."""
    gained = params["progress"] - _last["progress"]
    # Anything but the very next step belongs to another episode, whose first step gained nothing yet.
    if params["steps"] != _last["steps"] + 1.0:
        gained = 0.0
    _last["progress"], _last["steps"] = params["progress"], params["steps"]
    blocked = 0.0
    sides = params["objects_left_of_center"]
    if sides and "projection_distance" in params:  # deepracer-on-aws validates without it
        ahead = params["closest_objects"][1]
        if sides[ahead] == params["is_left_of_center"]:
            gap = (params["objects_distance"][ahead] - params["projection_distance"]) % params["track_length"]
            blocked = max(0.0, 1.0 - gap / NEAR_M)
    return {
        "progress": PROGRESS_WEIGHT * gained / 100.0 * params["track_length"],
        "time": -STEP_COST,
        "off_road": -OFF_ROAD_COST if params["is_offtrack"] else 0.0,
        "crash": -CRASH_COST if params["is_crashed"] else 0.0,
        "lane": -BLOCKED_COST * blocked,
    }


def reward_function(params: dict) -> float:
    """Reward progress since the last call, less the costs."""
    parts = terms(params)
    return parts["progress"] + (parts["time"] + parts["off_road"] + parts["crash"] + parts["lane"])


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    gained = params["progress"] - params["previous_progress"]
    costs = STEP_COST + OFF_ROAD_COST * params["is_offtrack"] + CRASH_COST * params["is_crashed"]
    distances = params["objects_distance"]
    if distances.shape[1]:
        car, ahead = np.arange(len(gained)), params["closest_objects"][:, 1]
        gap = (distances[car, ahead] - params["projection_distance"]) % params["track_length"]
        same_lane = params["objects_left_of_center"][car, ahead] == params["is_left_of_center"]
        costs = costs + BLOCKED_COST * np.where(same_lane, np.maximum(0.0, 1.0 - gap / NEAR_M), 0.0)
    return PROGRESS_WEIGHT * gained / 100.0 * params["track_length"] - costs
