"""Recordings cut into windows, and the simulated car driven through them with the recorded actions."""

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.sim.tyres import DRIVE, Clock, car_record, send, tyre_forces

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]

WARM_UP_STEPS = 15
"""Recorded steps before a window, from which a model learns how the car moves: 1 s at 15 Hz."""
_FIRST_MOVING_ROW = 1
"""Row 0 of an episode is the prepare step: the car stands until the action of row 1 is sent."""
_JUMP_M, _JUMP_RAD = 0.5, 1.0
"""Neighbouring rows are further apart than this only where the car was put elsewhere: 7.5 m/s, 15 rad/s."""
PERIOD_S = 1.0 / 15.0
"""The service sends an action 15 times a second."""
_MOST_JITTER = 0.8
_LEAST_DRIVEN_M = 0.02
_LEAST_STEADY = 300
"""Steps from which on the share of the time stamps' jitter is worth estimating."""


@dataclass(frozen=True)
class Windows:
    """M windows of `steps` control steps, each after up to `WARM_UP_STEPS` steps of warm-up.

    The pose of row t was read just after the action of row t was sent: action t moves the car from pose t to t + 1.
    """

    pose: Floats
    """Chassis origin x_m, y_m and heading yaw_rad, (M, WARM_UP_STEPS + 1 + steps, 3)."""
    action: Floats
    """Commanded speed_mps and steering_rad, (M, WARM_UP_STEPS + steps, 2)."""
    duration_s: Floats
    """How long each of these steps took, (M, WARM_UP_STEPS + steps)."""
    first: Ids
    """The row from which on a window is recorded; the rows before it repeat it, (M,)."""
    standing: NDArray[np.bool_]
    """True where the car has just been put down at the start of the window, (M,). Its warm-up is the end of the
    episode before: putting the car down does not turn its wheels straight."""
    episode: NDArray[np.int64]
    """The episode that it is from, numbered within the recording, (M,)."""
    left_out: int = 0
    """Windows that were cut away because the car was paused or put elsewhere during them or their warm-up."""

    @property
    def steps(self) -> int:
        """Control steps to predict."""
        return self.action.shape[1] - WARM_UP_STEPS

    @property
    def start(self) -> Floats:
        """Poses at the starts of the windows, (M, 3)."""
        return self.pose[:, WARM_UP_STEPS]

    @property
    def truth(self) -> Floats:
        """Poses after each step to predict, (M, steps, 3)."""
        return self.pose[:, WARM_UP_STEPS + 1 :]

    def __len__(self) -> int:
        return len(self.pose)

    def choose(self, chosen: Ids | NDArray[np.bool_]) -> "Windows":
        """Return some of the windows, by numbers or by a mask."""
        arrays = (field.name for field in fields(self) if field.name != "left_out")
        return Windows(**{name: getattr(self, name)[chosen] for name in arrays})


def cut_windows(
    recorded: pd.DataFrame, front_point_m: float, steps: int, every: int = WARM_UP_STEPS
) -> Windows:
    """Cut every episode into windows of `steps`: where the car begins to move, and from a whole warm-up later on.

    Args:
        recorded: the steps of a `aws.logs.recorded.Recording`.
        front_point_m: how far the recorded point is ahead of the chassis origin.
        steps: control steps to predict.
        every: rows from one window to the next.

    Returns:
        The windows in the order of the recording, without those in which, warm-up included, the car was paused or put
        elsewhere; `left_out` counts them.
    """
    yaw = np.deg2rad(recorded["yaw"].to_numpy(np.float64))
    x = recorded["X"].to_numpy(np.float64) - front_point_m * np.cos(yaw)
    y = recorded["Y"].to_numpy(np.float64) - front_point_m * np.sin(yaw)
    speed = recorded["throttle"].to_numpy(np.float64)
    steering = np.deg2rad(recorded["steer"].to_numpy(np.float64))
    # From row t to t + 1 the car was not free: it was paused, or put elsewhere.
    turned = np.remainder(np.diff(yaw) + np.pi, 2.0 * np.pi) - np.pi
    broken = (np.hypot(np.diff(x), np.diff(y)) > _JUMP_M) | (np.abs(turned) > _JUMP_RAD)
    broken |= (recorded["episode_status"] == "pause").to_numpy()[1:]
    rows: list[Ids] = []
    cut: list[tuple[int, bool, int]] = []  # first, standing, episode
    left_out = 0
    end_of_last, last_car = np.zeros(0, np.intp), None
    episodes = _by_episode(recorded).indices
    for number, ((stream, worker, _, _), places) in enumerate(episodes.items()):
        car = stream, worker
        under_way = range(_FIRST_MOVING_ROW + WARM_UP_STEPS, len(places) - steps, every)
        for at in (_FIRST_MOVING_ROW, *under_way) if len(places) > _FIRST_MOVING_ROW + steps else ():
            ahead = places[at : at + steps + 1]
            stands = at == _FIRST_MOVING_ROW
            if stands:
                before = end_of_last if car == last_car else end_of_last[:0]
            else:
                before = places[max(_FIRST_MOVING_ROW, at - WARM_UP_STEPS) : at]
            # From the end of one episode to the start of the next the car is put down, which the replay does too.
            free = np.concatenate([before[:-1] if stands else before, ahead[:-1]])
            if broken[free].any():
                left_out += 1
                continue
            missing = WARM_UP_STEPS - len(before)
            known = np.concatenate([before, ahead])
            rows.append(np.concatenate([np.full(missing, known[0]), known]))
            cut.append((missing, stands, number))
        end_of_last, last_car = places[_FIRST_MOVING_ROW:][-WARM_UP_STEPS:], car
    at_rows = np.array(rows, np.intp).reshape(len(rows), WARM_UP_STEPS + 1 + steps)
    first, standing, episode = np.array(cut, np.int64).reshape(len(cut), 3).T
    return Windows(
        pose=np.stack([x[at_rows], y[at_rows], np.unwrap(yaw[at_rows], axis=1)], axis=-1),
        action=np.stack([speed, steering], axis=-1)[at_rows[:, :-1]],
        duration_s=_durations(recorded, x, y)[at_rows[:, :-1]],
        first=first,
        standing=standing.astype(bool),
        episode=episode,
        left_out=left_out,
    )


def _by_episode(recorded: pd.DataFrame) -> Any:
    return recorded.groupby(["stream", "worker", "iteration", "episode"], sort=False, observed=True)


def _durations(recorded: pd.DataFrame, x_m: Floats, y_m: Floats) -> Floats:
    """Return how long the step from each row to the next took, (rows,).

    The service sends an action 15 times a second, more or less. Some recordings stamp a row at the end of its step, so
    that the step from row t to t + 1 lasts from stamp t - 1 to t; some, of version 6, at its start: from stamp t to
    t + 1; and in some the stamps' jitter says nothing. Which, and how much of the jitter is real, is found by a
    regression of the distance driven.
    """
    stamp = recorded["tstamp"].to_numpy(np.float64)
    group = _by_episode(recorded).ngroup().to_numpy()
    same = group[1:] == group[:-1]
    jitter = np.diff(stamp) / PERIOD_S - 1.0
    jitter[~same | (np.abs(jitter) > _MOST_JITTER)] = 0.0
    at_end, at_start = np.append(0.0, jitter), np.append(jitter, 0.0)
    driven = np.append(np.hypot(np.diff(x_m), np.diff(y_m)), 0.0)
    around = 0.25 * sum(np.roll(driven, shift) for shift in (-2, -1, 1, 2))
    # Within an episode, away from its ends and moving.
    steady = (at_end != 0.0) & (at_start != 0.0) & (around > _LEAST_DRIVEN_M)
    for shift in (2, 1, 0, -1, -2, -3):
        steady &= np.roll(np.append(False, same), shift)
    longer = driven / np.maximum(around, _LEAST_DRIVEN_M) - 1.0
    steady &= np.abs(longer) < _MOST_JITTER
    if steady.sum() < _LEAST_STEADY:
        return np.full(len(stamp), PERIOD_S)
    # Neighbours take part: they are in `around`, and jitter alternates.
    columns = [np.roll(at_end, shift)[steady] for shift in (0, -1, 2, 1, -2, -3)]
    shares = np.linalg.lstsq(np.stack([*columns, np.ones(steady.sum())], axis=1), longer[steady], rcond=None)[
        0
    ]
    real = at_end if shares[0] >= shares[1] else at_start
    durations: Floats = PERIOD_S * (1.0 + np.clip(shares[:2].max(), 0.0, 1.0) * real)
    return durations


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


OBSERVER = Observer(0.33, 0.7, 2.7, 0.7, 0.06, 0.08)
"""Where a fit of an observer to a car and its recordings begins."""


class Errors(NamedTuple):
    """Predicted minus recorded after each step of M windows, (M, steps)."""

    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    """In (-pi, pi]."""

    @property
    def distance_m(self) -> Floats:
        """Distance between prediction and recording."""
        distance: Floats = np.hypot(self.x_m, self.y_m)
        return distance


def errors(predicted: Floats, windows: Windows) -> Errors:
    """Return how far predicted poses, (M, steps, 3), are from the recorded ones."""
    off = predicted - windows.truth
    return Errors(off[..., 0], off[..., 1], np.pi - np.remainder(np.pi - off[..., 2], 2.0 * np.pi))


def replay(car: CarConfig, windows: Windows, observer: Observer = OBSERVER) -> Floats:
    """Drive one car through each window: the warm-up along the recording, from its start on with the actions alone.

    The car is the one of `sim.batch`, without MuJoCo: a physics step is a share of the time that was recorded.

    Args:
        car: the simulated car.
        windows: M windows.
        observer: how the warm-up corrects the car.

    Returns:
        x_m, y_m and yaw_rad after each step of the windows, (M, steps, 3); not finite where the physics blew up.
    """
    commands = windows.action.copy()
    limit = np.deg2rad(car.max_steering_deg)
    np.clip(commands[..., 0], car.min_speed_mps, car.max_speed_mps, out=commands[..., 0])
    np.clip(commands[..., 1], -limit, limit, out=commands[..., 1])
    driven = np.empty((len(windows), windows.steps, 3))
    _replay(
        car_record(car)[None],
        np.zeros(1, DRIVE),
        np.array(observer),
        car.substeps,
        windows.pose,
        commands,
        windows.duration_s,
        windows.first,
        windows.standing,
        driven,
    )
    return driven


@njit(cache=True)
def _replay(cars, drives, observer, substeps, pose, commands, duration_s, first, standing, driven):  # type: ignore[no-untyped-def]
    car = cars[0]
    com_m = car["com_x_m"]
    for window in range(len(pose)):
        drives[:] = np.zeros(1, DRIVE)
        drive = drives[0]
        at = first[window]
        x, y, yaw = pose[window, at]
        ahead = left = rate = 0.0
        if at < WARM_UP_STEPS:
            # It sets off as its first two recorded poses say.
            lasted = duration_s[window, at]
            dx, dy = (pose[window, at + 1, 0] - x) / lasted, (pose[window, at + 1, 1] - y) / lasted
            rate = (pose[window, at + 1, 2] - yaw) / lasted
            ahead, left = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
            drive["sent_speed_mps"], drive["sent_steering_rad"] = commands[window, at]
            drive["steering_rad"] = commands[window, at, 1]
            drive["wheel_mps"][:] = ahead
        for step in range(at, commands.shape[1]):
            dt = duration_s[window, step] / substeps
            # The centre of mass in the world.
            cos, sin = np.cos(yaw), np.sin(yaw)
            x, y, left = x + com_m * cos, y + com_m * sin, left + com_m * rate
            vx, vy = cos * ahead - sin * left, sin * ahead + cos * left
            for physics_step in range(substeps):
                send(car, drive, commands[window, step], Clock(physics_step, substeps, dt))
                ahead, left = cos * vx + sin * vy, cos * vy - sin * vx
                ahead_n, left_n, torque_nm = tyre_forces(car, drive, ahead, left, rate, dt)
                vx += dt * (cos * ahead_n - sin * left_n) / car["mass_kg"]
                vy += dt * (sin * ahead_n + cos * left_n) / car["mass_kg"]
                rate += dt * torque_nm / car["yaw_inertia_kgm2"]
                x, y, yaw = x + dt * vx, y + dt * vy, yaw + dt * rate
                cos, sin = np.cos(yaw), np.sin(yaw)
            x, y = x - com_m * cos, y - com_m * sin
            ahead, left = cos * vx + sin * vy, cos * vy - sin * vx - com_m * rate
            if step >= WARM_UP_STEPS:
                driven[window, step - WARM_UP_STEPS, 0] = x
                driven[window, step - WARM_UP_STEPS, 1] = y
                driven[window, step - WARM_UP_STEPS, 2] = yaw
                continue
            dx, dy = (pose[window, step + 1, 0] - x), (pose[window, step + 1, 1] - y)
            turn = np.pi - np.remainder(np.pi - pose[window, step + 1, 2] + yaw, 2.0 * np.pi)
            lasted = duration_s[window, step]
            off_ahead, off_left = (cos * dx + sin * dy) / lasted, (cos * dy - sin * dx) / lasted
            x, y, yaw = pose[window, step + 1]
            if standing[window] and step == WARM_UP_STEPS - 1:
                # Put down, at rest; its wheels stay turned.
                steering, sent = drive["steering_rad"], drive["sent_steering_rad"]
                drives[:] = np.zeros(1, DRIVE)
                drive["steering_rad"], drive["sent_steering_rad"] = steering, sent
                ahead = left = rate = 0.0
                continue
            ahead += observer[0] * off_ahead
            left += observer[1] * off_left
            rate += observer[2] * off_left + observer[3] * turn / lasted
            drive["steering_rad"] += observer[4] * off_left + observer[5] * turn / lasted
