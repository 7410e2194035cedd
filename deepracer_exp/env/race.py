"""N cars on their tracks under the service's rules, as NumPy arrays, so that any learning library can drive them."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from deepracer_exp.config.driving import RandomizationConfig
from deepracer_exp.env.others.race_others import RaceOthers
from deepracer_exp.env.others.rival import RaceRival
from deepracer_exp.env.randomization.car_randomization import Randomization, of_each_car
from deepracer_exp.env.randomization.picture_randomization import PictureRandomization
from deepracer_exp.env.randomization.real_car_randomization import RealCarRandomization
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.rewards.prints import RewardPrints
from deepracer_exp.rewards.reward import RewardFunction
from deepracer_exp.sim.batch import CarBatch, CarState
from deepracer_exp.tracks.lanes import INNER, OUTER, Lanes
from deepracer_exp.tracks.track import Pose

from .lidar_view import Lidar
from .observation import Features
from .pictures import Pictures
from .real_car import Servos
from .rules import RaceRules, StepResult
from .setup import RaceSetup, places_of_cars
from .state import Measures, checked_array
from .trace_columns import OTHERS_PACKED, PACKED, RIVAL_PACKED
from .trace_rows import Driven, Lengths, row_dtype, write_rows

_KEPT = (
    *("_return", "_steering_deg", "_commanded_mps"),
    *("observation", "pixels", "reward", "terminated", "truncated", "trace"),
)
"""The race's arrays that a checkpoint holds."""


class NonFinite(RunFailed):
    """A value became NaN or infinite; `arrays` holds the cars' state for a crash dump."""

    def __init__(self, message: str, arrays: dict[str, np.ndarray]):
        super().__init__(message)
        self.arrays = arrays


class Race:
    """The race of N cars, stepped together.

    A step follows the service's order: the rules and the reward function see the pose at which the action was chosen,
    then the car moves for 1/15 s. So reward and end of an episode belong to the pose before the step, and the
    observation returned is the new one. An episode's first step is the prepare step: the car stands, the reward is 0
    and no rule is applied.

    Attributes:
        observation: features of the poses now, (N, size), float32.
        pixels: what the cameras see now, (N, channels, height, width), uint8; (N, 0) where there is no camera.
        lidar: what the LIDARs last read, (N, size), float32; (N, 0) where there is none.
        reward: of the last step, (N,), float64.
        terminated: the last step ended the episode, (N,), bool.
        truncated: the last step cut the episode off, see `StepResult`, (N,), bool.
        trace: one row per car for the last step, columns `env.trace_columns.PACKED_COLUMNS`, among others
            `OTHERS_PACKED`, and against a rival `RIVAL_PACKED`, (N, C), float64.
        others: the boxes and bots on the road; None: the cars are alone.
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
            setup: of the experiment.
            n_cars: cars in this batch.
            threads: of physics and cameras; 0 means one per core.
            first_car: number of the first car over all processes; it decides random streams and starts.
            prints: where `print` of a reward function goes; None: nowhere.
            randomizations: of each car, (N,); None: the setup's for all.
        """
        self.setup = setup
        self.n_cars = n_cars
        self.rules = RaceRules(setup, n_cars, first_car)
        self.cars = self.rules.cars
        self._period_s = setup.car.control_period_s
        self._floors = np.array([course.tracks[0].floor.friction for course in setup.courses])
        self._batch = CarBatch(setup.car, n_cars, threads, self._floors[self.rules.course])
        self._reward_function = RewardFunction(
            setup.reward, n_cars, setup.reward_time_limit_s, prints, first_car=first_car
        )
        self.others: RaceOthers | None = None
        if setup.others is not None:
            kind = RaceOthers if setup.others.rivals is None else RaceRival
            self.others = kind(setup.others, setup, self.rules)
        low, high = setup.actions.low, setup.actions.high
        # A space that only drives straight ahead has no largest angle to divide by.
        steering_max_deg = max(abs(low[0]), abs(high[0])) or 1.0
        self._features = Features(
            setup.observation, self.rules.tracks, steering_max_deg, high[1], setup.observation_parts
        )
        numbers = self.cars.tolist()
        places = places_of_cars(setup.weights, first_car + n_cars)[first_car:].tolist()
        randomizations = of_each_car(randomizations or [setup.randomization] * n_cars, places)
        of_car = [randomization.real_car for randomization in randomizations]
        fixed = setup.real_car
        real_car = RealCarRandomization(of_car, numbers, self._batch, fixed, setup.late_steps)
        self._real_car = real_car
        self.randomization = Randomization(
            randomizations,
            numbers,
            self._batch,
            self._features.names,
            real_car.late_steps,
            real_car.most_late_steps,
        )
        self._sees_others = setup.observation.next_objects > 0
        self._everyone = np.arange(n_cars)
        self._return = np.zeros(n_cars)
        self._steering_deg = np.zeros(n_cars)
        self._commanded_mps = np.zeros(n_cars)
        self.observation = np.zeros((n_cars, len(self._features.names)), np.float32)
        camera, tracks = setup.observation.camera, [course.tracks[0] for course in setup.courses]
        pictures = [randomization.pictures for randomization in randomizations]
        lidar = setup.observation.lidar
        others = 0 if setup.others is None else setup.others.others
        seen = camera is not None or lidar is not None
        self._varied = (
            PictureRandomization(pictures, numbers, tracks, others)
            if seen and any(config is not None for config in pictures)
            else None
        )
        self._pictures = (
            None
            if camera is None
            else Pictures(camera, setup.car, tracks, self._varied, real_car.jpeg_quality, threads)
        )
        top_mps = None if fixed is None or fixed.controls is None else fixed.controls.full_throttle_mps
        self._servos = (
            Servos(setup.actions, real_car.full_lock_deg, real_car.throttle_curve, top_mps)
            if real_car.full_lock_deg.any()
            else None
        )
        self.pixels = np.zeros((n_cars, *(camera.shape if camera is not None else (0,))), np.uint8)
        boxes = 0 if self._varied is None else self._varied.most_boxes
        self._lidar = None if lidar is None else Lidar(lidar, tracks, numbers, self._period_s, boxes, others)
        self.lidar = np.zeros((n_cars, lidar.size if lidar is not None else 0), np.float32)
        self._kept = _KEPT if lidar is None else (*_KEPT, "lidar")
        self.reward = np.zeros(n_cars)
        self.terminated = np.zeros(n_cars, bool)
        self.truncated = np.zeros(n_cars, bool)
        extra: tuple[str, ...] = () if setup.others is None else OTHERS_PACKED
        if setup.others is not None and setup.others.rivals is not None:
            extra += RIVAL_PACKED
        self.trace = np.zeros((n_cars, len(PACKED) + len(extra)))
        self.trace[:, PACKED["car"]] = self.cars
        self._row = row_dtype(extra)
        self._lengths = Lengths(*self.rules.tracks.waypoints, self.rules.tracks.length_m, self._period_s)
        self._no_action = np.full(n_cars, np.nan)
        self.seed(setup.seed)

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Return the names of the observation's entries."""
        return self._features.names

    @property
    def seen(self) -> dict[str, np.ndarray]:
        """The entries that networks may read: `observation`, with a camera `pixels`, and with a LIDAR `lidar`."""
        seen = {"observation": self.observation}
        if self._pictures is not None:
            seen["pixels"] = self.pixels
        if self._lidar is not None:
            seen["lidar"] = self.lidar
        return seen

    def seed(self, seed: int) -> None:
        """Start over: random streams from `seed`, start positions and clocks from the first episode."""
        self.randomization.seed(seed)
        self._real_car.seed(seed)
        if self._varied is not None:
            self._varied.seed(seed)
        if self._lidar is not None:
            self._lidar.seed(seed)
        if self.others is not None:
            self.others.seed(seed)
        self.rules.restart()

    def reset(
        self,
        ids: np.ndarray | None = None,
        course: np.ndarray | None = None,
        start_ndist: np.ndarray | None = None,
    ) -> None:
        """Start a new episode: cars stand on the centre line, each start further along than the last.

        Args:
            ids: indices of the cars, None: all of them.
            course: indices in `setup.courses` of the courses to move to, (n,); None: each car stays on its own.
            start_ndist: where they start, as shares of the lap, (n,); None: as `episode` configures.
        """
        ids = self._everyone if ids is None else ids
        self._start(ids, course, start_ndist)
        self._observe_started(ids)

    def _start(self, ids: np.ndarray, course: np.ndarray | None, start_ndist: np.ndarray | None) -> None:
        """Put the cars `ids` where their new episodes begin; arguments as for `reset`."""
        pose = self.rules.reset(ids, start_ndist, course)
        if course is not None:
            self._batch.set_floor_friction(ids, self._floors[course])
        if self.others is not None:
            pose = self.others.begin(ids, pose, evaluated=start_ndist is not None)
        for kept in (self._return, self._steering_deg, self._commanded_mps):
            kept[ids] = 0
        if self._servos is not None:
            self._servos.center(ids)
        self._begin(ids)
        self._batch.place(ids, pose.x, pose.y, pose.yaw_rad)

    def _begin(self, ids: np.ndarray) -> None:
        """Draw the randomization of new episodes."""
        self.randomization.begin(ids, self.rules.episode[ids])
        self._draw_again(ids)

    def _draw_again(self, ids: np.ndarray) -> None:
        """Draw everything that the episode's number decides: physical car, cameras, LIDARs."""
        episode = self.rules.episode[ids]
        self._real_car.begin(ids, episode)
        if self._varied is not None:
            self._varied.begin(ids, episode, self.rules.course[ids])
        if self._lidar is not None:
            boxes = None if self._varied is None else self._varied.boxes(ids)
            self._lidar.begin(ids, episode, self.rules.course[ids], boxes)

    def put_back(
        self,
        ids: np.ndarray,
        percent: np.ndarray,
        crashed: np.ndarray | None = None,
        restarts: np.ndarray | None = None,
        hold_s: np.ndarray | None = None,
    ) -> None:
        """Put cars at rest on the track in the middle of their episodes; nothing is drawn again.

        As on the service they continue in the lane that is nearer to where they left (deepracer-simapp,
        agent_ctrl/rollout_agent_ctrl.py), and among others as `RaceOthers.put_back` says.

        Args:
            ids: indices of the cars.
            percent: progress at which they continue, (n,); see `RaceRules.put_back`.
            crashed: whether they ran into a box or bot, (n,); None: none did.
            restarts: whether they begin a lap at the start, on the centre line, (n,); None: none does.
            hold_s: seconds for which each is held there, among others, (n,); None: not at all.
        """
        centre = self.rules.put_back(ids, percent)
        pose = self._on_lanes(ids, centre, np.zeros(len(ids), bool) if restarts is None else restarts)
        if self.others is not None:
            crashed = np.zeros(len(ids), bool) if crashed is None else crashed
            hold_s = np.zeros(len(ids)) if hold_s is None else hold_s
            pose = self.others.put_back(ids, pose, percent, crashed, hold_s)
        for commanded in (self._steering_deg, self._commanded_mps):
            commanded[ids] = 0
        if self._servos is not None:
            self._servos.center(ids)
        self.randomization.forget_commands(ids, self.rules.steps[ids])
        self._batch.place(ids, pose.x, pose.y, pose.yaw_rad)
        self._observe_started(ids)

    def _on_lanes(self, ids: np.ndarray, centre: Pose, restarts: np.ndarray) -> Pose:
        """Return poses on the lanes nearer to the cars, (n,) each, or on the centre line where a lap begins."""
        points, track_index = np.stack([centre.x, centre.y], axis=-1), self.rules.track_index[ids]
        x, y = self.trace[ids, PACKED["X"]], self.trace[ids, PACKED["Y"]]
        sides = [self._lanes.poses(points, np.full(len(ids), lane), track_index) for lane in (INNER, OUTER)]
        away_m = [np.hypot(side.x - x, side.y - y) for side in sides]
        lane = np.where(restarts, 2, np.where(away_m[INNER] < away_m[OUTER], INNER, OUTER))
        return Pose(*(np.choose(lane, parts) for parts in zip(*sides, centre, strict=True)))

    @cached_property
    def _lanes(self) -> Lanes:
        return Lanes([track for course in self.setup.courses for track in course.tracks])

    def step(self, action: np.ndarray) -> None:
        """Apply the rules, compute the rewards and move the cars by one control period.

        Cars whose episode ended keep driving until `reset`; their observation is the terminal one.

        Args:
            action: int64 (N,) for a discrete space; float (N, 2) in -1..1, steering and speed, for a continuous one.

        Raises:
            RewardFailed: the reward function raised, timed out or returned no usable number.
            NonFinite: an action, a car's state or an observation is NaN or infinite.
        """
        self._act(action)
        self._update_observation(action)

    def _act(self, action: np.ndarray) -> None:
        """Apply the rules, compute the rewards and move the cars; arguments and errors as for `step`."""
        steering_deg, speed_mps = self._commands(action)
        result = self.rules.apply()
        objects: dict[str, np.ndarray] = {}
        if self.others is not None:
            result, objects = self.others.judge(result)
        self._require_finite(
            "action", np.stack([steering_deg, speed_mps], axis=1), ("steering", "speed"), action
        )
        self.terminated, self.truncated = result.terminated, result.truncated
        params = {**self.rules.params(result, steering_deg, speed_mps), **objects}
        self.reward = self._reward_function(
            params, self.rules.track_params, result.running, self.rules.track_index
        )
        self._return += self.reward
        self._write_trace(result, action, steering_deg, speed_mps)
        try:
            self._drive(steering_deg, speed_mps, result.running)
        except RunFailed as error:
            raise self._lost_car(error, action) from error

    def _commands(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Convert actions to steering in degrees and speed in m/s, (N,) each."""
        return self.setup.actions.commands(action)

    def _update_observation(self, action: np.ndarray) -> None:
        """Compute the observation after the action; errors as for `step`."""
        self._observe()
        self._require_finite("observation", self.observation, self.feature_names, action)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything the next steps depend on, arrays and plain values; `reset` must have been called.

        Global variables of a reward function's module are not part of it.
        """
        return {
            "physics": self._batch.state,
            "cars": self.cars.copy(),
            "referee": self.rules.state_dict(),
            "randomization": self.randomization.state_dict(),
            **({} if self.others is None else {"others": self.others.state_dict()}),
            **({} if self._servos is None else {"servos": self._servos.steering.copy()}),
            **{name.lstrip("_"): getattr(self, name).copy() for name in self._kept},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`: the cars continue as those it was taken from, bit for bit.

        Args:
            state: of a race with the same setup and the same cars.

        Raises:
            BadInput: it has another number of cars, or other cars, tracks or features; the race is then unusable.
        """
        physics = checked_array(state, "physics", self._batch.state.shape)
        if not np.array_equal(checked_array(state, "cars", self.cars.shape), self.cars):
            raise BadInput(
                "the checkpoint does not fit",
                f"its first car has number {state['cars'][0]}; accepted here: {self.cars[0]}",
            )
        for name in self._kept:
            setattr(self, name, checked_array(state, name.lstrip("_"), getattr(self, name).shape))
        self.rules.load_state_dict(state["referee"])
        self.randomization.load_state_dict(state["randomization"])
        for draws in (self._real_car, self._varied, self._lidar):
            if draws is not None:
                draws.seed(state["randomization"]["seed"])
        if self.others is not None:
            self.others.seed(state["randomization"]["seed"])
            self.others.load_state_dict(state["others"])
        if self._servos is not None:
            self._servos.steering = checked_array(state, "servos", self._servos.steering.shape)
        self._draw_again(self._everyone)
        self._batch.set_floor_friction(self._everyone, self._floors[self.rules.course])
        self._batch.state = physics

    def state_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the cars' full physics state and counters, for a crash dump."""
        return {
            "physics_state": self._batch.state.copy(),
            "observation": self.observation.copy(),
            "steps": self.rules.steps.copy(),
            "episode": self.rules.episode.copy(),
            "trace": self.trace.copy(),
        }

    def _write_trace(
        self, result: StepResult, action: np.ndarray, steering_deg: np.ndarray, speed_mps: np.ndarray
    ) -> None:
        rules, now = self.rules, result.now
        driven = Driven(
            now.front,
            now.yaw_rad,
            now.speed_mps,
            now.closest_waypoints,
            steering_deg,
            speed_mps,
            action.astype(np.float64) if action.ndim == 1 else self._no_action,
            self.reward,
            self._return,
            result.all_wheels_on_track,
            result.progress,
            result.status,
            self.terminated,
            self.truncated,
            self.randomization.values,
        )
        write_rows(self.trace.view(self._row)[:, 0], rules.episodes, driven, self._lengths)
        if self.others is not None:
            row, first = self.trace, len(PACKED)
            row[:, first], row[:, first + 1] = rules.episode, self.others.bots_stopped
            if row.shape[1] > first + len(OTHERS_PACKED):
                row[:, first + len(OTHERS_PACKED) :] = self.others.others.poses[:, -1]

    def _drive(self, steering_deg: np.ndarray, speed_mps: np.ndarray, running: np.ndarray) -> None:
        self._steering_deg = np.where(running, steering_deg, 0.0)
        self._commanded_mps = np.where(running, speed_mps, 0.0)
        if self._servos is not None:
            steering_deg, speed_mps = self._servos.follow(steering_deg, speed_mps)
        sent_deg, sent_mps, moving = self.randomization.disturb_commands(
            steering_deg, speed_mps, self.rules.steps
        )
        if self.others is not None:
            moving = moving & ~self.others.held
        self._batch.drive(sent_mps, np.radians(sent_deg), moving=moving)

    def _observe(self) -> None:
        """Measure all cars and compute the policy's observations."""
        state = self._batch.read()
        features = self._features_of(self.rules.measure(state), state, self._everyone)
        self.observation = self.randomization.disturb_observation(features, self.observation)
        if self._pictures is not None:
            self.pixels = self._pictures.next(
                self.pixels,
                state,
                self._batch.acceleration_mps2,
                self.rules.course,
                self.rules.steps,
                self.randomization.dropped,
                self._boxes(self._everyone),
            )
        if self._lidar is not None:
            self._show_lidar(self._everyone)
            self.lidar = self._lidar.next(self.lidar, state, self.rules.steps, self.randomization.dropped)

    def _observe_started(self, ids: np.ndarray) -> None:
        """Observe only the cars `ids`, just put on the track: with many cars, some start at nearly every step."""
        state = self._batch.read(ids)
        everyone = len(ids) == self.n_cars
        started = self.rules.measure(state) if everyone else self.rules.measure_some(ids, state)
        # The caller holds the terminal observation: it must not change.
        self.observation = self.observation.copy()
        self.observation[ids] = self.randomization.disturb_first_observation(
            ids, self._features_of(started, state, ids)
        )
        if self._pictures is not None:
            self.pixels = self.pixels.copy()
            self.pixels[ids] = self._pictures.first(ids, state, self.rules.course[ids], self._boxes(ids))
        if self._lidar is not None:
            self._show_lidar(ids)
            self.lidar = self.lidar.copy()
            self.lidar[ids] = self._lidar.read(ids, state, self.rules.steps[ids])

    def _boxes(self, ids: np.ndarray) -> np.ndarray | None:
        return None if self.others is None else self.others.boxes(ids)

    def _show_lidar(self, ids: np.ndarray) -> None:
        if self._lidar is not None and self.others is not None:
            self._lidar.show(ids, self.others.boxes(ids))

    def _features_of(self, measures: Measures, state: CarState, ids: np.ndarray) -> np.ndarray:
        others = self.others
        ahead = None if others is None or not self._sees_others else others.features(ids, measures)
        return self._features.compute(
            measures,
            self.rules.track_index[ids],
            self._steering_deg[ids],
            self._commanded_mps[ids],
            state,
            ahead,
        )

    def _lost_car(self, error: RunFailed, action: np.ndarray) -> RunFailed:
        """Name the car and step of a physics error, which knows only the car's index in this batch."""
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
        step, episode = self.rules.steps[row], self.rules.episode[row]
        return f"car {self.cars[row]} at step {step} of its episode {episode}"

    def _non_finite(self, message: str, action: np.ndarray) -> NonFinite:
        return NonFinite(message, {**self.state_arrays(), "action": np.asarray(action)})
