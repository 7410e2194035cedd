"""Teaches to pass other cars: rewards progress, and on top the metres gained on the nearest car while it is close.

The sum over a lap is that of progress_delta. On top, each step within reach of another car, ahead or behind, adds the
progress of this car less that of the other. So a pass returns twice the reach times the weight, being passed costs the
same, and following returns nothing. Fails where the weight is so large that cutting corners off the road to catch up
returns more, where `objects_speed` is wrong as the service has it, and as progress_delta does.
"""

import numpy as np

PROGRESS_WEIGHT = 1.0  # reward for 1 m along the centre line
STEP_COST = 0.045  # what a step at 0.7 m/s gains
OFF_ROAD_COST = 2.0  # cost of leaving the road
CRASH_COST = 4.0  # cost of running into another from behind
GAIN_WEIGHT = 2.0  # reward for 1 m gained on the nearest other
REACH_M = 2.0  # how far away along the lap an other counts
STEP_S = 1 / 15  # duration of a control step

_last = {"progress": 0.0, "steps": 0.0}


def around(gap: float, lap: float) -> float:
    """Return a gap along the lap the shorter way round, negative where the other is behind."""
    return (gap + 0.5 * lap) % lap - 0.5 * lap


def terms(params: dict) -> dict:
    """Return the parts of the reward; a log analysis shows them one by one."""
    gained = params["progress"] - _last["progress"]
    # Anything but the very next step belongs to another episode, whose first step gained nothing yet.
    if params["steps"] != _last["steps"] + 1.0:
        gained = 0.0
    _last["progress"], _last["steps"] = params["progress"], params["steps"]
    made = gained / 100.0 * params["track_length"]
    relative = 0.0
    speeds = params["objects_speed"]
    if speeds and "projection_distance" in params:  # deepracer-on-aws validates without it
        gaps = [
            around(params["objects_distance"][i] - params["projection_distance"], params["track_length"])
            for i in params["closest_objects"]
        ]
        nearest = 0 if abs(gaps[0]) <= abs(gaps[1]) else 1
        if abs(gaps[nearest]) < REACH_M:
            relative = made - STEP_S * speeds[params["closest_objects"][nearest]]
    return {
        "progress": PROGRESS_WEIGHT * made,
        "time": -STEP_COST,
        "off_road": -OFF_ROAD_COST if params["is_offtrack"] else 0.0,
        "crash": -CRASH_COST if params["is_crashed"] else 0.0,
        "gain": GAIN_WEIGHT * relative,
    }


def reward_function(params: dict) -> float:
    """Reward progress since the last call and the gain on the nearest other, less the costs."""
    parts = terms(params)
    return parts["progress"] + (parts["time"] + parts["off_road"] + parts["crash"] + parts["gain"])


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    length = params["track_length"]
    made = (params["progress"] - params["previous_progress"]) / 100.0 * length
    costs = STEP_COST + OFF_ROAD_COST * params["is_offtrack"] + CRASH_COST * params["is_crashed"]
    distances = params["objects_distance"]
    if distances.shape[1]:
        car, two = np.arange(len(made)), params["closest_objects"]
        gaps = distances[car[:, None], two] - params["projection_distance"][:, None]
        gaps = (gaps + 0.5 * length) % length - 0.5 * length
        nearest = np.abs(gaps).argmin(axis=1)
        relative = made - STEP_S * params["objects_speed"][car, two[car, nearest]]
        costs = costs - GAIN_WEIGHT * np.where(np.abs(gaps[car, nearest]) < REACH_M, relative, 0.0)
    return PROGRESS_WEIGHT * made - costs
