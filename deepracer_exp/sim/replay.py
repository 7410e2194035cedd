"""The simulated car driven through recorded windows with the recorded actions."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig

from .batch import CarBatch
from .recordings import WARM_UP_STEPS, Windows

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]


class Observer(NamedTuple):
    """How far a car driven along a recording is corrected towards it after each step of the warm-up.

    A recording has poses; how fast the car moves and where its wheels stand has to be found. How far the recorded pose
    is ahead of the predicted one, to the left of it and turned to the left, divided by the control period, are errors
    in m/s, m/s and rad/s; these are the shares of them by which each unknown is corrected.
    """

    speed_per_ahead: float
    lateral_per_left: float
    rate_per_left: float
    rate_per_turn: float
    steering_per_left: float
    steering_per_turn: float


OBSERVER = Observer(0.186, 0.29, 7.733, 0.034, 0.267, 0.051)
"""Found by least squares together with the car of conf/car/deepracer.yaml, on the same windows."""


class Errors(NamedTuple):
    """Predicted minus recorded after each step of M windows, (M, steps)."""

    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    """In (-pi, pi]."""

    @property
    def distance_m(self) -> Floats:
        """How far the prediction is off."""
        distance: Floats = np.hypot(self.x_m, self.y_m)
        return distance


def errors(predicted: Floats, windows: Windows) -> Errors:
    """Hold predicted poses, (M, steps, 3), against the recorded ones."""
    off = predicted - windows.truth
    return Errors(off[..., 0], off[..., 1], _turn(off[..., 2]))


def replay(car: CarConfig, windows: Windows, observer: Observer = OBSERVER, threads: int = 1) -> Floats:
    """Drive one car through each window: the warm-up along the recording, from its start on with the actions alone.

    Args:
        car: the simulated car.
        windows: M windows.
        observer: how the warm-up corrects the car.
        threads: physics threads; 0 means one per core. The result does not depend on it.

    Returns:
        x_m, y_m and yaw_rad after each step of the windows, (M, steps, 3).

    Raises:
        RunFailed: the physics blew up.
    """
    cars = CarBatch(car, len(windows), threads)
    cars.place(np.arange(len(windows)), *windows.pose[:, 0].T)
    driven = np.empty((len(windows), windows.steps, 3))
    for step in range(windows.action.shape[1]):
        known = step >= windows.first
        if step < WARM_UP_STEPS:
            _set_off(cars, np.flatnonzero(windows.first == step), windows.pose[:, step : step + 2])
        speed, steering = windows.action[:, step].T
        cars.drive(speed, steering, moving=known)
        if step >= WARM_UP_STEPS:
            state = cars.read()
            driven[:, step - WARM_UP_STEPS] = np.stack([state.x_m, state.y_m, state.yaw_rad], axis=-1)
            continue
        if step == WARM_UP_STEPS - 1:
            put_down = np.flatnonzero(windows.standing)
            cars.lift(put_down, *windows.start[put_down].T)
            known = known & ~windows.standing
        _correct(cars, np.flatnonzero(known), windows.pose[:, step + 1], observer)
    return driven


def _set_off(cars: CarBatch, ids: Ids, recorded: Floats) -> None:
    """Let cars move as their first two recorded poses, (N, 2, 3), tell."""
    before, after = recorded[ids, 0], recorded[ids, 1]
    velocity = (after - before) / cars.car.control_period_s
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    speed, lateral = cos * velocity[:, 0] + sin * velocity[:, 1], cos * velocity[:, 1] - sin * velocity[:, 0]
    cars.move(ids, before, np.stack([speed, lateral, velocity[:, 2]], axis=-1))


def _correct(cars: CarBatch, ids: Ids, recorded: Floats, observer: Observer) -> None:
    """Put cars at their recorded poses, (N, 3), and correct what the error says about their motion."""
    state, pose = cars.read(), recorded[ids]
    yaw, period = state.yaw_rad[ids], cars.car.control_period_s
    dx, dy = (pose[:, 0] - state.x_m[ids]) / period, (pose[:, 1] - state.y_m[ids]) / period
    ahead, left = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
    turn = _turn(pose[:, 2] - yaw) / period
    motion = [
        state.speed_mps[ids] + observer.speed_per_ahead * ahead,
        state.lateral_mps[ids] + observer.lateral_per_left * left,
        state.yaw_rate_radps[ids] + observer.rate_per_left * left + observer.rate_per_turn * turn,
    ]
    cars.move(ids, pose, np.stack(motion, axis=-1))
    steering = cars.steering_rad[ids]
    cars.steer(ids, steering + observer.steering_per_left * left + observer.steering_per_turn * turn)


def _turn(angle: Floats) -> Floats:
    """Return the angle brought into (-pi, pi]."""
    turn: Floats = np.pi - np.remainder(np.pi - angle, 2.0 * np.pi)
    return turn
