"""The search for the fastest lap: receding-horizon planning, then refinement of the whole lap.

As in the environment, a command is held for a control period, and the track limits count at its end. The search
maximises the distance in a given number of periods; once the car crosses the line with a period to spare, it continues
with one period less.

Refinement finds local optima only. So each window is planned from several initial guesses and the plan that gets
farthest is driven; then the lap is searched again, with the line of the best one so far among the guesses.
"""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.errors import RunFailed
from deepracer_exp.sim.rollout import advance, drive_record, one_car, standing
from deepracer_exp.tracks.line_time import evenly
from deepracer_exp.tracks.segments import Geometry
from deepracer_exp.tracks.track import Track

from .optimal_control import Aim, Motion, clearance_m, driven_m, improve, origin

Floats = NDArray[np.float64]
OnRound = Callable[[float, float | None], None]
"""Receives the completed share of the search and the best lap time in s, None before a lap is found."""

MARGIN_M = 0.002
"""Clearance of the innermost wheel from the border, against the rounding of the optimisation."""
_WINDOW, _TRUSTED = 60, 45
"""Control periods that are planned at a time, and that are kept of a plan."""
_LOOK_AHEAD_M, _APART_M = 0.35, 0.05
_SLOWEST_LAP_MPS = 0.2
_CALM = np.array([1e-4, 1e-3])
"""Cost of a changed command, per (m/s)**2 and rad**2, in metres; it fades away."""
_FADE = 0.96
_STEPS = 5
_GAIN_M = 2e-3
_STIFFENING = 1.1
_MOST_DAMPING = 100.0


class _Pass(NamedTuple):
    """Settings of the search for a lap."""

    driven: int
    """Control periods that are driven before the next plan."""
    guessed_mps: tuple[float, ...]
    """Speeds along each line where there is no plan yet."""


PASSES = (_Pass(10, (1.8, 2.6)), _Pass(7, (2.0, 3.0)), _Pass(8, (2.0, 3.0)))
"""They differ, to end in different laps."""


class Problem(NamedTuple):
    """A lap's parameters for compiled code."""

    course: Geometry
    front_point_m: float
    com_x_m: float
    wheels_m: Floats
    begin_m: float
    closed: bool
    margin_m: float


class Search:
    """Searches for the fastest lap of one car on one track, from standstill at the start line."""

    def __init__(self, car: CarConfig, track: Track, low: Floats, high: Floats) -> None:
        """Put the car at its start.

        `low` and `high` limit the commands [speed_mps, steering_rad], within the limits of the car, (2,) each.
        """
        self._car, self._track, self._limits = car, track, np.array([low, high])
        self._cars, self._drive = one_car(car, track.floor.friction), drive_record()
        self._dt_s = car.control_period_s / car.substeps
        pose = track.start_pose(np.zeros(1))
        self._start = standing(car, pose.x[0], pose.y[0], pose.yaw_rad[0])

    def run(self, lines: Sequence[Floats], on_round: OnRound) -> Floats:
        """Return the commands of the fastest lap that was found, [speed_mps, steering_rad] of each period, (n, 2).

        `lines` are first guesses of the way, (n, 2) each, from the start on; `on_round` is called after each plan.

        Raises:
            RunFailed: no lap is possible within the limits.
        """
        best: _Plan | None = None
        for number, how in enumerate(PASSES):
            best_s = None if best is None else lap_time_s(len(best.commands), self._car)
            ways = lines if best is None else (*lines, self._line(best.commands))
            guesses = list(product([evenly(way, _APART_M)[0] for way in ways], how.guessed_mps))

            def progressed(share: float, number: int = number, best_s: float | None = best_s) -> None:
                on_round((number + share) / len(PASSES), best_s)

            commands = self._window_by_window(guesses, how.driven, progressed)
            if commands is None:
                continue
            plan = self._improved(self._start, commands, 0.0, self._track.length_m, _LAP)
            if plan.complete and (best is None or plan.score < best.score):
                best = plan
        if best is not None:
            on_round(1.0, lap_time_s(len(best.commands), self._car))
            return best.commands
        low, high = self._limits
        raise RunFailed(
            f"{self._track.name}: no lap was found that stays on the road with {low[0]:g} to {high[0]:g} m/s and "
            f"steering of {np.degrees(low[1]):g} to {np.degrees(high[1]):g} degrees"
        )

    def _line(self, commands: Floats) -> Floats:
        """Return the chassis origins of a lap, (n, 2)."""
        return np.array(
            [origin(state, self._car.com_x_m)[:2] for state in self._states(self._start, commands)]
        )

    def _window_by_window(
        self, guesses: Sequence[tuple[Floats, float]], driven: int, progressed: Callable[[float], None]
    ) -> Floats | None:
        """Return the commands of a fast lap, None if the car does not get around.

        A window of the next seconds is planned as if only the way in it counted, once from each guess. The first
        periods of the best plan are driven, and the next window begins there with what is left of the plan.

        Args:
            guesses: lines (n, 2), and the speed in m/s at which they are followed where there is no plan yet.
            driven: control periods that are driven before the next plan.
            progressed: called with the share of the lap that is driven.
        """
        state, driven_m_, plan = self._start, 0.0, np.empty((0, 2))
        commands: list[Floats] = []
        length_m = self._track.length_m
        for _ in range(math.ceil(length_m / _SLOWEST_LAP_MPS * self._car.control_hz / driven)):
            begin_m, kept = driven_m_, self._states(state, plan)[-1]
            tails = [self._along(line, speed_mps, kept, _WINDOW - len(plan)) for line, speed_mps in guesses]
            plans = [
                self._improved(state, np.concatenate([plan, tail]), begin_m, length_m - begin_m, _AHEAD)
                for tail in tails
            ]
            planned = min(plans, key=lambda plan: plan.score)
            plan = planned.commands
            if planned.complete:
                return np.concatenate([*commands, plan])
            states = self._states(state, plan[:driven])
            moved_m = float(self._driven_m(states, begin_m)[-1])
            if moved_m < _SLOWEST_LAP_MPS * driven / self._car.control_hz:
                return None
            commands.append(plan[:driven])
            state, plan, driven_m_ = states[-1], plan[driven:_TRUSTED], driven_m_ + moved_m
            progressed(min(driven_m_ / length_m, 1.0))
        return None

    def _states(self, start: Floats, commands: Floats) -> Floats:
        """Return the states from `start` on that commands (n, 2) lead to, (n + 1, 15)."""
        states = np.empty((len(commands) + 1, len(start)))
        states[0] = start
        period = self._car.substeps, self._dt_s
        for n, command in enumerate(commands):
            advance(self._cars, self._drive, states[n], command, period, states[n + 1])
        return states

    def _driven_m(self, states: Floats, begin_m: float) -> Floats:
        problem = self._problem(begin_m)
        return driven_m(
            problem.course, problem.front_point_m, problem.com_x_m, states, begin_m, problem.closed
        )

    def _along(self, line: Floats, speed_mps: float, state: Floats, periods: int) -> Floats:
        """Return commands that send the car along a line, (periods, 2); it steers to a point ahead (pure pursuit)."""
        commands = np.empty((periods, 2))
        x, y, _, _ = origin(state, self._car.com_x_m)
        place = int(np.hypot(line[:, 0] - x, line[:, 1] - y).argmin())
        ahead = round(_LOOK_AHEAD_M / _APART_M)
        for n in range(periods):
            x, y, _, _ = origin(state, self._car.com_x_m)
            near = line[place : place + 2 * ahead]
            place += int(np.hypot(near[:, 0] - x, near[:, 1] - y).argmin())
            aim = self._point(line, place + ahead)
            away_m = math.hypot(aim[0] - x, aim[1] - y)
            bearing = math.remainder(math.atan2(aim[1] - y, aim[0] - x) - state[2], 2 * math.pi)
            steering = math.atan(2 * self._car.wheelbase_m * math.sin(bearing) / max(away_m, 1e-3))
            commands[n] = np.clip([speed_mps, steering], *self._limits)
            state = self._states(state, commands[n : n + 1])[-1]
        return commands

    def _point(self, line: Floats, place: int) -> Floats:
        """Return a point of a line; beyond its end it continues, around a closed course or straight ahead."""
        last = len(line) - 1
        if place <= last:
            return line[place]
        if self._track.closed:
            return line[min(place - last, last)]
        return line[-1] + (place - last) * (line[-1] - line[-2])

    def _improved(
        self,
        start: Floats,
        commands: Floats,
        begin_m: float,
        goal_m: float,
        effort: "_Effort",
    ) -> "_Plan":
        """Return commands (n, 2) that get a car farther than those given, or past `goal_m` in fewer periods."""
        problem = self._problem(begin_m)
        states = self._states(start, commands)
        commands = commands.copy()
        pull, damping, firm = np.zeros(len(states)), 1.0, effort.soft
        best, since = _Plan(commands, False, False, 0.0), 0
        for number in range(effort.rounds):
            motion = Motion(self._cars, self._drive, (self._car.substeps, self._dt_s))
            aim = Aim(self._limits, pull, firm, _CALM * _FADE**number)
            damping = improve(motion, problem, (states, commands), aim, min(damping, _MOST_DAMPING), _STEPS)
            driven = self._driven_m(states, begin_m)
            room_m = np.array(
                [clearance_m(problem.course, problem.wheels_m, problem.com_x_m, state) for state in states]
            )
            pull = np.maximum(0.0, pull + firm * (MARGIN_M - room_m))
            pull[0] = 0.0
            firm = min(firm * _STIFFENING, effort.firm)
            over = np.flatnonzero(driven >= goal_m)
            end = int(over[0]) if len(over) else len(commands)
            on_road = bool((room_m[: end + problem.closed] > 0.0).all())
            plan = _Plan(commands[:end].copy(), bool(len(over)) and on_road, on_road, float(driven[end]))
            gained = plan.score < (*best.score[:-1], best.score[-1] - _GAIN_M)
            # A plan that leaves the road is never good enough.
            since = 0 if gained or not best.on_road else since + 1
            best = min(best, plan, key=lambda plan: plan.score)
            if plan.complete:  # now in fewer periods
                states, commands, pull = (
                    states[: end + 1].copy(),
                    commands[:end].copy(),
                    pull[: end + 1].copy(),
                )
            if since >= effort.patience:
                break
        return best

    def _problem(self, begin_m: float) -> Problem:
        """Return the lap as seen from a place on the centre line."""
        return Problem(
            course=self._track.geometry,
            front_point_m=self._car.front_point_m,
            com_x_m=self._car.com_x_m,
            wheels_m=np.array(self._car.wheel_points_m),
            begin_m=begin_m,
            closed=self._track.closed,
            margin_m=MARGIN_M,
        )


class _Effort(NamedTuple):
    """Limits of the improvement of commands."""

    rounds: int
    patience: int
    """Rounds without a gain of `_GAIN_M` after which it ends."""
    soft: float
    """Stiffness of the borders to begin with."""
    firm: float
    """The most it becomes."""


_AHEAD = _Effort(rounds=12, patience=3, soft=100.0, firm=300.0)
_LAP = _Effort(rounds=80, patience=8, soft=200.0, firm=500.0)


class _Plan(NamedTuple):
    """Commands and their states."""

    commands: Floats
    complete: bool
    """Whether the goal is passed, on the road all the way."""
    on_road: bool
    driven_m: float

    @property
    def score(self) -> tuple[bool, bool, int, float]:
        """Return a cost, smaller for a better plan."""
        return not self.complete, not self.on_road, len(self.commands), -self.driven_m


def lap_time_s(periods: int, car: CarConfig) -> float:
    """Return the time of a lap that takes so many control periods from its first command to the line, in s.

    Before that the clock counts the prepare step and the step that gives the command.
    """
    return float(lap_clock_s(periods + 2, car.control_period_s))
