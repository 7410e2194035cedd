"""All cars of a process, stepped together."""

import os
from typing import NamedTuple

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.errors import RunFailed

from .car import STEERED, WHEELS, build_model

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]

_SETTLE_PERIODS = 60
"""Control periods (4 s) for the car to come to rest after being put down: contacts are damped within 0.1 s."""


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
        self.car = car
        self.n_cars = n_cars
        self.model = build_model(car)
        self._contacts = np.array([self.model.pair(name).id for name in WHEELS])
        self._motors = np.array([self.model.actuator(f"{name}_motor").id for name in WHEELS])
        self._servos = np.array([self.model.actuator(f"{name}_servo").id for name in STEERED])
        steered = [self.model.joint(f"{name}_steer") for name in STEERED]
        self._steer_qpos = np.array([joint.qposadr[0] for joint in steered])
        self._trim_rad = np.deg2rad(car.steering_trim_deg)
        self._rest_row, self._rest_qpos = self._settle()
        self._tyre_friction = np.full(n_cars, car.tyre_friction)
        self._floor_friction = np.broadcast_to(np.asarray(floor_friction, np.float64), n_cars).copy()
        # Along and across the wheel; the other entries are spinning and rolling friction. With one floor for all cars,
        # it is set in the model.
        self.model.pair_friction[self._contacts, :2] = car.tyre_friction * self._floor_friction[0]
        self._batch = mujoco.batch.Batch(self.model, n_cars, threads or len(os.sched_getaffinity(0)))
        self._rows: Floats = self._batch.state
        self._qpos: Floats = self._batch.bind("qpos")
        self._qvel: Floats = self._batch.bind("qvel")
        # Position and velocity are adjacent in a row, after the time.
        self._moving: Floats = self._rows[:, 1 : 1 + self.model.nq + self.model.nv]
        self._ctrl: Floats = self._batch.bind("ctrl")
        self._max_steering_rad = np.deg2rad(car.max_steering_deg)
        self._rows[:] = self._rest_row
        if (self._floor_friction != self._floor_friction[0]).any():
            self._apply_friction(np.arange(n_cars))

    def place(self, ids: ArrayLike, x_m: ArrayLike, y_m: ArrayLike, yaw_rad: ArrayLike) -> None:
        """Put cars at rest on their wheels, steering straight, with a fresh physics state.

        Args:
            ids: distinct indices of cars, (n,).
            x_m: position of the chassis origin, (n,) or one for all.
            y_m: likewise.
            yaw_rad: heading, likewise.
        """
        rows = np.asarray(ids, np.intp)
        half = 0.5 * np.asarray(yaw_rad, np.float64)
        cos, sin = np.cos(half), np.sin(half)
        w, x, y, z = self._rest_qpos[3:7]
        self._rows[rows] = self._rest_row
        self._qpos[rows, 0] = x_m
        self._qpos[rows, 1] = y_m
        # The turn about the vertical, applied to the slight pitch in which the car came to rest.
        self._qpos[rows, 3] = cos * w - sin * z
        self._qpos[rows, 4] = cos * x - sin * y
        self._qpos[rows, 5] = cos * y + sin * x
        self._qpos[rows, 6] = cos * z + sin * w

    def move(self, ids: ArrayLike, pose: Floats, motion: Floats) -> None:
        """Put cars elsewhere in motion; height, pitch, wheel turns and steering angles stay as they are.

        Args:
            ids: distinct indices of cars, (n,).
            pose: x_m, y_m, yaw_rad of the chassis origin, (n, 3).
            motion: speed_mps, lateral_mps, yaw_rate_radps as in `CarState`, (n, 3).
        """
        rows = np.asarray(ids, np.intp)
        half = 0.5 * (pose[:, 2] - self.read().yaw_rad[rows])
        cos, sin = np.cos(half), np.sin(half)
        w, x, y, z = self._qpos[rows, 3:7].T
        turned = [cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w]
        self._qpos[rows, :2] = pose[:, :2]
        self._qpos[rows, 3:7] = np.stack(turned, axis=-1)
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        self._qvel[rows, 0] = cos * motion[:, 0] - sin * motion[:, 1]
        self._qvel[rows, 1] = sin * motion[:, 0] + cos * motion[:, 1]
        self._qvel[rows, 5] = motion[:, 2]

    @property
    def steering_rad(self) -> Floats:
        """Steering angle of the front wheels, (N,): a copy, positive to the left."""
        angle: Floats = self._qpos[:, self._steer_qpos].mean(axis=1)
        return angle

    def lift(self, ids: ArrayLike, x_m: ArrayLike, y_m: ArrayLike, yaw_rad: ArrayLike) -> None:
        """Put cars at rest as `place` does, but keep the state of their front wheels and servos."""
        rows = np.asarray(ids, np.intp)[:, None]
        angles, targets = self._qpos[rows, self._steer_qpos], self._ctrl[rows, self._servos]
        self.place(ids, x_m, y_m, yaw_rad)
        self._qpos[rows, self._steer_qpos], self._ctrl[rows, self._servos] = angles, targets

    def steer(self, ids: ArrayLike, angle_rad: ArrayLike) -> None:
        """Turn cars' front wheels to an angle at once, (n,); the servos continue from there."""
        rows = np.asarray(ids, np.intp)
        angle = np.broadcast_to(np.asarray(angle_rad, np.float64), rows.shape)
        self._qpos[rows[:, None], self._steer_qpos] = angle[:, None]

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
        speed, steering = np.asarray(speed_mps, np.float64), np.asarray(steering_rad, np.float64)
        # MuJoCo would replace all controls of that car by zero.
        _require_finite("command", np.isfinite(np.stack([speed, steering], axis=-1)))
        speed = np.clip(speed, self.car.min_speed_mps, self.car.max_speed_mps)
        steering = np.clip(steering, -self._max_steering_rad, self._max_steering_rad)
        if moving is not None:
            speed, steering = speed * moving, steering * moving
        target = self._front_angles(steering + self._trim_rad)
        self._qpos[:, self._steer_qpos] += self.car.servo_kick * (target - self._ctrl[:, self._servos])
        self._ctrl[:, self._servos] = target
        self._ctrl[:, self._motors] = (speed / self.car.drive_radius_m)[:, None]
        try:
            self._batch.step(nstep=self.car.substeps)
        except mujoco.batch.SimulationError as error:
            raise RunFailed(f"car {int(error.ids[0])}: {error}") from error
        _require_finite("physics state", np.isfinite(self._moving))

    def _front_angles(self, steering: Floats) -> Floats:
        """Return the angles of the left and the right front wheel, (N, 2) or (N, 1) where they are the same."""
        if not self.car.ackermann:
            return steering[:, None]
        tangent = np.tan(steering)[:, None]
        # The centre of the turn is on the line of the rear axle, wheelbase / tangent to the left of its middle.
        length, left = self.car.wheelbase_m, self.car.front_wheel_y_m * np.array([1.0, -1.0])
        angles: Floats = np.arctan(length * tangent / (length - left * tangent))
        return angles

    def read(self) -> CarState:
        """Return position and motion of all cars."""
        q, v = self._qpos, self._qvel
        w, x, y, z = q[:, 3], q[:, 4], q[:, 5], q[:, 6]
        cos_part, sin_part = 1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)
        norm = np.hypot(cos_part, sin_part)
        cos, sin = cos_part / norm, sin_part / norm
        return CarState(
            x_m=q[:, 0].copy(),
            y_m=q[:, 1].copy(),
            yaw_rad=np.arctan2(sin_part, cos_part),
            speed_mps=cos * v[:, 0] + sin * v[:, 1],
            lateral_mps=cos * v[:, 1] - sin * v[:, 0],
            yaw_rate_radps=v[:, 5].copy(),
        )

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

    def set_tyre_friction(self, ids: ArrayLike, values: ArrayLike) -> None:
        """Set the tyre friction coefficient of cars, (n,), without the floor's factor."""
        rows = np.asarray(ids, np.intp)
        self._tyre_friction[rows] = values
        self._apply_friction(rows)

    def set_floor_friction(self, ids: ArrayLike, values: ArrayLike) -> None:
        """Set the floor's factor on the tyre friction of cars, (n,)."""
        rows = np.asarray(ids, np.intp)
        if (self._floor_friction[rows] != values).any():
            self._floor_friction[rows] = values
            self._apply_friction(rows)

    def _apply_friction(self, rows: Ids) -> None:
        friction = self._tyre_friction[rows] * self._floor_friction[rows]
        self._batch.expand("pair_friction")[rows[:, None], self._contacts, :2] = friction[:, None, None]

    def set_mass_scale(self, ids: ArrayLike, scale: ArrayLike) -> None:
        """Multiply cars' masses and inertias by scale, (n,), relative to the configured ones."""
        rows = np.asarray(ids, np.intp)
        factor = np.broadcast_to(np.asarray(scale, np.float64), rows.shape)
        self._batch.expand("body_mass")[rows] = factor[:, None] * self.model.body_mass
        self._batch.expand("body_inertia")[rows] = factor[:, None, None] * self.model.body_inertia
        self._batch.set_const(np.sort(rows))

    def set_motor_scale(self, ids: ArrayLike, scale: ArrayLike) -> None:
        """Multiply cars' motor gain and torque limit by scale, (n,), relative to the configured ones."""
        for field in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
            self._scale(field, ids, self._motors, scale)

    def set_servo_scale(self, ids: ArrayLike, scale: ArrayLike) -> None:
        """Multiply cars' servo gain by scale, (n,), relative to the configured one.

        The damping stays, so that the steering's time constant is divided by scale.
        """
        self._scale("actuator_gainprm", ids, self._servos, scale)
        # An affine bias is (constant, per angle, per speed): the gain appears again as its second entry.
        self._scale("actuator_biasprm", ids, self._servos, scale, column=1)

    def _scale(
        self, field: str, ids: ArrayLike, actuators: Ids, scale: ArrayLike, column: int | None = None
    ) -> None:
        """Set a field's columns (all, or one) of some cars' actuators to the model's times scale."""
        rows = np.asarray(ids, np.intp)
        factor = np.broadcast_to(np.asarray(scale, np.float64), rows.shape)[:, None, None]
        columns = slice(None) if column is None else slice(column, column + 1)
        own = getattr(self.model, field)[actuators, columns]
        self._batch.expand(field)[rows[:, None], actuators, columns] = factor * own

    def _settle(self) -> tuple[Floats, Floats]:
        """Let one car come to rest on its wheels at the world's origin; return its state row and pose."""
        data = mujoco.MjData(self.model)
        mujoco.mj_step(self.model, data, nstep=_SETTLE_PERIODS * self.car.substeps)
        pose = data.qpos.copy()
        if not np.isfinite(pose).all():
            raise ValueError("its physics state is not finite at rest")
        # Settling determines height and pitch; the rest is zero up to rounding.
        pose[:2] = 0.0
        pose[4] = pose[6] = 0.0
        pose[3:7] /= np.linalg.norm(pose[3:7])
        pose[7:] = 0.0
        # A car that steers straight for long has its wheels at the trim.
        pose[self._steer_qpos] = self._trim_rad
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = pose
        data.ctrl[self._servos] = self._trim_rad
        row = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(self.model, data, row, mujoco.mjtState.mjSTATE_INTEGRATION)
        return row, pose


def _require_finite(what: str, finite: NDArray[np.bool_]) -> None:
    """Raise RunFailed for the first car, (N, k), of which a number is not finite."""
    if not finite.all():
        raise RunFailed(f"car {int(np.argmin(finite.all(axis=1)))}: {what} is not finite")
