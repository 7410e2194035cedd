"""All cars of a process, stepped together."""

import math
import os
from functools import cache
from typing import Any, NamedTuple

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.errors import RunFailed
from deepracer_exp.jit import cfunc, njit

from .mujoco_model import build_spec
from .tyres import DRIVE, Clock, car_record, push_cars

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]


def _no_clock() -> float:
    return 0.0


@cache
def _compiled_clock() -> Any:
    # At the first car, because commands that simulate none import this file, too.
    return cfunc("float64()", cache=True)(_no_clock)


class CarState(NamedTuple):
    """Pose and motion of the cars: float64 arrays of shape (N,), copies of the physics state."""

    x_m: Floats
    """Chassis origin, world frame."""
    y_m: Floats
    yaw_rad: Floats
    """Heading in (-pi, pi], counter-clockwise from the world's x axis."""
    speed_mps: Floats
    """Speed of the chassis origin along the heading."""
    lateral_mps: Floats
    """Speed of the chassis origin to the left of the heading."""
    yaw_rate_radps: Floats
    wheel_angle_rad: Floats
    """Angle of the front wheels to the left, without the car's trim."""


def cores() -> int:
    """Return the number of cores this process may use."""
    # macOS does not say which these are.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class CarBatch:
    """N cars, each on its own infinite floor, advanced by one control period at a time.

    The result is bit-identical whatever the number of threads and however the cars are split into batches.

    Args:
        car: dimensions and physics settings, the same for all cars.
        n_cars: number of cars.
        threads: number of threads including the caller's; 0 takes all cores this process may run on.
        floor_friction: factor on the tyre friction, one for all or (N,).
    """

    def __init__(self, car: CarConfig, n_cars: int, threads: int, floor_friction: ArrayLike = 1.0) -> None:
        # MuJoCo's own clock, which each stage of a step reads for `mjData.timer`, takes a third of the step.
        mujoco.set_mjcb_time(_compiled_clock().ctypes)
        self.car = car
        self.n_cars = n_cars
        self.model = build_spec(car).compile()
        self._car = car_record(car)
        self._cars = np.full(n_cars, self._car)
        self._tyre_friction = np.full(n_cars, car.tyre_friction)
        self._floor_friction = np.full(n_cars, floor_friction, np.float64)
        self._cars["friction"] = self._tyre_friction * self._floor_friction
        self._batch = mujoco.batch.Batch(self.model, n_cars, threads or cores())
        self._rows: Floats = self._batch.state
        self._qpos: Floats = self._batch.bind("qpos")
        self._qvel: Floats = self._batch.bind("qvel")
        self._forces: Floats = self._batch.bind("qfrc_applied")
        self._drives = self._batch.bind("userdata").view(DRIVE)
        # Position and velocity are adjacent in a row, after the time.
        self._moving: Floats = self._rows[:, 1 : 1 + self.model.nq + self.model.nv]
        self._commands: Floats = np.empty((n_cars, 2))
        self._max_steering_rad = np.deg2rad(car.max_steering_deg)
        self._rest_row = self._rows[0].copy()
        self._everyone = np.arange(n_cars)
        self._all_move = np.ones(n_cars, bool)

    def place(self, ids: Ids, x_m: Floats, y_m: Floats, yaw_rad: Floats) -> None:
        """Put cars at rest, steering straight, with a fresh physics state.

        The cars are distinct; position of the chassis origin and heading are (n,) each.
        """
        ids = np.reshape(ids, -1)
        pose = np.empty((3, len(ids)))
        pose[0], pose[1], pose[2] = x_m, y_m, yaw_rad
        _place(ids, pose, self.car.com_x_m, self._rest_row, self._rows, self._qpos)

    @property
    def acceleration_mps2(self) -> Floats:
        """Acceleration ahead and to the left in the last physics step, (N, 2): a copy."""
        return np.stack([self._drives["ahead_mps2"][:, 0], self._drives["left_mps2"][:, 0]], axis=1)

    def drive(
        self, speed_mps: ArrayLike, steering_rad: ArrayLike, moving: NDArray[np.bool_] | None = None
    ) -> None:
        """Send one command to every car, clipped to the car's limits, and advance one control period.

        Args:
            speed_mps: wanted speeds, (N,).
            steering_rad: wanted steering angles, positive to the left, (N,).
            moving: False for cars whose command is ignored: speed zero, wheels straight, (N,).

        Raises:
            RunFailed: a command or a car's state is not finite, or MuJoCo reports an error; the message
                names the first such car. `state` keeps the state of that moment.
        """
        commands = self._commands
        commands[:, 0], commands[:, 1] = speed_mps, steering_rad
        moving = self._all_move if moving is None else moving
        min_mps, max_mps = self.car.min_speed_mps, self.car.max_speed_mps
        _refuse("command", _limit(commands, moving, min_mps, max_mps, self._max_steering_rad))
        steps, dt_s = self.car.substeps, self.model.opt.timestep
        for step in range(steps):
            motion, clock = (self._qpos[:, 2], self._qvel), Clock(step, steps, dt_s)
            push_cars(self._cars, self._drives, motion, commands, clock, self._forces)
            try:
                self._batch.step()
            except mujoco.batch.SimulationError as error:
                raise RunFailed(f"car {int(error.ids[0])}: {error}") from error
        _refuse("physics state", _first_non_finite(self._moving))

    def read(self, ids: Ids | None = None) -> CarState:
        """Return position and motion of the cars `ids`, (n,) each; None: of all."""
        ids = self._everyone if ids is None else ids
        x_m, y_m, cos, sin, *motion = _read(ids, self._qpos, self._qvel, self.car.com_x_m)
        ahead_mps, left_mps, rate_radps = motion
        wheels_rad = self._drives["steering_rad"][ids, 0]
        return CarState(x_m, y_m, np.arctan2(sin, cos), ahead_mps, left_mps, rate_radps, wheels_rad)

    @property
    def state(self) -> Floats:
        """A copy of the full integration state, (N, nstate); parameters set per car are not part of it.

        After assigning a copy, the cars continue exactly as from the moment it was taken.
        """
        return self._rows.copy()

    @state.setter
    def state(self, rows: Floats) -> None:
        if rows.shape != self._rows.shape:
            raise ValueError(f"state has shape {rows.shape}, these cars need {self._rows.shape}")
        self._rows[:] = rows

    def set_floor_friction(self, ids: Ids, values: Floats) -> None:
        """Set the floor's factor on the tyre friction of cars, (n,)."""
        self._floor_friction[ids] = values
        self._cars["friction"] = self._tyre_friction * self._floor_friction

    def set_friction_scale(self, ids: Ids, scale: Floats) -> None:
        """Multiply cars' tyre friction by scale, (n,), relative to the configured one."""
        self._tyre_friction[ids] = self.car.tyre_friction * scale
        self._cars["friction"] = self._tyre_friction * self._floor_friction

    def set_mass_scale(self, ids: Ids, scale: Floats) -> None:
        """Multiply cars' masses and inertias by scale, (n,), relative to the configured ones."""
        for field in ("mass_scale", "mass_kg", "yaw_inertia_kgm2", "wheel_kg"):
            self._cars[field][ids] = scale * self._car[field]

    def set_motor_scale(self, ids: Ids, scale: Floats) -> None:
        """Multiply cars' motor gain and torque limit by scale, (n,), relative to the configured ones."""
        self._cars["motor_ns_per_m"][ids] = scale[:, None] * self._car["motor_ns_per_m"]
        self._cars["motor_n"][ids] = scale * self._car["motor_n"]

    def set_servo_scale(self, ids: Ids, scale: Floats) -> None:
        """Divide the time constant of cars' steering by scale, (n,), relative to the configured one."""
        self._cars["steering_time_s"][ids] = self._car["steering_time_s"] / scale

    def set_delays(self, ids: Ids, steering_delay_s: Floats, speed_delay_s: Floats) -> None:
        """Set the delays of cars' commands, (n,) each, below a control period, in place of the configured ones."""
        self._cars["steering_delay"][ids] = steering_delay_s * self.car.control_hz
        self._cars["speed_delay"][ids] = speed_delay_s * self.car.control_hz


def _refuse(what: str, car: int) -> None:
    """Raise RunFailed for a car of which a number is not finite; -1 is none."""
    if car >= 0:
        raise RunFailed(f"car {car}: {what} is not finite")


@njit(cache=True, nogil=True)
def _first_non_finite(values):  # type: ignore[no-untyped-def]
    """Return the first row of which a number is not finite, -1 if there is none."""
    for car in range(len(values)):
        for value in values[car]:
            if not math.isfinite(value):
                return car
    return -1


@njit(cache=True, nogil=True)
def _limit(commands, moving, min_mps, max_mps, max_rad):  # type: ignore[no-untyped-def]
    """Clip commanded speeds and angles in place, (N, 2), and make them zero for cars that are not moving, (N,).

    Returns the first car of which a command is not finite, -1 if there is none.
    """
    for car in range(len(commands)):
        speed_mps, steering_rad = commands[car, 0], commands[car, 1]
        if not (math.isfinite(speed_mps) and math.isfinite(steering_rad)):
            return car
        commands[car, 0] = min(max(speed_mps, min_mps), max_mps) * moving[car]
        commands[car, 1] = min(max(steering_rad, -max_rad), max_rad) * moving[car]
    return -1


@njit(cache=True, nogil=True)
def _place(ids, pose, com_m, rest, rows, qpos):  # type: ignore[no-untyped-def]
    """Put the cars `ids` at rest, at x, y and yaw (3, n), in the states `rows`, of which `qpos` is a part."""
    for i in range(len(ids)):
        car, yaw = ids[i], pose[2, i]
        rows[car] = rest
        # The joints move the centre of mass, from where it is when the chassis origin is at the world's.
        qpos[car, 0] = pose[0, i] + com_m * (math.cos(yaw) - 1.0)
        qpos[car, 1] = pose[1, i] + com_m * math.sin(yaw)
        qpos[car, 2] = yaw


@njit(cache=True, nogil=True)
def _read(ids, qpos, qvel, com_m):  # type: ignore[no-untyped-def]
    """Return chassis origins of the cars `ids`, cosines and sines of their headings, and their motion."""
    count = len(ids)
    x_m, y_m, cosines, sines = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    ahead_mps, left_mps, rate_radps = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        car = ids[i]
        cos, sin = math.cos(qpos[car, 2]), math.sin(qpos[car, 2])
        vx, vy, rate = qvel[car, 0], qvel[car, 1], qvel[car, 2]
        x_m[i] = qpos[car, 0] - com_m * (cos - 1.0)
        y_m[i] = qpos[car, 1] - com_m * sin
        cosines[i], sines[i], rate_radps[i] = cos, sin, rate
        ahead_mps[i] = cos * vx + sin * vy
        left_mps[i] = cos * vy - sin * vx - com_m * rate
    return x_m, y_m, cosines, sines, ahead_mps, left_mps, rate_radps
