"""Teaches fast laps by exact account: pays the progress made since the last call, less a price for the time.

The sum over an episode is the share of the lap done less the steps it took, so no detour is worth anything.
It remembers the last call in a module global, as many race winners do. Fails where that memory is wrong: a
training that is resumed loses one step, and the credit for a late braking comes only with the next steps.
"""

PROGRESS_WEIGHT = 1.0  # pay for 1 per cent of the lap
STEP_COST = 0.05
OFF_ROAD_COST = 5.0

_last = {"progress": 0.0, "steps": 0.0}


def terms(params: dict) -> dict:
    """Return what each part pays or costs; a log analysis shows them one by one."""
    gained = params["progress"] - _last["progress"]
    # Anything but the very next step belongs to another episode, whose first step gained nothing yet.
    if params["steps"] != _last["steps"] + 1.0:
        gained = 0.0
    _last["progress"], _last["steps"] = params["progress"], params["steps"]
    return {
        "progress": PROGRESS_WEIGHT * gained,
        "time": -STEP_COST,
        "off_road": -OFF_ROAD_COST if params["is_offtrack"] else 0.0,
    }


def reward_function(params: dict) -> float:
    """Pay for progress since the last call."""
    paid = terms(params)
    return paid["progress"] + (paid["time"] + paid["off_road"])
