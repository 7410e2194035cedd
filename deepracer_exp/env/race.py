"""N cars on one track under the service's rules; NumPy only, so that any learning library can drive them."""

import numpy as np

from deepracer_exp.errors import RunFailed
from deepracer_exp.formats.trace import PACKED, STATUS_CODE
from deepracer_exp.sim.batch import CarBatch, CarState
from deepracer_exp.tracks.progress import progress

from .measures import Measures
from .observation import Features
from .prints import RewardPrints
from .reward import RewardFunction
from .rules import EpisodeRules
from .setup import RaceSetup
from .streams import CarStreams


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
    ):
        """Build the cars; `reset` puts them on the track.

        Args:
            setup: what the experiment chose.
            n_cars: cars in this batch.
            threads: physics threads; 0 means one per core.
            first_car: number of the first car over all processes, which its random stream and starts depend on.
            prints: where `print` of a reward function goes; None: nowhere.
        """
        self.setup = setup
        self.n_cars = n_cars
        self.cars = np.arange(first_car, first_car + n_cars)
        self._period_s = setup.car.control_period_s
        self._batch = CarBatch(setup.car, n_cars, threads, setup.track.floor.friction)
        self._rules = EpisodeRules(setup.episode, n_cars)
        self._reward_function = RewardFunction(setup.reward, n_cars, setup.reward_time_limit_s, prints)
        low, high = setup.actions.low, setup.actions.high
        # A space that only drives straight ahead has no largest angle to divide by.
        steering_max_deg = max(abs(low[0]), abs(high[0])) or 1.0
        self._features = Features(setup.observation, setup.track.length_m, steering_max_deg, high[1])
        self._params_of_run: dict[str, object] = {
            "track_length": setup.track.length_m,
            "waypoints": [(float(x), float(y)) for x, y in setup.track.waypoints],
            "is_reversed": setup.track.reversed,
        }
        self._everyone = np.arange(n_cars)
        self._episode = np.zeros(n_cars, np.int64)
        self._steps = np.zeros(n_cars, np.int64)
        self._clock_steps = np.zeros(n_cars, np.int64)
        self._start_ndist = np.zeros(n_cars)
        self._previous = np.zeros(n_cars)
        self._last_progress = np.zeros(n_cars)
        self._return = np.zeros(n_cars)
        self._steering_deg = np.zeros(n_cars)
        self._commanded_mps = np.zeros(n_cars)
        self._last_front = np.zeros((n_cars, 2))
        self._wheels = np.array(setup.car.wheel_points_m)
        self.observation = np.zeros((n_cars, self._features.size), np.float32)
        self.reward = np.zeros(n_cars)
        self.terminated = np.zeros(n_cars, bool)
        self.truncated = np.zeros(n_cars, bool)
        self.trace = np.zeros((n_cars, len(PACKED)))
        self.trace[:, PACKED["car"]] = self.cars
        self.trace[:, PACKED["track_len"]] = setup.track.length_m
        self.seed(setup.seed)

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Return the names of the observation's entries."""
        return self._features.names

    def seed(self, seed: int) -> None:
        """Begin anew: random streams from `seed`, start positions and clocks from the first episode."""
        noise = self.setup.randomization
        wanted = noise.steering_noise_deg > 0 or noise.speed_noise > 0
        self._noise = CarStreams(seed, self.cars.tolist(), 2) if wanted else None
        self._episode[:] = -1
        self._clock_steps[:] = 0

    def reset(self, ids: np.ndarray | None = None) -> None:
        """Put cars at the start of a new episode: on the centre line, standing, each start further along.

        Args:
            ids: indices of the cars, None: all of them.
        """
        ids = self._everyone if ids is None else ids
        episode = self.setup.episode
        self._episode[ids] += 1
        # An open course is driven from its start: from anywhere else it could not be completed.
        turns = self.cars[ids] + self._episode[ids] if self.setup.track.closed else np.zeros(len(ids))
        start_ndist = np.mod(episode.start_offset + episode.start_advance * turns, 1.0)
        self._start_ndist[ids] = start_ndist
        for counter in (self._steps, self._previous, self._last_progress, self._return):
            counter[ids] = 0
        self._steering_deg[ids] = 0
        self._commanded_mps[ids] = 0
        self._rules.reset(ids)
        x, y, yaw = self.setup.track.start_pose(start_ndist)
        self._batch.place(ids, x, y, yaw)
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
        self._steps += 1
        self._clock_steps += 1
        self._require_finite(
            "action", np.stack([steering_deg, speed_mps], axis=1), ("steering", "speed"), action
        )
        running = self._steps > 1
        self._judge()
        self._pay(steering_deg, speed_mps, running)
        self._write_trace(action, steering_deg, speed_mps)
        self._last_front = self._now.front
        try:
            self._drive(steering_deg, speed_mps, running)
        except RunFailed as error:
            raise self._lost_car(error, action) from error
        self._observe()
        self._require_finite("observation", self.observation, self.feature_names, action)

    def state_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the cars' full physics state and counters, for looking into a fault."""
        return {
            "physics_state": self._batch.state.copy(),
            "observation": self.observation.copy(),
            "steps": self._steps.copy(),
            "episode": self._episode.copy(),
            "trace": self.trace.copy(),
        }

    def _judge(self) -> None:
        now = self._now
        self._progress, self._previous = progress(now.ndist, self._start_ndist, self._previous)
        wheels_on = self._wheels_on_road()
        self._all_wheels_on: np.ndarray = np.asarray(wheels_on.all(axis=1))
        self._off_track: np.ndarray = np.asarray(~wheels_on.any(axis=1))
        moved_m = np.hypot(*(now.front - self._last_front).T)
        status = self._rules.judge(self._steps, self._progress, self._last_progress, moved_m, self._off_track)
        self._last_progress = self._progress
        self.truncated = status == STATUS_CODE["time_up"]
        self.terminated = (status > STATUS_CODE["in_progress"]) & ~self.truncated
        self._status = status

    def _wheels_on_road(self) -> np.ndarray:
        """Return which wheel centres are on the road, (N, 4); flat, from x, y and yaw, as the service's log has."""
        now = self._now
        cos, sin = np.cos(now.yaw_rad)[:, None], np.sin(now.yaw_rad)[:, None]
        wheel_x, wheel_y = self._wheels.T
        points = np.empty((self.n_cars, len(self._wheels), 2))
        points[:, :, 0] = now.x_m[:, None] + cos * wheel_x - sin * wheel_y
        points[:, :, 1] = now.y_m[:, None] + sin * wheel_x + cos * wheel_y
        return self.setup.track.on_road(points.reshape(-1, 2)).reshape(self.n_cars, -1)

    def _pay(self, steering_deg: np.ndarray, speed_mps: np.ndarray, running: np.ndarray) -> None:
        now = self._now
        params: dict[str, np.ndarray] = {
            "all_wheels_on_track": self._all_wheels_on,
            "x": now.front[:, 0],
            "y": now.front[:, 1],
            "heading": np.degrees(now.yaw_rad),
            "distance_from_center": now.distance_m,
            "projection_distance": now.ndist * self.setup.track.length_m,
            "progress": self._progress,
            "steps": self._steps.astype(np.float64),
            "speed": speed_mps,
            "steering_angle": steering_deg,
            "track_width": now.track_width_m,
            "closest_waypoints": now.closest_waypoints,
            "is_left_of_center": now.is_left,
            "is_offtrack": self._off_track,
            "sim_time": self._clock_steps * self._period_s,
        }
        self.reward = self._reward_function(params, self._params_of_run, running)
        self._return += self.reward

    def _write_trace(self, action: np.ndarray, steering_deg: np.ndarray, speed_mps: np.ndarray) -> None:
        now, row = self._now, self.trace
        for name, values in (
            ("episode", self._episode),
            ("steps", self._steps),
            ("X", now.front[:, 0]),
            ("Y", now.front[:, 1]),
            ("yaw", np.degrees(now.yaw_rad)),
            ("steer", steering_deg),
            ("throttle", speed_mps),
            ("action", action if action.ndim == 1 else np.nan),
            ("reward", self.reward),
            ("done", self.terminated | self.truncated),
            ("all_wheels_on_track", self._all_wheels_on),
            ("progress", self._progress),
            ("closest_waypoint", self._nearer_waypoint()),
            ("tstamp", self._clock_steps * self._period_s),
            ("episode_status", self._status),
            ("speed_mps", now.speed_mps),
            ("yaw_rate_radps", now.yaw_rate_radps),
            ("offset_m", now.offset_m),
            ("heading_error_rad", now.heading_error_rad),
            ("episode_return", self._return),
        ):
            row[:, PACKED[name]] = values

    def _nearer_waypoint(self) -> np.ndarray:
        """Return the nearer of the two closest waypoints, the one behind where they are equally far."""
        closest = self._now.closest_waypoints
        away = self.setup.track.waypoints[closest] - self._now.front[:, None]
        behind_m, ahead_m = np.hypot(away[..., 0], away[..., 1]).T
        return np.where(ahead_m < behind_m, closest[:, 1], closest[:, 0])

    def _drive(self, steering_deg: np.ndarray, speed_mps: np.ndarray, running: np.ndarray) -> None:
        self._steering_deg = np.where(running, steering_deg, 0.0)
        self._commanded_mps = np.where(running, speed_mps, 0.0)
        sent_deg, sent_mps = steering_deg, speed_mps
        if self._noise is not None:
            noise, randomization = self._noise.normal(), self.setup.randomization
            sent_deg = sent_deg + randomization.steering_noise_deg * noise[:, 0]
            sent_mps = sent_mps * (1 + randomization.speed_noise * noise[:, 1])
        self._batch.drive(sent_mps, np.radians(sent_deg), moving=running)

    def _observe(self) -> None:
        """Measure all cars, and compute what the policy sees of them."""
        self._now = Measures.of(self._batch.read(), self.setup.car.front_point_m, self.setup.track)
        self.observation = self._features_of(self._now, self._everyone)

    def _observe_started(self, ids: np.ndarray) -> None:
        """The same for the cars `ids` alone: at nearly every step some car of many starts an episode."""
        if len(ids) == self.n_cars:
            self._observe()
            self._last_front = self._now.front.copy()
            return
        car = CarState(*(values[ids] for values in self._batch.read()))
        started = Measures.of(car, self.setup.car.front_point_m, self.setup.track)
        self._now.replace(ids, started)
        self._last_front[ids] = started.front
        # The terminal observation has been handed out; it must stay as it was.
        self.observation = self.observation.copy()
        self.observation[ids] = self._features_of(started, ids)

    def _features_of(self, measures: Measures, ids: np.ndarray) -> np.ndarray:
        return self._features.compute(
            measures,
            self._steering_deg[ids],
            self._commanded_mps[ids],
            self.setup.track.points_at(self._features.ahead(measures.ndist)),
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
        return f"car {self.cars[row]} at step {self._steps[row]} of its episode {self._episode[row]}"

    def _non_finite(self, message: str, action: np.ndarray) -> NonFinite:
        return NonFinite(message, {**self.state_arrays(), "action": np.asarray(action)})
