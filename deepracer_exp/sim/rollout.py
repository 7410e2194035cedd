"""Compiled rollouts of one car and their derivatives: the physics of `CarBatch`, for optimisation.

The forces are those of `tyres`. They are integrated as MuJoCo does (semi-implicit Euler), but without its step, which
costs five times as much as the forces.
"""

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.jit import njit

from .tyres import DRIVE, Clock, car_record, push_cars

Floats = NDArray[np.float64]

STATE = (
    *("x", "y", "yaw", "vx", "vy", "yaw_rate"),
    *("steering", "sent_steering", "sent_speed", "ahead", "left"),
    *("rim_front_left", "rim_front_right", "rim_rear_left", "rim_rear_right"),
)
"""A car's state: MuJoCo's position and velocity of the centre of mass, and its `DRIVE` record; SI units."""
_NUDGE = np.array([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
"""Step sizes of the finite differences, by entry of the state."""
_NUDGE_COMMAND = np.array([1e-4, 1e-5])


def one_car(car: CarConfig, floor_friction: float) -> NDArray[np.void]:
    """Return a car on a floor as `CAR` record, (1,)."""
    record = np.full(1, car_record(car))
    record["friction"] *= floor_friction
    return record


def standing(car: CarConfig, x_m: float, y_m: float, yaw_rad: float) -> Floats:
    """Return the state of a car at rest with its chassis origin and heading there, (15,)."""
    state = np.zeros(len(STATE))
    # The joints move the centre of mass, from where it is when the chassis origin is at the world's.
    state[0] = x_m + car.com_x_m * (np.cos(yaw_rad) - 1.0)
    state[1] = y_m + car.com_x_m * np.sin(yaw_rad)
    state[2] = yaw_rad
    return state


@njit(cache=True)
def _load(state, drives):  # type: ignore[no-untyped-def]
    drive = drives[0, 0]
    drive.steering_rad, drive.sent_steering_rad, drive.sent_speed_mps = state[6], state[7], state[8]
    drive.ahead_mps2, drive.left_mps2 = state[9], state[10]
    for wheel in range(4):
        drive.wheel_mps[wheel] = state[11 + wheel]


@njit(cache=True)
def advance(cars, drives, state, command, period, after):  # type: ignore[no-untyped-def]
    """Advance one car by a control period.

    Args:
        cars: its `CAR` record, (1,).
        drives: a `DRIVE` record to work with, (1, 1).
        state: before, (15,).
        command: commanded speed in m/s and steering in radians, (2,).
        period: physics steps of a control period, and the length of one in seconds.
        after: written: the state after it, (15,).
    """
    steps, dt_s = period
    _load(state, drives)
    after[:] = state
    velocity, forces, commands = np.empty((1, 3)), np.empty((1, 3)), np.empty((1, 2))
    velocity[0] = state[3:6]
    commands[0] = command
    mass_kg, inertia_kgm2 = cars[0].mass_kg, cars[0].yaw_inertia_kgm2  # of the configured mass, see `one_car`
    for step in range(steps):
        push_cars(cars, drives, (after[2:3], velocity), commands, Clock(step, steps, dt_s), forces)
        velocity[0, 0] += dt_s * forces[0, 0] / mass_kg
        velocity[0, 1] += dt_s * forces[0, 1] / mass_kg
        velocity[0, 2] += dt_s * forces[0, 2] / inertia_kgm2
        for axis in range(3):
            after[axis] += dt_s * velocity[0, axis]
    after[3:6] = velocity[0]
    drive = drives[0, 0]
    after[6], after[7], after[8] = drive.steering_rad, drive.sent_steering_rad, drive.sent_speed_mps
    after[9], after[10] = drive.ahead_mps2, drive.left_mps2
    for wheel in range(4):
        after[11 + wheel] = drive.wheel_mps[wheel]


@njit(cache=True)
def linearise(cars, drives, states, commands, period, derivatives):  # type: ignore[no-untyped-def]
    """Write the derivatives of each control period by central differences.

    Args:
        cars: as for `advance`.
        drives: likewise.
        states: at the beginning of each period, (n, 15).
        commands: (n, 2).
        period: physics steps of a control period, and the length of one in seconds.
        derivatives: by the state, (n, 15, 15), and by the command, (n, 15, 2): written.
    """
    by_state, by_command = derivatives
    size = states.shape[1]
    low, high = np.empty(size), np.empty(size)
    for n in range(len(commands)):
        state, command = states[n].copy(), commands[n].copy()
        for k in range(size):
            kept = state[k]
            state[k] = kept + _NUDGE[k]
            advance(cars, drives, state, command, period, high)
            state[k] = kept - _NUDGE[k]
            advance(cars, drives, state, command, period, low)
            state[k] = kept
            for row in range(size):
                by_state[n, row, k] = (high[row] - low[row]) / (2.0 * _NUDGE[k])
        for k in range(2):
            kept = command[k]
            command[k] = kept + _NUDGE_COMMAND[k]
            advance(cars, drives, state, command, period, high)
            command[k] = kept - _NUDGE_COMMAND[k]
            advance(cars, drives, state, command, period, low)
            command[k] = kept
            for row in range(size):
                by_command[n, row, k] = (high[row] - low[row]) / (2.0 * _NUDGE_COMMAND[k])


def drive_record() -> NDArray[np.void]:
    """Return a `DRIVE` record to work with, (1, 1)."""
    return np.zeros((1, 1), DRIVE)
