"""Teaches the car to point along the road: rewards a small angle between its heading and the centre line.

Gives a hint in every position, also far from the centre, so it joins well with other terms. Fails alone: a
car that drives parallel to the road may leave it in full agreement with this reward, and in tight corners
the best line is not parallel to the centre line.
"""

import math

import numpy as np

SHARPNESS = 2.0  # larger: only small angles are rewarded
OFF_ROAD_FACTOR = 0.1  # share of the reward that is left with a wheel off the road
FLOOR = 0.001


def _direction(params: dict) -> tuple:
    """Return the unit vector of the centre line from the waypoint behind to the one ahead."""
    points = params["waypoints"]
    behind, ahead = params["closest_waypoints"]
    if tuple(points[behind]) == tuple(points[ahead]):  # the closing point of a lap repeats the first
        ahead = (ahead + 1) % len(points)
    dx, dy = points[ahead][0] - points[behind][0], points[ahead][1] - points[behind][1]
    length = math.hypot(dx, dy) or 1.0
    return dx / length, dy / length


def reward_function(params: dict) -> float:
    """Reward heading along the centre line."""
    dx, dy = _direction(params)
    heading = math.radians(params["heading"])
    along = max(0.0, dx * math.cos(heading) + dy * math.sin(heading)) ** SHARPNESS
    return max(FLOOR, along if params["all_wheels_on_track"] else along * OFF_ROAD_FACTOR)


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
    along = np.maximum(0.0, dx * np.cos(heading) + dy * np.sin(heading)) ** SHARPNESS
    return np.maximum(FLOOR, np.where(params["all_wheels_on_track"], along, along * OFF_ROAD_FACTOR))
