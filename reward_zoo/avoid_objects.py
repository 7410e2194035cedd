"""Teaches fast laps among boxes and bots: rewards progress, less a cost of each step, of danger, and of a crash.

The sum over a lap is that of progress_delta, so that a detour costs only its time. On top, each step near the next
object costs, the more the nearer, while the car is not clear of it across the road. Distances of objects count from the
start line, so the gap is their difference to the car's own, around the lap. Fails where both lanes are blocked at the
same place, and as progress_delta does.
"""

import numpy as np

PROGRESS_WEIGHT = 1.0  # reward for 1 m along the centre line
STEP_COST = 0.045  # what a step at 0.7 m/s gains
OFF_ROAD_COST = 2.0  # cost of leaving the road
CRASH_COST = 4.0  # cost of running into a box or bot
DANGER_COST = 0.1  # cost of a step right behind an object in the car's way
DANGER_M = 1.2  # how far ahead an object is near
CLEAR_M = 0.36  # from middle to middle across the road: half a box, half a car, and 6 cm

_last = {"progress": 0.0, "steps": 0.0}


def signed(distance: float, left: bool) -> float:
    """Return an offset from the centre line, positive to the left."""
    return distance if left else -distance


def terms(params: dict) -> dict:
    """Return the parts of the reward; a log analysis shows them one by one."""
    gained = params["progress"] - _last["progress"]
    # Anything but the very next step belongs to another episode, whose first step gained nothing yet.
    if params["steps"] != _last["steps"] + 1.0:
        gained = 0.0
    _last["progress"], _last["steps"] = params["progress"], params["steps"]
    danger = 0.0
    beside = params.get("objects_distance_from_center")  # deepracer-on-aws validates without it
    if beside:
        ahead = params["closest_objects"][1]
        gap = (params["objects_distance"][ahead] - params["projection_distance"]) % params["track_length"]
        own = signed(params["distance_from_center"], params["is_left_of_center"])
        other = signed(beside[ahead], params["objects_left_of_center"][ahead])
        danger = max(0.0, 1.0 - gap / DANGER_M) * max(0.0, 1.0 - abs(own - other) / CLEAR_M)
    return {
        "progress": PROGRESS_WEIGHT * gained / 100.0 * params["track_length"],
        "time": -STEP_COST,
        "off_road": -OFF_ROAD_COST if params["is_offtrack"] else 0.0,
        "crash": -CRASH_COST if params["is_crashed"] else 0.0,
        "danger": -DANGER_COST * danger,
    }


def reward_function(params: dict) -> float:
    """Reward progress since the last call, less the costs."""
    parts = terms(params)
    return parts["progress"] + (parts["time"] + parts["off_road"] + parts["crash"] + parts["danger"])


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    gained = params["progress"] - params["previous_progress"]
    costs = STEP_COST + OFF_ROAD_COST * params["is_offtrack"] + CRASH_COST * params["is_crashed"]
    distances = params["objects_distance"]
    if distances.shape[1]:
        car, ahead = np.arange(len(gained)), params["closest_objects"][:, 1]
        gap = (distances[car, ahead] - params["projection_distance"]) % params["track_length"]
        own = np.where(params["is_left_of_center"], 1.0, -1.0) * params["distance_from_center"]
        sides = np.where(params["objects_left_of_center"], 1.0, -1.0) * params["objects_distance_from_center"]
        beside = np.abs(own - sides[car, ahead])
        danger = np.maximum(0.0, 1.0 - gap / DANGER_M) * np.maximum(0.0, 1.0 - beside / CLEAR_M)
        costs = costs + DANGER_COST * danger
    return PROGRESS_WEIGHT * gained / 100.0 * params["track_length"] - costs
