"""Recordings cut into windows, and the simulated car driven through them with the recorded actions."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.sim.batch import CarBatch

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]

WARM_UP_STEPS = 15
"""Recorded steps before a window, from which a model learns how the car moves: 1 s at 15 Hz."""
_FIRST_MOVING_ROW = 1
"""Row 0 of an episode is the prepare step: the car stands until the action of row 1 is sent."""
_JUMP_M, _JUMP_RAD = 0.5, 1.0
"""Neighbouring rows are further apart than this only where the car was put elsewhere: 7.5 m/s, 15 rad/s."""


@dataclass(frozen=True)
class Windows:
    """M windows of `steps` control steps, each after up to `WARM_UP_STEPS` steps of warm-up.

    The pose of row t was read just after the action of row t was sent: action t moves the car from pose t to t + 1.
    """

    pose: Floats
    """Chassis origin x_m, y_m and heading yaw_rad, (M, WARM_UP_STEPS + 1 + steps, 3)."""
    action: Floats
    """Commanded speed_mps and steering_rad, (M, WARM_UP_STEPS + steps, 2)."""
    first: Ids
    """The row from which on a window is recorded; the rows before it repeat it, (M,)."""
    standing: NDArray[np.bool_]
    """True where the car has just been put down at the start of the window, (M,). Its warm-up is the end of the
    episode before: putting the car down does not turn its wheels straight."""
    iteration: NDArray[np.int64]
    """The iteration that a window is from, (M,)."""
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
        return Windows(
            self.pose[chosen],
            self.action[chosen],
            self.first[chosen],
            self.standing[chosen],
            self.iteration[chosen],
        )


def cut_windows(recorded: pd.DataFrame, front_point_m: float, steps: int) -> Windows:
    """Cut every episode into windows of `steps` that begin every 15 rows, the first where the car begins to move.

    Args:
        recorded: the steps of a `deepracer.recording.Recording`.
        front_point_m: how far the recorded point is ahead of the chassis origin.
        steps: control steps to predict.

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
    first: list[int] = []
    standing: list[bool] = []
    left_out = 0
    end_of_last, last_car = np.zeros(0, np.intp), None
    for (stream, worker, _, _), places in recorded.groupby(
        ["stream", "worker", "iteration", "episode"], sort=False, observed=True
    ).indices.items():
        car = stream, worker
        for at in range(_FIRST_MOVING_ROW, len(places) - steps, WARM_UP_STEPS):
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
            first.append(missing)
            standing.append(stands)
        end_of_last, last_car = places[_FIRST_MOVING_ROW:][-WARM_UP_STEPS:], car
    at_rows = np.array(rows, np.intp).reshape(len(rows), WARM_UP_STEPS + 1 + steps)
    return Windows(
        pose=np.stack([x[at_rows], y[at_rows], np.unwrap(yaw[at_rows], axis=1)], axis=-1),
        action=np.stack([speed, steering], axis=-1)[at_rows[:, :-1]],
        first=np.array(first, np.intp),
        standing=np.array(standing, bool),
        iteration=recorded["iteration"].to_numpy(np.int64)[at_rows[:, -1]],
        left_out=left_out,
    )


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
