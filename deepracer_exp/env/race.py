"""N cars on their tracks under the service's rules; NumPy only, so that any learning library can drive them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from deepracer_exp.config.randomization import RandomizationConfig
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.formats.trace import PACKED, RANDOMIZED
from deepracer_exp.sim.batch import CarBatch, CarState

from .measures import Measures
from .observation import Features
from .prints import RewardPrints
from .randomization import Randomization
from .referee import Referee, Verdict
from .reward import RewardFunction
from .setup import RaceSetup
from .state import fitting

_RANDOMIZED = slice(PACKED[next(iter(RANDOMIZED))], PACKED[next(iter(RANDOMIZED))] + len(RANDOMIZED))
"""Their columns lie side by side in packed rows."""


_KEPT = (
    *("_return", "_steering_deg", "_commanded_mps"),
    *("observation", "reward", "terminated", "truncated", "trace"),
)
"""A race's own arrays that belong into a checkpoint."""


class NonFinite(RunFailed):
    """A value became NaN or infinite; `arrays` holds what is needed to look at it."""

    def __init__(self, message: str, arrays: dict[str, np.ndarray]):
        super().__init__(message)
        self.arrays = arrays


class Race:
    """The race of N cars, stepped together.

    A step follows the service's order: the pose is read, params are filled and the rules judge it; the action is
    sent and the car moves on for 1/15 s; the reward is that of the pose read at the start. So reward and end of
    an episode belong to the pose the action was chosen at, and the observation returned is the new one. An
    episode's first step is the prepare step: the car stands, the reward is 0 and no rule holds.

    Attributes:
        observation: features of the poses now, (N, size), float32.
        reward: of the last step, (N,), float64.
        terminated: the last step ended the episode, (N,), bool.
        truncated: the last step reached `episode.max_steps`, (N,), bool.
        trace: one row per car for the last step, columns `formats.trace.PACKED_COLUMNS`, (N, C), float64.
    """

    def __init__(
        self,
        setup: RaceSetup,
        n_cars: int,
        threads: int = 1,
        first_car: int = 0,
        prints: RewardPrints | None = None,
        randomizations: Sequence[RandomizationConfig] | None = None,
    ):
        """Build the cars; `reset` puts them on the track.

        Args:
            setup: what the experiment chose.
            n_cars: cars in this batch.
            threads: physics threads; 0 means one per core.
            first_car: number of the first car over all processes, which its random stream and starts depend on.
            prints: where `print` of a reward function goes; None: nowhere.
            randomizations: what each car suffers, (N,); None: all what the setup says.
        """
        self.setup = setup
        self.n_cars = n_cars
        self.referee = Referee(setup, n_cars, first_car)
        self.cars = self.referee.cars
        self._period_s = setup.car.control_period_s
        self._floors = np.array([course.tracks[0].floor.friction for course in setup.courses])
        self._batch = CarBatch(setup.car, n_cars, threads, self._floors[self.referee.course])
        self._reward_function = RewardFunction(setup.reward, n_cars, setup.reward_time_limit_s, prints)
        low, high = setup.actions.low, setup.actions.high
        # A space that only drives straight ahead has no largest angle to divide by.
        steering_max_deg = max(abs(low[0]), abs(high[0])) or 1.0
        self._features = Features(setup.observation, self.referee.tracks.length_m, steering_max_deg, high[1])
        self.randomization = Randomization(
            randomizations or [setup.randomization] * n_cars,
            self.cars.tolist(),
            self._batch,
            self._features.names,
        )
        self._everyone = np.arange(n_cars)
        self._return = np.zeros(n_cars)
        self._steering_deg = np.zeros(n_cars)
        self._commanded_mps = np.zeros(n_cars)
        self.observation = np.zeros((n_cars, self._features.size), np.float32)
        self.reward = np.zeros(n_cars)
        self.terminated = np.zeros(n_cars, bool)
        self.truncated = np.zeros(n_cars, bool)
        self.trace = np.zeros((n_cars, len(PACKED)))
        self.trace[:, PACKED["car"]] = self.cars
        self.seed(setup.seed)

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Return the names of the observation's entries."""
        return self._features.names

    def seed(self, seed: int) -> None:
        """Begin anew: random streams from `seed`, start positions and clocks from the first episode."""
        self.randomization.seed(seed)
        self.referee.restart()

    def reset(
        self,
        ids: np.ndarray | None = None,
        course: np.ndarray | None = None,
        start_ndist: np.ndarray | None = None,
    ) -> None:
        """Put cars at the start of a new episode: on the centre line, standing, each start further along.

        Args:
            ids: indices of the cars, None: all of them.
            course: places in `setup.courses` of other courses to go to, (n,); None: each stays on its own.
            start_ndist: where they start as shares of the lap, (n,); None: as `episode` says.
        """
        ids = self._everyone if ids is None else ids
        pose = self.referee.reset(ids, start_ndist, course)
        if course is not None:
            self._batch.set_floor_friction(ids, self._floors[course])
        for kept in (self._return, self._steering_deg, self._commanded_mps):
            kept[ids] = 0
        self.randomization.begin(ids, self.referee.episode[ids])
        self._batch.place(ids, pose.x, pose.y, pose.yaw_rad)
        self._observe_started(ids)

    def put_back(self, ids: np.ndarray, percent: np.ndarray) -> None:
        """Put cars on the centre line in the middle of their episodes, standing; nothing is drawn anew.

        Args:
            ids: indices of the cars.
            percent: progress at which they go on, (n,); as `Referee.put_back`.
        """
        pose = self.referee.put_back(ids, percent)
        for commanded in (self._steering_deg, self._commanded_mps):
            commanded[ids] = 0
        self.randomization.forget_commands(ids, self.referee.steps[ids])
        self._batch.place(ids, pose.x, pose.y, pose.yaw_rad)
        self._observe_started(ids)

    def step(self, action: np.ndarray) -> None:
        """Judge the poses, pay the rewards and move the cars on by one control period.

        Cars whose episode ended keep driving until `reset`; their observation is the terminal one.

        Args:
            action: int64 (N,) for a discrete space; float (N, 2) in -1..1, steering and speed, for a continuous.

        Raises:
            RewardFailed: the reward function raised, hung or returned no usable number.
            NonFinite: an action, a car's state or an observation is NaN or infinite.
        """
        steering_deg, speed_mps = self.setup.actions.commands(action)
        verdict = self.referee.judge()
        self._require_finite(
            "action", np.stack([steering_deg, speed_mps], axis=1), ("steering", "speed"), action
        )
        self.terminated, self.truncated = verdict.terminated, verdict.truncated
        params = self.referee.params(verdict, steering_deg, speed_mps)
        self.reward = self._reward_function(params, self.referee.roads, verdict.running, self.referee.which)
        self._return += self.reward
        self._write_trace(verdict, action, steering_deg, speed_mps)
        try:
            self._drive(steering_deg, speed_mps, verdict.running)
        except RunFailed as error:
            raise self._lost_car(error, action) from error
        self._observe()
        self._require_finite("observation", self.observation, self.feature_names, action)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all that the cars' future depends on, once they were reset: arrays and plain values.

        What a reward function's module remembers is no part of it.
        """
        return {
            "physics": self._batch.state,
            "cars": self.cars.copy(),
            "referee": self.referee.state_dict(),
            "randomization": self.randomization.state_dict(),
            **{name.lstrip("_"): getattr(self, name).copy() for name in _KEPT},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a `state_dict`: what follows is what followed there, bit for bit.

        Args:
            state: of a race with the same setup and the same cars.

        Raises:
            BadInput: it is of another number of cars, of other cars, tracks or features; these cars are lost then.
        """
        physics = fitting(state, "physics", self._batch.state.shape)
        if not np.array_equal(fitting(state, "cars", self.cars.shape), self.cars):
            raise BadInput(
                f"the checkpoint does not fit: its cars begin with number {state['cars'][0]}; accepted here: "
                f"{self.cars[0]}"
            )
        for name in _KEPT:
            setattr(self, name, fitting(state, name.lstrip("_"), getattr(self, name).shape))
        self.referee.load_state_dict(state["referee"])
        self.randomization.load_state_dict(state["randomization"])
        self._batch.set_floor_friction(self._everyone, self._floors[self.referee.course])
        # Last: giving a car its mass computes with the physics.
        self._batch.state = physics

    def state_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the cars' full physics state and counters, for looking into a fault."""
        return {
            "physics_state": self._batch.state.copy(),
            "observation": self.observation.copy(),
            "steps": self.referee.steps.copy(),
            "episode": self.referee.episode.copy(),
            "trace": self.trace.copy(),
        }

    def _write_trace(
        self, verdict: Verdict, action: np.ndarray, steering_deg: np.ndarray, speed_mps: np.ndarray
    ) -> None:
        referee, now, row = self.referee, verdict.now, self.trace
        for name, values in (
            ("episode", referee.episode),
            ("steps", referee.steps),
            ("X", now.front[:, 0]),
            ("Y", now.front[:, 1]),
            ("yaw", np.degrees(now.yaw_rad)),
            ("steer", steering_deg),
            ("throttle", speed_mps),
            ("action", action if action.ndim == 1 else np.nan),
            ("reward", self.reward),
            ("done", self.terminated | self.truncated),
            ("all_wheels_on_track", verdict.all_wheels_on_track),
            ("progress", verdict.progress),
            ("closest_waypoint", referee.nearer_waypoint()),
            ("track_len", referee.length_m),
            ("track", referee.course),
            ("tstamp", referee.clock_steps * self._period_s),
            ("episode_status", verdict.status),
            ("speed_mps", now.speed_mps),
            ("yaw_rate_radps", now.yaw_rate_radps),
            ("offset_m", now.offset_m),
            ("heading_error_rad", now.heading_error_rad),
            ("episode_return", self._return),
        ):
            row[:, PACKED[name]] = values
        row[:, _RANDOMIZED] = self.randomization.values

    def _drive(self, steering_deg: np.ndarray, speed_mps: np.ndarray, running: np.ndarray) -> None:
        self._steering_deg = np.where(running, steering_deg, 0.0)
        self._commanded_mps = np.where(running, speed_mps, 0.0)
        sent_deg, sent_mps, moving = self.randomization.sent(steering_deg, speed_mps, self.referee.steps)
        self._batch.drive(sent_mps, np.radians(sent_deg), moving=moving)

    def _observe(self) -> None:
        """Measure all cars, and compute what the policy sees of them."""
        features = self._features_of(self.referee.see(self._batch.read()), self._everyone)
        self.observation = self.randomization.seen(features, self.observation)

    def _observe_started(self, ids: np.ndarray) -> None:
        """The same for the cars `ids` alone: at nearly every step some car of many starts an episode."""
        if len(ids) == self.n_cars:
            started = self.referee.see(self._batch.read())
        else:
            started = self.referee.see_some(ids, CarState(*(values[ids] for values in self._batch.read())))
        # The terminal observation has been handed out; it must stay as it was.
        self.observation = self.observation.copy()
        self.observation[ids] = self.randomization.first_seen(ids, self._features_of(started, ids))

    def _features_of(self, measures: Measures, ids: np.ndarray) -> np.ndarray:
        which = self.referee.which[ids]
        return self._features.compute(
            measures,
            self._steering_deg[ids],
            self._commanded_mps[ids],
            self.referee.tracks.points_at(self._features.ahead(measures.ndist, which), which),
        )

    def _lost_car(self, error: RunFailed, action: np.ndarray) -> RunFailed:
        """Say which car and step the physics complains of; it knows only the car's place in this batch."""
        rows = np.flatnonzero(~np.isfinite(self._batch.state).all(axis=1))
        if not len(rows):
            return error
        return self._non_finite(f"physics state of {self._place(rows[0])} is not finite", action)

    def _require_finite(
        self, what: str, values: np.ndarray, names: tuple[str, ...], action: np.ndarray
    ) -> None:
        finite = np.isfinite(values)
        if not finite.all():
            row, column = np.argwhere(~finite)[0]
            value = f"became {values[row, column]}"
            raise self._non_finite(f"{what} '{names[column]}' of {self._place(row)} {value}", action)

    def _place(self, row: int) -> str:
        step, episode = self.referee.steps[row], self.referee.episode[row]
        return f"car {self.cars[row]} at step {step} of its episode {episode}"

    def _non_finite(self, message: str, action: np.ndarray) -> NonFinite:
        return NonFinite(message, {**self.state_arrays(), "action": np.asarray(action)})
