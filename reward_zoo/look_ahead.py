"""Teaches the car to steer at a point of the centre line some way ahead, as a driver looks through a corner.

Compares the steering angle with the one that leads onto an arc through that point (pure pursuit), so every
step has one right answer and driving is smooth from early on. Fails at hairpins when the look-ahead is longer
than the corner, which is then cut across the grass; says little about speed. At the end of a road that is no
loop it looks back to the start.
"""

import math

import numpy as np

LOOK_AHEAD_M = 1.0
WHEELBASE_M = 0.164
TOLERANCE_DEG = 20.0  # no reward from this error on
SPEED_WEIGHT = 0.25  # extra reward for 1 m/s while steering right
FLOOR = 0.001  # reward with a wheel off the road


def reward_function(params: dict) -> float:
    """Reward steering onto the arc through the point ahead."""
    if not params["all_wheels_on_track"]:
        return FLOOR
    points = params["waypoints"]
    ahead = params["closest_waypoints"][1]
    dx = dy = 0.0
    for i in range(len(points)):
        x, y = points[(ahead + i) % len(points)]
        dx, dy = x - params["x"], y - params["y"]
        if dx * dx + dy * dy >= LOOK_AHEAD_M * LOOK_AHEAD_M:
            break
    angle = math.atan2(dy, dx) - math.radians(params["heading"])
    distance = max(0.01, math.hypot(dx, dy))
    wanted = math.degrees(math.atan2(2.0 * WHEELBASE_M * math.sin(angle), distance))
    # Sideways is as far as an arc through a point behind the car can ask for.
    if math.cos(angle) < 0.0:
        wanted = math.copysign(90.0, wanted)
    right = max(0.0, 1.0 - abs(params["steering_angle"] - wanted) / TOLERANCE_DEG)
    return FLOOR + right * (1.0 + SPEED_WEIGHT * params["speed"])


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    points = params["waypoints"]
    ahead = params["closest_waypoints"][:, 1]
    index = (ahead[:, None] + np.arange(len(points))) % len(points)
    dx = points[index, 0] - params["x"][:, None]
    dy = points[index, 1] - params["y"][:, None]
    far = dx * dx + dy * dy >= LOOK_AHEAD_M * LOOK_AHEAD_M
    first = np.where(far.any(axis=1), far.argmax(axis=1), len(points) - 1)
    cars = np.arange(len(ahead))
    dx, dy = dx[cars, first], dy[cars, first]
    angle = np.arctan2(dy, dx) - np.radians(params["heading"])
    distance = np.maximum(0.01, np.hypot(dx, dy))
    wanted = np.degrees(np.arctan2(2.0 * WHEELBASE_M * np.sin(angle), distance))
    wanted = np.where(np.cos(angle) < 0.0, np.copysign(90.0, wanted), wanted)
    right = np.maximum(0.0, 1.0 - np.abs(params["steering_angle"] - wanted) / TOLERANCE_DEG)
    reward = FLOOR + right * (1.0 + SPEED_WEIGHT * params["speed"])
    return np.where(params["all_wheels_on_track"], reward, FLOOR)
