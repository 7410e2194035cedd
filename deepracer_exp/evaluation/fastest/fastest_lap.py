"""The fastest lap of a car on a track: found once, driven in the environment, and kept on disk.

The lap is of the kind that evaluations drive: it begins with the reset, from standstill on the centre line, and its
time is that of `rules.lap_clock_s`. A list of actions counts with its largest and smallest steering and speed, between
which the commands of the lap are free.
"""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.cache import cache_home
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.named import no_randomization
from deepracer_exp.env.action_space import ContinuousActions, build_action_space
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import Course, build_setup
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.files import atomic_write, read_json
from deepracer_exp.rewards.source import NO_REWARD
from deepracer_exp.sim.ability import ability_of
from deepracer_exp.tracks.line_time import Ability, fastest_line
from deepracer_exp.tracks.track import Track

from .lap_search import OnRound, Search, lap_time_s

Floats = NDArray[np.float64]

ALGORITHM = 3
"""Version of the search; laps found by an earlier one are searched again."""
COLUMNS = ("time_s", "x_m", "y_m", "yaw_rad", "speed_mps", "progress", "steering_deg", "commanded_mps")
"""Columns of a lap's steps: clock, front point, heading, speed, per cent of the lap, and the command given there."""
_TRACED = ("tstamp", "X", "Y", "yaw", "speed_mps", "progress", "steer", "throttle")
_LINE_M = 0.1
_SHIPPED = Path(__file__).with_name("kept")
"""Laps as `_keep` writes them: that of the default car on the default track, which a first training is compared with.
Where a change of the car makes it another question, the file that `deepracer-exp tracks reinvent_base --fastest` leaves
in the cache takes its place."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FastestLap:
    """A lap, as it was driven in the environment."""

    lap_time_s: float
    """By the service's clock, from the reset on."""
    bound_s: float
    """Lower bound of the lap time, from a search over lines (`tracks.line_time`)."""
    steps: Floats
    """Control steps of the lap, the prepare step first, (n, `COLUMNS`)."""

    def column(self, name: str) -> Floats:
        """Return one of `COLUMNS`, (n,)."""
        return self.steps[:, COLUMNS.index(name)]

    @cached_property
    def over_bound(self) -> float:
        """Return the lap's excess over its bound as a share."""
        return self.lap_time_s / self.bound_s - 1.0


def command_limits(experiment: Experiment) -> tuple[Floats, Floats]:
    """Return lowest and highest [steering_deg, speed_mps] of the actions, within the limits of the car, (2,) each."""
    actions, car = build_action_space(experiment.action_space), experiment.car
    low, high = [-car.max_steering_deg, car.min_speed_mps], [car.max_steering_deg, car.max_speed_mps]
    return np.clip(actions.low, low, high), np.clip(actions.high, low, high)


@dataclass(frozen=True, eq=False, kw_only=True)
class Question:
    """The parameters that a fastest lap depends on."""

    experiment: Experiment
    track: Track
    low: Floats
    """Lowest command [steering_deg, speed_mps], (2,)."""
    high: Floats

    @classmethod
    def of(cls, experiment: Experiment, track: Track) -> "Question":
        """Return the question for an experiment's car and action space on a track.

        Raises:
            BadInput: the limits of the action space leave the car nothing to choose.
        """
        low, high = command_limits(experiment)
        if (low == high).any():
            name = "speed" if low[1] == high[1] else "steering_angle"
            raise BadInput(
                f"action_space: {name} is always {low[int(name == 'speed')]:g}; accepted for a fastest lap: two "
                "different limits"
            )
        return cls(experiment=experiment, track=track, low=low, high=high)

    @cached_property
    def key(self) -> str:
        """Return a hash of track, car, limits and algorithm."""
        track = self.track
        question = {
            "algorithm": ALGORITHM,
            "car": asdict(self.experiment.car),
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "closed": track.closed,
            "friction": track.floor.friction,
        }
        digest = hashlib.sha256(json.dumps(question, sort_keys=True).encode())
        for line in (track.waypoints, track.inner, track.outer):
            digest.update(np.ascontiguousarray(line, np.float64).tobytes())
        return digest.hexdigest()[:32]

    @property
    def _limits(self) -> tuple[Floats, Floats]:
        """Return lowest and highest [speed_mps, steering_rad], (2,) each."""
        return np.array([self.low[1], math.radians(self.low[0])]), np.array(
            [self.high[1], math.radians(self.high[0])]
        )

    def answer(self, on_round: OnRound) -> FastestLap:
        """Search for the lap and drive it in the environment.

        Raises:
            RunFailed: no lap is possible within the limits.
        """
        car, track = self.experiment.car, self.track
        bound_s, line = self._bound()
        places = np.linspace(0.0, 1.0, round(track.length_m / _LINE_M))
        search = Search(car, track, *self._limits)
        commands = search.run((track.points_at(places), line), on_round)
        steps = self._drive(commands)
        ahead = car.front_point_m * np.column_stack([np.cos(steps[:, 3]), np.sin(steps[:, 3])])
        time_s = float(steps[-1, 0])
        # The search for the line of the bound is local, too.
        bound_s = min(bound_s, self._bound(steps[1:, 1:3] - ahead[1:])[0], time_s)
        return FastestLap(lap_time_s=time_s, bound_s=bound_s, steps=steps)

    @cached_property
    def _ability(self) -> Ability:
        return ability_of(self.experiment.car, *self._limits, self.track.floor.friction)

    def _bound(self, driven: Floats | None = None) -> tuple[float, Floats]:
        """Return the bound from below of the lap time in s, and its line, (n, 2).

        `driven` are chassis origins of a lap (n, 2), from whose line the search for the least time begins, in place of
        simple lines.
        """
        car = self.experiment.car
        least_s, line = fastest_line(self.track, car.reach_m, self._ability, 0.0, car.front_point_m, driven)
        # A lap ends with a control step.
        return lap_time_s(math.ceil(least_s * car.control_hz - 1e-9), car), line

    def _drive(self, commands: Floats) -> Floats:
        """Drive commands [speed_mps, steering_rad], (n, 2), in the environment and return its steps."""
        experiment, track = self.experiment, self.track
        course = Course(name=track.name, weight=1.0, tracks=(track,))
        # Alone on the road, and seen by no sensor: only the commands drive.
        setup = replace(
            build_setup(experiment, (course,), NO_REWARD),
            actions=ContinuousActions(self.low, self.high),
            observation=replace(experiment.observation, camera=None, lidar=None, next_objects=0),
            randomization=no_randomization(),
            episode=replace(experiment.episode, max_steps=0),
            others=None,
        )
        race = Race(setup, 1)
        race.reset(None, None, np.zeros(1))
        wanted = np.column_stack([np.degrees(commands[:, 1]), commands[:, 0]])
        # The car stands while the prepare step is taken, and at the last step its command no longer counts.
        wanted = np.concatenate([wanted[:1], wanted, wanted[-1:]])
        steps = []
        for action in 2.0 * (wanted - self.low) / (self.high - self.low) - 1.0:
            race.step(action[None])
            steps.append(race.trace[0, [PACKED[name] for name in _TRACED]])
            if race.terminated[0]:
                break
        status = int(race.trace[0, PACKED["episode_status"]])
        if status != STATUS_CODE["lap_complete"]:
            raise RunFailed(
                f"{track.name}: the lap that was found is not complete when the environment drives it"
            )
        driven = np.array(steps)
        yaw = COLUMNS.index("yaw_rad")
        driven[:, yaw] = np.radians(driven[:, yaw])
        return driven


def fastest_lap(question: Question, on_round: OnRound | None = None) -> FastestLap:
    """Return the fastest lap from the cache, or search for it and keep it.

    Raises:
        RunFailed: no lap is possible within the limits.
    """
    kept = kept_lap(question)
    if kept is not None:
        return kept
    lap = question.answer(on_round or (lambda share, lap_time_s: None))
    _keep(question, lap)
    return lap


def kept_lap(question: Question) -> FastestLap | None:
    """Return the fastest lap if an earlier search has stored it, in the cache or the package; else None.

    A file that holds no lap counts as none.
    """
    return _read(_file(question)) or _read(_SHIPPED / f"{question.key}.json")


def _read(file: Path | None) -> FastestLap | None:
    if file is None or not file.is_file():
        return None
    try:
        content = read_json(file, "a fastest lap")
        return FastestLap(
            lap_time_s=float(content["lap_time_s"]),
            bound_s=float(content["bound_s"]),
            steps=_table(content["steps"]),
        )
    except (BadInput, KeyError, TypeError, ValueError):
        return None


def _table(rows: Any) -> Floats:
    """Return the steps of a file."""
    steps = np.array(rows, np.float64)
    if steps.ndim != 2 or steps.shape[1] != len(COLUMNS) or not len(steps) or not np.isfinite(steps).all():
        raise ValueError("not the steps of a lap")
    return steps


def _keep(question: Question, lap: FastestLap) -> None:
    """Write a lap to the cache; on a disk that refuses it, it is searched again next time."""
    file = _file(question)
    if file is None:
        return
    content = {
        "track": question.track.name,
        "car": question.experiment.car.name,
        "lap_time_s": lap.lap_time_s,
        "bound_s": lap.bound_s,
        "columns": COLUMNS,
        "steps": lap.steps.tolist(),
    }
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(file, json.dumps(content) + "\n")
    except OSError:
        return


def _file(question: Question) -> Path | None:
    """Return the file of a lap in the cache; None where this account has no home."""
    folder = cache_home()
    return None if folder is None else folder / "fastest_laps" / f"{question.key}.json"
