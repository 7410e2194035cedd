"""Teaches the car to brake before a corner and to speed up on leaving it.

Measures by how much the road turns within the look-ahead, derives a target speed and rewards matching it. Good for a
car that gets round but takes all corners at one speed. Fails when the look-ahead is shorter than the braking distance,
or when SHARP_TURN_DEG asks for caution in every bend. At the end of a road that is no loop it looks back to the start.
"""

import math

import numpy as np

LOOK_AHEAD_M = 1.5
SHARP_TURN_DEG = 60.0  # a turn of this size within the look-ahead asks for the lowest speed
LOW_SPEED_MPS = 1.2
TOP_SPEED_MPS = 4.0
SPEED_WEIGHT = 0.3  # extra reward for 1 m/s while the speed is right
FLOOR = 0.001  # reward with a wheel off the road


def reward_function(params: dict) -> float:
    """Reward the speed that fits the bend ahead."""
    if not params["all_wheels_on_track"]:
        return FLOOR
    points = params["waypoints"]
    n = len(points)
    behind, ahead = params["closest_waypoints"]
    if tuple(points[behind]) == tuple(points[ahead]):  # the closing point of a lap repeats the first
        ahead = (ahead + 1) % n
    for i in range(n):
        far = (ahead + i) % n
        dx, dy = points[far][0] - params["x"], points[far][1] - params["y"]
        if dx * dx + dy * dy >= LOOK_AHEAD_M * LOOK_AHEAD_M:
            break
    beyond = (far + 1) % n
    if tuple(points[beyond]) == tuple(points[far]):
        beyond = (beyond + 1) % n
    ax, ay = points[ahead][0] - points[behind][0], points[ahead][1] - points[behind][1]
    bx, by = points[beyond][0] - points[far][0], points[beyond][1] - points[far][1]
    turn = abs(math.degrees(math.atan2(ax * by - ay * bx, ax * bx + ay * by)))
    target = TOP_SPEED_MPS - (TOP_SPEED_MPS - LOW_SPEED_MPS) * min(1.0, turn / SHARP_TURN_DEG)
    right = max(0.0, 1.0 - abs(params["speed"] - target) / (TOP_SPEED_MPS - LOW_SPEED_MPS))
    return FLOOR + right * (1.0 + SPEED_WEIGHT * params["speed"])


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    points = params["waypoints"]
    n = len(points)
    behind, ahead = np.transpose(params["closest_waypoints"])
    ahead = np.where(np.all(points[behind] == points[ahead], axis=1), (ahead + 1) % n, ahead)
    index = (ahead[:, None] + np.arange(n)) % n
    dx = points[index, 0] - params["x"][:, None]
    dy = points[index, 1] - params["y"][:, None]
    found = dx * dx + dy * dy >= LOOK_AHEAD_M * LOOK_AHEAD_M
    first = np.where(found.any(axis=1), found.argmax(axis=1), n - 1)
    far = index[np.arange(len(ahead)), first]
    beyond = (far + 1) % n
    beyond = np.where(np.all(points[beyond] == points[far], axis=1), (beyond + 1) % n, beyond)
    ax, ay = np.transpose(points[ahead] - points[behind])
    bx, by = np.transpose(points[beyond] - points[far])
    turn = np.abs(np.degrees(np.arctan2(ax * by - ay * bx, ax * bx + ay * by)))
    target = TOP_SPEED_MPS - (TOP_SPEED_MPS - LOW_SPEED_MPS) * np.minimum(1.0, turn / SHARP_TURN_DEG)
    right = np.maximum(0.0, 1.0 - np.abs(params["speed"] - target) / (TOP_SPEED_MPS - LOW_SPEED_MPS))
    reward = FLOOR + right * (1.0 + SPEED_WEIGHT * params["speed"])
    return np.where(params["all_wheels_on_track"], reward, FLOOR)
