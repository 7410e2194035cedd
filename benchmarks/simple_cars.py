"""Two cars that are no physics: the bicycle, and a formula fitted to recordings."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.replay import WARM_UP_STEPS, Windows, errors
from deepracer_exp.config.car import CarConfig

Floats = NDArray[np.float64]


def bicycle(car: CarConfig, windows: Windows) -> Floats:
    """Predict with the kinematic bicycle, commanded speed and steering reached at once.

    Returns:
        x_m, y_m and yaw_rad after each step, (M, steps, 3).
    """
    period, ratio = car.control_period_s, -car.rear_axle_x_m / car.wheelbase_m
    x, y, yaw = windows.start.T
    driven = np.empty_like(windows.truth)
    for step in range(windows.steps):
        speed, steering = windows.action[:, WARM_UP_STEPS + step].T
        rate = speed * np.tan(steering) / car.wheelbase_m
        # The origin is ahead of the rear axle, which goes where it points.
        course = yaw + 0.5 * period * rate + np.arctan(ratio * np.tan(steering))
        along = speed * np.hypot(1.0, ratio * np.tan(steering)) * period
        x, y, yaw = x + along * np.cos(course), y + along * np.sin(course), yaw + period * rate
        driven[:, step] = np.stack([x, y, yaw], axis=-1)
    return driven


class Formula(NamedTuple):
    """Speed and yaw rate follow what is commanded, each with a lag of its own."""

    speed_ratio: float = 1.0
    speed_lag_s: float = 0.2
    trim_rad: float = 0.0
    gain: float = 0.7
    """Share of the bicycle's yaw rate that is reached."""
    gain_loss: float = 0.05
    """How much of the share is lost with the square of the speed, s2/m2."""
    rate_lag_s: float = 0.5
    speed_correction: float = 0.3
    """Share of the warm-up's errors by which speed and yaw rate are corrected, as `benchmarks.replay.Observer`."""
    rate_correction: float = 0.5

    def predict(self, car: CarConfig, windows: Windows) -> Floats:
        """Return x_m, y_m and yaw_rad after each step, (M, steps, 3)."""
        period = car.control_period_s
        x, y, yaw = windows.pose[:, 0].T
        speed, rate = np.zeros(len(windows)), np.zeros(len(windows))
        keep_speed, keep_rate = np.exp(-period / self.speed_lag_s), np.exp(-period / self.rate_lag_s)
        driven = np.empty_like(windows.truth)
        for step in range(windows.action.shape[1]):
            known = step >= windows.first
            commanded, steering = windows.action[:, step].T
            to_speed = self.speed_ratio * commanded
            to_rate = (
                (self.gain - self.gain_loss * speed**2)
                * speed
                * np.tan(steering + self.trim_rad)
                / car.wheelbase_m
            )
            new_speed = np.where(known, to_speed + keep_speed * (speed - to_speed), 0.0)
            new_rate = np.where(known, to_rate + keep_rate * (rate - to_rate), 0.0)
            along, turn = 0.5 * period * (speed + new_speed), 0.5 * period * (rate + new_rate)
            x, y = x + along * np.cos(yaw + 0.5 * turn), y + along * np.sin(yaw + 0.5 * turn)
            yaw, speed, rate = yaw + turn, new_speed, new_rate
            if step >= WARM_UP_STEPS:
                driven[:, step - WARM_UP_STEPS] = np.stack([x, y, yaw], axis=-1)
                continue
            recorded = windows.pose[:, step + 1]
            ahead = np.cos(yaw) * (recorded[:, 0] - x) + np.sin(yaw) * (recorded[:, 1] - y)
            turned = np.remainder(recorded[:, 2] - yaw + np.pi, 2.0 * np.pi) - np.pi
            speed = np.where(known, speed + self.speed_correction * ahead / period, 0.0)
            rate = np.where(known, rate + self.rate_correction * turned / period, 0.0)
            x, y, yaw = recorded.T
            if step == WARM_UP_STEPS - 1:
                speed, rate = np.where(windows.standing, 0.0, speed), np.where(windows.standing, 0.0, rate)
        return driven


def fit_formula(car: CarConfig, windows: Windows) -> Formula:
    """Return the formula that predicts the windows best."""
    begin = np.array(Formula())

    def residuals(values: Floats) -> Floats:
        off = errors(Formula(*values).predict(car, windows), windows)
        return np.concatenate([off.x_m.ravel(), off.y_m.ravel()]) / 0.08

    low = [0.5, 0.02, -0.2, 0.0, -0.2, 0.02, 0.0, 0.0]
    high = [1.5, 2.0, 0.2, 2.0, 0.5, 3.0, 1.0, 2.0]
    found = least_squares(residuals, begin, loss="soft_l1", bounds=(low, high), max_nfev=30)
    return Formula(*map(float, found.x))
