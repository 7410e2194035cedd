"""Crashes of cars into others: rectangles against rectangles, as on the service."""

import math

import numpy as np

from deepracer_exp.jit import njit

CAR_M = (0.32352, 0.1961)
"""Crash rectangle of a car or bot, along and across, centred on its origin (deepracer-simapp,
track_geom/constants.py)."""
BOX_M = (0.50, 0.40)
"""Crash rectangle of a box of any type; the first number of the service's pair is the extent across."""


@njit(cache=True, nogil=True)
def first_hit(x_m, y_m, yaw_rad, poses, half_m):  # type: ignore[no-untyped-def]
    """Return the index of the first of K others whose rectangle contains a corner of each of N cars, or -1, (N,).

    Args:
        x_m: of the cars' origins, (N,), metres.
        y_m: of the cars' origins, (N,), metres.
        yaw_rad: headings of the cars, (N,).
        poses: x, y and yaw of the others, (N, K, 3).
        half_m: half the others' extents along and across, (K, 2).
    """
    cars, count = poses.shape[:2]
    hit = np.full(cars, -1)
    half_length, half_width = 0.5 * CAR_M[0], 0.5 * CAR_M[1]
    reach = math.hypot(half_length, half_width)
    for car in range(cars):
        cos, sin = math.cos(yaw_rad[car]), math.sin(yaw_rad[car])
        for other in range(count):
            dx, dy = x_m[car] - poses[car, other, 0], y_m[car] - poses[car, other, 1]
            near = reach + math.hypot(half_m[other, 0], half_m[other, 1])
            if dx * dx + dy * dy >= near * near:
                continue
            turn_cos, turn_sin = math.cos(poses[car, other, 2]), math.sin(poses[car, other, 2])
            for corner in range(4):
                along = half_length if corner < 2 else -half_length
                across = half_width if corner % 2 else -half_width
                px, py = dx + cos * along - sin * across, dy + sin * along + cos * across
                ahead, left = turn_cos * px + turn_sin * py, turn_cos * py - turn_sin * px
                if abs(ahead) < half_m[other, 0] and abs(left) < half_m[other, 1]:
                    hit[car] = other
                    break
            if hit[car] >= 0:
                break
    return hit
