"""Teaches a racing line with target speeds, both worked out from the waypoints on the first call.

The line is the one of least curvature that stays within LINE_ROOM_M of the centre line; its target speeds follow from
the grip in corners and the braking before them. Rewards being on the line, pointing along it and driving the target
speed. Fails when the constants do not fit car or road: more room than the road has leads over the border, more grip
than the tyres have leads off the line. Sharp rewards are slow to learn from scratch; follow the centre line first. The
validator of deepracer-on-aws refuses it, because SciPy and NumPy import modules of their own while it is called.
"""

import math

import numpy as np
from scipy.optimize import lsq_linear

LINE_ROOM_M = 0.3  # how far from the centre line the racing line may go; less than half the road
LINE_WIDTH_M = 0.25  # distance from the line at which its reward has fallen to a third
LINE_WEIGHT = 1.0
SPEED_WEIGHT = 2.0  # reward for driving the target speed where that is TOP_SPEED_MPS; less where slower
SPEED_WIDTH_MPS = 1.0  # speed error at which that reward has fallen to a third
LATERAL_MPS2 = 4.0  # grip in corners
BRAKING_MPS2 = 3.0
TOP_SPEED_MPS = 4.0
SAMPLES = 120  # points of the line
FLOOR = 0.001  # reward with a wheel off the road

_lines: dict = {}


def _work_out(points: np.ndarray) -> tuple:
    """Return x, y, direction (2 columns) and target speed at the points of the racing line."""
    closed = bool(np.all(points[0] == points[-1]))
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    at = np.linspace(0.0, length[-1], SAMPLES, endpoint=not closed)
    center = np.column_stack([np.interp(at, length, points[:, 0]), np.interp(at, length, points[:, 1])])

    # Matrices of the first and second differences; a road that is no loop has none at its ends.
    ahead = np.roll(np.eye(SAMPLES), 1, axis=1)
    first, second = 0.5 * (ahead - ahead.T), ahead - 2.0 * np.eye(SAMPLES) + ahead.T
    if not closed:
        first[0], first[-1] = ahead[0] - np.eye(SAMPLES)[0], np.eye(SAMPLES)[-1] - ahead.T[-1]
        second = second[1:-1]

    # Moving point i sideways by offset i changes the second differences linearly: a least squares problem.
    along = first @ center
    along /= np.maximum(1e-9, np.hypot(*along.T))[:, None]
    sideways = np.column_stack([-along[:, 1], along[:, 0]])
    matrix = np.vstack([second * sideways[:, 0], second * sideways[:, 1]])
    bends = second @ center
    offset = lsq_linear(matrix, -np.concatenate([bends[:, 0], bends[:, 1]]), (-LINE_ROOM_M, LINE_ROOM_M)).x
    line = center + offset[:, None] * sideways

    velocity = first @ line
    pace = np.maximum(1e-9, np.hypot(*velocity.T))
    bend = np.zeros((SAMPLES, 2))
    bend[slice(None) if closed else slice(1, -1)] = second @ line
    curvature = np.abs(velocity[:, 0] * bend[:, 1] - velocity[:, 1] * bend[:, 0]) / pace**3
    speed = np.minimum(TOP_SPEED_MPS, np.sqrt(LATERAL_MPS2 / np.maximum(1e-9, curvature)))
    # Backwards, twice round because the end of a lap brakes for its start.
    for i in range(2 * SAMPLES - 1, -1, -1) if closed else range(SAMPLES - 2, -1, -1):
        here, there = i % SAMPLES, (i + 1) % SAMPLES
        speed[here] = min(speed[here], math.sqrt(speed[there] ** 2 + 2.0 * BRAKING_MPS2 * pace[here]))
    return line[:, 0], line[:, 1], velocity / pace[:, None], speed


def _racing_line(params: dict) -> tuple:
    points = params["waypoints"]
    n = len(points)
    key = (n, params["track_length"], *map(float, points[0]), *map(float, points[n // 3]))
    if key not in _lines:
        _lines[key] = _work_out(np.array(points, dtype=float))
    return _lines[key]


def terms(params: dict) -> dict:
    """Return the parts of the reward; a log analysis shows them one by one."""
    if not params["all_wheels_on_track"]:
        return {"floor": FLOOR, "line": 0.0, "speed": 0.0}
    x, y, direction, target = _racing_line(params)
    squared = (x - params["x"]) ** 2 + (y - params["y"]) ** 2
    i = int(squared.argmin())
    heading = math.radians(params["heading"])
    along = max(0.0, direction[i, 0] * math.cos(heading) + direction[i, 1] * math.sin(heading))
    on_line = math.exp(-squared[i] / LINE_WIDTH_M**2)
    fit = math.exp(-(((params["speed"] - target[i]) / SPEED_WIDTH_MPS) ** 2)) * target[i] / TOP_SPEED_MPS
    line, speed = float(along * LINE_WEIGHT * on_line), float(along * SPEED_WEIGHT * fit)
    return {"floor": FLOOR, "line": line, "speed": speed}


def reward_function(params: dict) -> float:
    """Reward line, direction and target speed."""
    return sum(terms(params).values())


def reward_batch(params: dict) -> np.ndarray:
    """Apply the same formula to many cars."""
    x, y, direction, target = _racing_line(params)
    squared = (x - params["x"][:, None]) ** 2 + (y - params["y"][:, None]) ** 2
    i = squared.argmin(axis=1)
    heading = np.radians(params["heading"])
    along = np.maximum(0.0, direction[i, 0] * np.cos(heading) + direction[i, 1] * np.sin(heading))
    on_line = np.exp(-squared[np.arange(len(i)), i] / LINE_WIDTH_M**2)
    fit = np.exp(-(((params["speed"] - target[i]) / SPEED_WIDTH_MPS) ** 2)) * target[i] / TOP_SPEED_MPS
    reward = FLOOR + along * (LINE_WEIGHT * on_line + SPEED_WEIGHT * fit)
    return np.where(params["all_wheels_on_track"], reward, FLOOR)
