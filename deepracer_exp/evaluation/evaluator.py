"""Race a policy under a protocol: all trials, tracks and conditions as one batch of cars."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.agents.compiled_policy import CompiledPolicy
from deepracer_exp.config.driving import ObservationConfig, TrackConfig
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.named import conditions_of, race_of, tracks_of
from deepracer_exp.env.others.head_to_head import HeadToHead, rival_setup
from deepracer_exp.env.race import Race
from deepracer_exp.env.real_car import as_the_car, require_car
from deepracer_exp.env.setup import Course, build_setup
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.source import NO_REWARD
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.tracks.track import directed_tracks

from .race_protocol import RaceProtocol
from .results import HELD_OUT, USUAL, Evaluation, TrialGroup
from .rival_protocol import RivalProtocol
from .zigzag import DRIVES, ZigZag, zigzag_of

OnStep = Callable[[Race, RaceProtocol, TensorDict], None]
"""Receives the cars, the protocol, and the policy's inputs and outputs in this step, [trials]."""

_DRIVEN = [PACKED[name] for name in ("X", "Y", "steer", "tstamp", "episode_status")]


@dataclass(frozen=True, kw_only=True)
class EvaluationTrial:
    """Track, conditions and start of one car."""

    course: int
    """Index of the race's course."""
    condition: str
    start_ndist: float


class Evaluator:
    """Races one policy after another with an experiment's car under a protocol.

    All policies meet the same trials: random conditions depend only on `config.seed` and the trial's index.

    Attributes:
        trials: one for each row of the batch.
        race: the cars.
        rival: drives the other car of a head-to-head race unless a call names another; None: the policy itself.
    """

    def __init__(
        self,
        experiment: Experiment,
        config: EvaluationConfig,
        threads: int = 0,
        rival_sees: ObservationConfig | None = None,
    ):
        """Build tracks and cars.

        Args:
            experiment: car, action space, observation and rules, and the tracks and conditions that the protocol does
                not set.
            config: the protocol.
            threads: physics threads; 0 means one per core.
            rival_sees: observation of the rival's policy in a head-to-head race; None: the policy's.

        Raises:
            BadInput: a track, a condition or a file is unknown or malformed, or the protocol is that of the car and
                it could not run such a policy.
        """
        self.config = config
        courses = _courses(tracks_of(experiment, config))
        conditions = {USUAL: conditions_of(experiment, config, "usual")}
        if config.held_out is not None:
            conditions[HELD_OUT] = conditions_of(experiment, config, "held_out")
        for condition, randomization in conditions.items():
            if randomization.real_car is not None:
                require_car(experiment, f"evaluation.{condition}")
        against_rival = race_of(experiment, config).rivals is not None
        self.trials = [
            EvaluationTrial(course=place, condition=condition, start_ndist=start)
            for place, course in enumerate(courses)
            for condition in conditions
            for start in _starts(config, course.tracks[0].closed, condition, pairs=against_rival)
        ]
        setup = replace(
            build_setup(experiment, courses, NO_REWARD, race=race_of(experiment, config)),
            randomization=conditions[USUAL],
            # The protocol limits the time.
            episode=replace(experiment.episode, max_steps=0),
            seed=config.seed,
        )
        rivals = rival_setup(setup, rival_sees or experiment.observation) if against_rival else None
        if config.real_car is not None:
            require_car(experiment)
            if against_rival:
                raise BadInput(
                    "evaluation.real_car",
                    "a rival is not driven as the physical car",
                    "a race without rivals",
                )
            setup = as_the_car(setup, config.real_car)
        of_trials = [conditions[trial.condition] for trial in self.trials]
        self.race = (
            Race(setup, len(self.trials), threads, randomizations=of_trials)
            if rivals is None
            else HeadToHead(
                setup, len(self.trials), rivals, threads, randomizations=of_trials, evaluated=True
            )
        )
        self._course = np.array([trial.course for trial in self.trials])
        self._start_ndist = np.array([trial.start_ndist for trial in self.trials])
        self.rival: torch.nn.Module | None = None
        self._closed = np.array([courses[trial.course].tracks[0].closed for trial in self.trials])

    def __call__(
        self, policy: torch.nn.Module, on_step: OnStep | None = None, rival: torch.nn.Module | None = None
    ) -> Evaluation:
        """Let the policy drive all trials and return the results.

        Args:
            policy: reads the experiment's observation, writes `action`.
            on_step: called after every control step.
            rival: drives the other car of a head-to-head race; None: `self.rival`.

        Raises:
            RunFailed: an action or a car's state became NaN or infinite.
        """
        race, config = self.race, self.config
        among_others = race.others is not None
        protocol = RaceProtocol(config, self._closed, race.setup.car.control_period_s, among_others)
        rivals = None
        if isinstance(race, HeadToHead):
            race.drive_with([rival or self.rival or policy])
            rivals = RivalProtocol(config, self._closed, race.setup.car.control_period_s)
        trace: list[NDArray[np.float64]] = []
        race.seed(config.seed)
        race.reset(None, self._course, self._start_ndist)
        how = ExplorationType.RANDOM if config.sample else ExplorationType.DETERMINISTIC
        compiled = None if config.sample else CompiledPolicy.of(policy)
        # The training's random numbers must not depend on whether it evaluates.
        with torch.random.fork_rng(devices=[]), torch.no_grad(), set_exploration_type(how):
            torch.manual_seed(config.seed)
            while protocol.running.any():
                acted = TensorDict(
                    {key: torch.from_numpy(values) for key, values in race.seen.items()}, [race.n_cars]
                )
                if compiled is None or on_step is not None:
                    acted = policy(acted)
                if compiled is not None:
                    # So that the laps do not depend on whether `on_step` is given.
                    acted["action"] = torch.from_numpy(compiled.likeliest(race.observation))
                race.step(acted["action"].numpy())
                row = race.trace
                trace.append(np.column_stack([row[:, _DRIVEN], protocol.running]))
                if rivals is not None:
                    assert isinstance(race, HeadToHead)
                    rivals.step(race, protocol.running)
                back = protocol.step(
                    row[:, PACKED["episode_status"]].astype(np.int64), row[:, PACKED["progress"]]
                )
                if on_step is not None:
                    on_step(race, protocol, acted)
                if len(back.cars):
                    race.put_back(*back)
        won = () if rivals is None else rivals.results(protocol)
        return Evaluation(tuple(self._groups(protocol, np.stack(trace, axis=1), won)), among_others)

    @property
    def groups(self) -> dict[tuple[str, str], list[int]]:
        """Numbers of the trials by the name of their track and their condition."""
        rows: dict[tuple[str, str], list[int]] = {}
        for row, trial in enumerate(self.trials):
            rows.setdefault((self.race.setup.courses[trial.course].name, trial.condition), []).append(row)
        return rows

    def _groups(
        self, protocol: RaceProtocol, trace: NDArray[np.float64], won: Sequence[float]
    ) -> list[TrialGroup]:
        zigzags = [self._zigzag(trial.course, rows) for trial, rows in zip(self.trials, trace, strict=True)]
        return [
            TrialGroup(
                track,
                condition,
                tuple(trials),
                tuple(a for a in protocol.attempts if a.trial in set(trials)),
                tuple(zigzags[trial] for trial in trials),
                tuple(won[trial] for trial in trials) if won else (),
            )
            for (track, condition), trials in self.groups.items()
        ]

    def _zigzag(self, course: int, rows: NDArray[np.float64]) -> ZigZag:
        """Measure the zig-zag of a trial: rows [T] with the columns `_DRIVEN` and whether the trial was running."""
        x_m, y_m, steering_deg, time_s, status, running = rows.T
        drives = np.isin(status, [STATUS_CODE[word] for word in DRIVES if word]) & (running > 0)
        track = self.race.setup.courses[course].tracks[0]
        return zigzag_of(track, x_m, y_m, steering_deg, time_s, np.zeros(len(rows), np.intp), drives)


def evaluator_against(rival: StoredRun | None, experiment: Experiment, config: EvaluationConfig) -> Evaluator:
    """Build an evaluator whose policies race against a stored one where the race is head to head.

    `rival` is the run with its checkpoint; None: each policy races against itself. The rest is as for `Evaluator`.

    Raises:
        BadInput: as for `Evaluator`, or the checkpoint cannot be used.
    """
    if rival is None:
        return Evaluator(experiment, config)
    evaluator = Evaluator(experiment, config, rival_sees=rival.experiment.observation)
    evaluator.rival = rival.read_policy().networks.policy
    return evaluator


def _courses(tracks: dict[str, TrackConfig]) -> tuple[Course, ...]:
    """Build the tracks; one driven in both directions counts as two."""
    courses = []
    for name, config in tracks.items():
        for track in directed_tracks(config):
            label = name + " reversed" * (track.reversed and config.direction == "alternate")
            courses.append(Course(name=label, weight=1.0, tracks=(track,)))
    return tuple(courses)


def _starts(config: EvaluationConfig, closed: bool, condition: str, pairs: bool) -> NDArray[np.float64]:
    """Return the start of each trial as a share of the lap, (trials,); of `pairs`, each has one start for both."""
    if not closed:
        return np.zeros(config.trials)
    size = 2 if pairs else 1
    place, places = np.arange(config.trials) // size, -(-config.trials // size)
    if config.starts is not None:
        return np.array(config.starts)[place % len(config.starts)]
    return (place + (0.5 if condition == HELD_OUT else 0.0)) / places
