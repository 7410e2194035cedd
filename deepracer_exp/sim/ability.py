"""The limits of a simulated car, measured by driving many cars at random."""

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.tracks.line_time import WINDOW_M, Ability, curvature_per_m, evenly

from .batch import CarBatch

Floats = NDArray[np.float64]

_CARS, _SECONDS = 1000, 6.0
_TURNING = 200
"""Cars that hold their steering angle and speed, for steady turns."""
_APART_M = 0.1
_RUN_UP_M = 1.0
_BINS = 60
_TIGHTEST_PER_M = 3.0


def ability_of(car: CarConfig, low: Floats, high: Floats, floor_friction: float = 1.0) -> Ability:
    """Drive cars with random commands within limits and return the extremes that they reached.

    `low` and `high` are limits of [speed_mps, steering_rad], (2,); `floor_friction` is a factor on the friction of the
    tyres.

    Bends count with the mean speed over `WINDOW_M` on either side: for that long a car can turn faster than steadily,
    while it slides or its weight shifts.
    """
    steps, random = int(_SECONDS * car.control_hz), np.random.default_rng(0)
    cars = CarBatch(car, _CARS, 1, floor_friction)
    sign = random.choice([-1.0, 1.0], _CARS)
    full = np.where(sign < 0, low[1], high[1])
    held = np.column_stack([random.uniform(low[0], high[0], _CARS), full * random.uniform(0.1, 1.0, _CARS)])
    command, left = held.copy(), np.zeros((_CARS, 2), np.int64)
    x_m, y_m, speed = (np.empty((steps + 1, _CARS)) for _ in range(3))
    for step in range(steps + 1):
        now = cars.read()
        x_m[step], y_m[step], speed[step] = now.x_m, now.y_m, np.hypot(now.speed_mps, now.lateral_mps)
        for k in range(2):
            new = left[:, k] <= 0
            # Most commands are limits: the most extreme driving mixes them with others.
            extreme = np.where(random.random(_CARS) < 0.5, low[k], high[k])
            drawn = np.where(random.random(_CARS) < 0.6, extreme, random.uniform(low[k], high[k], _CARS))
            command[new, k] = drawn[new]
            left[new, k] = random.integers(2, 15, _CARS)[new]
        left -= 1
        command[:_TURNING] = held[:_TURNING]
        cars.drive(command[:, 0], command[:, 1])
    # Straight ahead as fast as the limits allow, then as slow.
    straight = CarBatch(car, 1, 1, floor_friction)
    line = [0.0]
    for step in range(steps):
        straight.drive(high[0] if step < steps / 2 else low[0], 0.0)
        line.append(float(straight.read().speed_mps[0]))
    change = np.diff(line) * car.control_hz
    # A car that turns meanwhile loses speed faster.
    braking = max(-change.min(), -np.diff(speed, axis=0).min() * car.control_hz)
    edges = np.linspace(0.0, _TIGHTEST_PER_M, _BINS + 1)
    fastest = np.zeros(_BINS + 1)
    fastest[0] = max(speed.max(), max(line))
    for n in range(_CARS):
        curvature, mean = _bends(x_m[:, n], y_m[:, n], car.control_period_s)
        # A bin's speed is that of its tight end.
        np.maximum.at(fastest, np.minimum(np.searchsorted(edges, curvature), _BINS), mean)
    # A speed that is possible in a bend is possible in a wider one.
    speeds = np.maximum.accumulate(fastest[::-1])
    # Bends tighter than any that was driven.
    speeds[speeds == 0.0] = speeds[speeds > 0.0].min()
    return Ability(edges[::-1].copy(), speeds, float(change.max()), float(braking))


def _bends(x_m: Floats, y_m: Floats, period_s: float) -> tuple[Floats, Floats]:
    """Return curvature and mean speed around the points of a driven line, (m,) each."""
    points = np.column_stack([x_m, y_m])
    even, _ = evenly(points, _APART_M)
    window = round(WINDOW_M / _APART_M)
    place_m = np.r_[0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]
    time_s = np.interp(_APART_M * np.arange(len(even)), place_m, period_s * np.arange(len(points)))
    inside = slice(window + round(_RUN_UP_M / _APART_M), -window)
    curvature = curvature_per_m(even, window)[inside]
    spent_s = np.r_[time_s[2 * window :], np.zeros(2 * window)][: len(even)] - time_s
    mean = 2.0 * window * _APART_M / np.maximum(np.roll(spent_s, window), 1e-9)
    return curvature, mean[inside]
