"""Teaches fast, reliable laps: pays for the speed gained along the road, every step, without memory.

The pay is the commanded speed times the cosine of the angle between heading and centre line, so a faster way
round earns more per second and driving back costs. Nearing the border costs a little, a wheel beyond it more,
leaving the road once and clearly. Fails to find the very last tenths: it follows the direction of the centre
line, and a racing line that cuts a corner is worth more than it says.
"""

import math

import numpy as np

SPEED_WEIGHT = 1.0  # pay for 1 m/s along the road
EDGE_START = 0.7  # share of the half width from which nearness to the border costs
EDGE_COST = 0.5  # cost at the border
WHEEL_OFF_COST = 0.5  # cost of a wheel off the road
OFF_ROAD_COST = 5.0  # cost of leaving the road


def _direction(params: dict) -> tuple:
    """Return the unit vector of the centre line from the waypoint behind to the one ahead."""
    points = params["waypoints"]
    behind, ahead = params["closest_waypoints"]
    if tuple(points[behind]) == tuple(points[ahead]):  # the closing point of a lap repeats the first
        ahead = (ahead + 1) % len(points)
    dx, dy = points[ahead][0] - points[behind][0], points[ahead][1] - points[behind][1]
    length = math.hypot(dx, dy) or 1.0
    return dx / length, dy / length


def terms(params: dict) -> dict:
    """Return what each part pays or costs; a log analysis shows them one by one."""
    dx, dy = _direction(params)
    heading = math.radians(params["heading"])
    gain = params["speed"] * (dx * math.cos(heading) + dy * math.sin(heading))
    share = params["distance_from_center"] / (0.5 * params["track_width"])
    return {
        "progress": SPEED_WEIGHT * gain,
        "edge": -EDGE_COST * min(1.0, max(0.0, share - EDGE_START) / (1.0 - EDGE_START)),
        "wheel_off": 0.0 if params["all_wheels_on_track"] else -WHEEL_OFF_COST,
        "off_road": -OFF_ROAD_COST if params["is_offtrack"] else 0.0,
    }


def reward_function(params: dict) -> float:
    """Pay for speed along the centre line, less a cost near and beyond the border."""
    paid = terms(params)
    return paid["progress"] + (paid["edge"] + paid["wheel_off"] + paid["off_road"])


def _directions(params: dict) -> tuple:
    """Return what `_direction` does, for many cars."""
    points = params["waypoints"]
    behind, ahead = np.transpose(params["closest_waypoints"])
    same = np.all(points[behind] == points[ahead], axis=1)
    ahead = np.where(same, (ahead + 1) % len(points), ahead)
    dx, dy = np.transpose(points[ahead] - points[behind])
    length = np.hypot(dx, dy)
    length[length == 0.0] = 1.0
    return dx / length, dy / length


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    dx, dy = _directions(params)
    heading = np.radians(params["heading"])
    gain = params["speed"] * (dx * np.cos(heading) + dy * np.sin(heading))
    share = params["distance_from_center"] / (0.5 * params["track_width"])
    cost = EDGE_COST * np.minimum(1.0, np.maximum(0.0, share - EDGE_START) / (1.0 - EDGE_START))
    cost += WHEEL_OFF_COST * ~params["all_wheels_on_track"] + OFF_ROAD_COST * params["is_offtrack"]
    return SPEED_WEIGHT * gain - cost
