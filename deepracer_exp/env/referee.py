"""What is said of the cars' poses: progress, wheels on the road, the rules' verdict, params of a reward function."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.formats.trace import STATUS_CODE
from deepracer_exp.sim.batch import CarState
from deepracer_exp.tracks.progress import progress
from deepracer_exp.tracks.tracks import Pose, Tracks

from .courses import courses_of_cars
from .measures import Floats, Measures
from .params import Road
from .rules import EpisodeRules
from .setup import RaceSetup
from .state import fitting

Ids = NDArray[np.intp]
Bools = NDArray[np.bool_]


_KEPT = (
    *("episode", "steps", "clock_steps", "start_ndist", "course", "which"),
    *("_driven", "_previous", "_last_progress", "_last_front"),
)
"""A referee's arrays that the future depends on."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What one control step says of the cars; arrays with one row per car."""

    now: Measures
    """The poses that were judged."""
    running: Bools
    """Not in the prepare step, so that rewards are paid."""
    progress: Floats
    """Per cent of the lap."""
    all_wheels_on_track: Bools
    off_track: Bools
    """No wheel on the road."""
    status: NDArray[np.int64]
    """Codes of `formats.trace.STATUS_CODE`."""
    terminated: Bools
    truncated: Bools
    """`episode.max_steps` was reached."""


class Referee:
    """Judges the poses of N cars step by step, wherever they come from: physics, a recording, somebody's question.

    A step is one pose read with `see` and one call of `judge`. The first step of an episode is the prepare step.

    Attributes:
        now: the poses last seen.
        episode: number of the episode each car is in, from 0, (N,), int64.
        steps: control steps of the episode that were judged, the prepare step being 1, (N,), int64.
        clock_steps: control steps since `restart`, (N,), int64.
        start_ndist: where the episodes began, as shares of the lap, (N,).
        tracks: the courses in their directions, side by side.
        roads: what reward functions are told of each of these.
        course: place of each car's course in `setup.courses`, (N,).
        which: place of its track in `tracks` and `roads`, (N,).
    """

    def __init__(self, setup: RaceSetup, n_cars: int, first_car: int = 0):
        """Know the cars; `reset` begins their episodes.

        Args:
            setup: track, dimensions of the car and rules.
            n_cars: number of cars.
            first_car: number of the first car over all processes; starts depend on it.
        """
        self.n_cars = n_cars
        self.cars = np.arange(first_car, first_car + n_cars)
        tracks = [track for course in setup.courses for track in course.tracks]
        self.tracks = Tracks(tracks)
        self.roads = tuple(map(Road.of, tracks))
        self._turns = np.array([len(course.tracks) for course in setup.courses])
        self._first_track = np.cumsum(self._turns) - self._turns
        weights = [course.weight for course in setup.courses]
        self.course = courses_of_cars(weights, first_car + n_cars)[first_car:]
        self.which = self._first_track[self.course]
        self._driven = np.zeros((n_cars, len(self._turns)), np.int64)
        self._period_s = setup.car.control_period_s
        self._front_point_m = setup.car.front_point_m
        self._wheels = np.array(setup.car.wheel_points_m)
        self._episodes = setup.episode
        self._rules = EpisodeRules(setup.episode, n_cars)
        self._everyone = np.arange(n_cars)
        self.now: Measures
        self.episode = np.full(n_cars, -1)
        self.steps = np.zeros(n_cars, np.int64)
        self.clock_steps = np.zeros(n_cars, np.int64)
        self.start_ndist = np.zeros(n_cars)
        self._previous = np.zeros(n_cars)
        self._last_progress = np.zeros(n_cars)
        self._last_front = np.zeros((n_cars, 2))

    def restart(self) -> None:
        """Begin anew: clocks at 0, and the next episode is the first."""
        self.episode[:] = -1
        self.clock_steps[:] = 0
        self._driven[:] = 0

    @property
    def length_m(self) -> Floats:
        """Return the length of each car's track, (N,)."""
        length_m: Floats = self.tracks.length_m[self.which]
        return length_m

    def reset(
        self, ids: Ids | None = None, start_ndist: np.ndarray | None = None, course: np.ndarray | None = None
    ) -> Pose:
        """Begin an episode with each of the cars and return where its chassis origin starts.

        Args:
            ids: indices of the cars, None: all of them.
            start_ndist: where they start as shares of the lap, (n,); None: the start moves on by
                `episode.start_advance` with every episode, as on the service, and from car to car.
            course: places of other courses to go to, (n,); None: each stays on its own. Where the direction
                alternates it does so with each episode that the car begins there.
        """
        ids = self._everyone if ids is None else ids
        self.episode[ids] += 1
        episode = self.episode[ids]
        if course is not None:
            self.course[ids] = course
        own = self.course[ids]
        which = self.which[ids] = self._first_track[own] + self._driven[ids, own] % self._turns[own]
        self._driven[ids, own] += 1
        if start_ndist is None:
            # An open course is driven from its start: from anywhere else it could not be completed.
            turns = np.where(self.tracks.closed[which], self.cars[ids] + episode, 0)
            start_ndist = np.mod(self._episodes.start_offset + self._episodes.start_advance * turns, 1.0)
        self.start_ndist[ids] = start_ndist
        for counter in (self.steps, self._previous, self._last_progress):
            counter[ids] = 0
        self._rules.reset(ids)
        return self.tracks.start_pose(self.start_ndist[ids], which)

    def put_back(self, ids: Ids, percent: np.ndarray) -> Pose:
        """Let cars go on in their episodes from elsewhere and return where their chassis origins are put.

        Args:
            ids: indices of the cars.
            percent: progress at which they go on, (n,). The front of the car is put there, except that nobody is put
                behind the start.
        """
        length_m = self.length_m[ids]
        ahead_m = np.maximum(percent / 100.0 * length_m - self._front_point_m, 0.0)
        self._previous[ids] = percent
        self._last_progress[ids] = percent
        self._rules.reset(ids)
        return self.tracks.start_pose(self.start_ndist[ids] + ahead_m / length_m, self.which[ids])

    def resume(self, steps: np.ndarray, progress: np.ndarray) -> None:
        """Take all cars for being in the middle of their episodes.

        Args:
            steps: control steps they have behind them, (N,).
            progress: per cent, at the last of these, (N,).
        """
        self.steps[:] = steps
        self._previous[:] = progress
        self._last_progress[:] = progress

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all that the next verdicts depend on, once poses were seen.

        The poses are part of it as they were measured: those of some cars are measured without the others, and
        NumPy does not promise the same last bit for an array of another length.
        """
        own = {name.lstrip("_"): getattr(self, name).copy() for name in _KEPT}
        return {**own, "rules": self._rules.state_dict(), "now": self.now.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a `state_dict`.

        Raises:
            BadInput: it is of another number of cars or tracks.
        """
        for name in _KEPT:
            setattr(self, name, fitting(state, name.lstrip("_"), getattr(self, name).shape))
        self._rules.load_state_dict(state["rules"])
        self.now = Measures.from_state_dict(state["now"], self.n_cars)

    def see(self, cars: CarState) -> Measures:
        """Measure the poses of all cars."""
        self.now = Measures.of(cars, self._front_point_m, self.tracks, self.which)
        return self.now

    def see_some(self, ids: Ids, cars: CarState) -> Measures:
        """Measure new poses of the cars `ids` alone and return these; the others stay where they were seen."""
        measures = Measures.of(cars, self._front_point_m, self.tracks, self.which[ids])
        self.now.replace(ids, measures)
        return measures

    def judge(self) -> Verdict:
        """Judge the poses seen: one control step of every car."""
        self.steps += 1
        self.clock_steps += 1
        now = self.now
        percent, self._previous = progress(now.ndist, self.start_ndist, self._previous)
        wheels_on = self._wheels_on_road()
        off_track: Bools = np.asarray(~wheels_on.any(axis=1))
        moved_m = np.hypot(*(now.front - self._last_front).T)
        status = self._rules.judge(self.steps, percent, self._last_progress, moved_m, off_track)
        # `reset` writes zeros into what is kept here; a verdict stays as it was given.
        self._last_progress, self._last_front = percent.copy(), now.front
        truncated = status == STATUS_CODE["time_up"]
        return Verdict(
            now=now,
            running=self.steps > 1,
            progress=percent,
            all_wheels_on_track=np.asarray(wheels_on.all(axis=1)),
            off_track=off_track,
            status=status,
            terminated=(status > STATUS_CODE["in_progress"]) & ~truncated,
            truncated=truncated,
        )

    def params(
        self, verdict: Verdict, steering_deg: np.ndarray, speed_mps: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Return the columns of `params.COLUMNS` for the last verdict and the commands chosen at its poses, (N,)."""
        now = verdict.now
        return {
            "all_wheels_on_track": verdict.all_wheels_on_track,
            "x": now.front[:, 0],
            "y": now.front[:, 1],
            "heading": np.degrees(now.yaw_rad),
            "distance_from_center": now.distance_m,
            "projection_distance": now.ndist * self.length_m,
            "progress": verdict.progress,
            "steps": self.steps.astype(np.float64),
            "speed": speed_mps,
            "steering_angle": steering_deg,
            "track_width": now.track_width_m,
            "closest_waypoints": now.closest_waypoints,
            "is_left_of_center": now.is_left,
            "is_offtrack": verdict.off_track,
            "sim_time": self.clock_steps * self._period_s,
        }

    def nearer_waypoint(self) -> np.ndarray:
        """Return the nearer of the two closest waypoints, the one behind where they are equally far, (N,)."""
        closest = self.now.closest_waypoints
        away = self.tracks.waypoints(closest, self.which) - self.now.front[:, None]
        behind_m, ahead_m = np.hypot(away[..., 0], away[..., 1]).T
        return np.where(ahead_m < behind_m, closest[:, 1], closest[:, 0])

    def _wheels_on_road(self) -> Bools:
        """Return which wheel centres are on the road, (N, 4); flat, from x, y and yaw, as the service's log has."""
        now = self.now
        cos, sin = np.cos(now.yaw_rad)[:, None], np.sin(now.yaw_rad)[:, None]
        wheel_x, wheel_y = self._wheels.T
        points = np.empty((self.n_cars, len(self._wheels), 2))
        points[:, :, 0] = now.x_m[:, None] + cos * wheel_x - sin * wheel_y
        points[:, :, 1] = now.y_m[:, None] + sin * wheel_x + cos * wheel_y
        return self.tracks.on_road(points.reshape(-1, 2), self.which).reshape(self.n_cars, -1)
