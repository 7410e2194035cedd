"""The rules of a race as the service's simulator applies them: progress, wheels on the road, the end of an episode."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.rewards.params import TrackParams
from deepracer_exp.sim.batch import CarState
from deepracer_exp.tracks.track import Pose, Tracks

from .rule_passes import (
    Episodes,
    Places,
    Rules,
    Starts,
    begin_episodes,
    endings_of,
    step_cars,
    wheels_of_cars,
)
from .setup import RaceSetup, courses_of_cars
from .state import Floats, Measures, checked_array
from .trace_columns import STATUS_CODE

Ids = NDArray[np.intp]
Bools = NDArray[np.bool_]

_KEPT = {
    **{name: name for name in ("episode", "steps", "clock_steps", "start_ndist", "course")},
    **{f"_{name}": name for name in ("driven", "previous", "last_progress", "last_front")},
    "track_index": "which",
}
"""The arrays that later steps depend on, and their keys in a checkpoint."""
_NOWHERE = np.zeros(0)

_CODES = tuple(
    STATUS_CODE[status]
    for status in (
        "prepare",
        "in_progress",
        "reversed",
        "immobilized",
        "off_track",
        "lap_complete",
        "time_up",
    )
)
_ENDINGS = tuple(STATUS_CODE[status] for status in ("in_progress", "pause", "lap_complete", "time_up"))
"""Codes passed to compiled loops as arguments: numba's cache would not notice a change of constants."""


def lap_clock_s(steps: ArrayLike, period_s: float) -> Floats:
    """Return the clock of a lap at control steps that were driven without a pause, in s, of the shape of `steps`.

    A lap time is its clock at the last step plus the penalties. The clock starts with the reset, as the service's
    does, and the prepare step, step 1, is measured one period later (deepracer-simapp, markov/metrics/s3_metrics.py:
    `elapsed_time_in_milliseconds` is `metric_time` minus `start_time`). A lap that follows another without a stop
    starts with the last step of that.
    """
    return np.asarray(steps, np.float64) * period_s


@dataclass(frozen=True, eq=False)
class StepResult:
    """The result of one control step; arrays with one row per car."""

    now: Measures
    """The poses the rules were applied to."""
    running: Bools
    """Whether the car is past its prepare step, so that it gets rewards."""
    progress: Floats
    """Per cent of the lap."""
    previous_progress: Floats
    """Per cent of the lap at the step before; in the step of an episode's first reward, `progress`."""
    all_wheels_on_track: Bools
    off_track: Bools
    """Whether no wheel is on the road."""
    status: NDArray[np.int64]
    """Codes of `env.trace_columns.STATUS_CODE`."""
    terminated: Bools
    truncated: Bools
    """Whether the episode was cut off although the car could drive on: at `episode.max_steps`, or at the end of a
    closed lap."""


class RaceRules:
    """Applies the rules to the poses of N cars step by step, from physics, a recording or any caller.

    A step is one call of `measure` and one of `apply`. The first step of an episode is the prepare step, in which the
    car stands at its start pose and nothing ends the episode.

    Attributes:
        now: the poses last measured.
        episode: number of the episode each car is in, from 0, (N,), int64.
        steps: control steps of the episode so far, the prepare step being 1, (N,), int64.
        clock_steps: control steps since `restart`, (N,), int64.
        start_ndist: where the episodes began, as shares of the lap, (N,).
        tracks: each course in each of its directions, as one batch.
        track_params: a reward function's constant params of each of these.
        course: index of each car's course in `setup.courses`, (N,).
        track_index: index of its track in `tracks` and `track_params`, (N,).
        episodes: these arrays and more, for compiled code, which changes them in place: none may be replaced.
    """

    def __init__(self, setup: RaceSetup, n_cars: int, first_car: int = 0):
        """Set up the cars, the first of which has a number over all processes; `reset` begins their episodes."""
        self.n_cars = n_cars
        self.cars = np.arange(first_car, first_car + n_cars)
        tracks = [track for course in setup.courses for track in course.tracks]
        self.tracks = Tracks(tracks)
        self.track_params = tuple(map(TrackParams.of, tracks))
        turns = np.array([len(course.tracks) for course in setup.courses])
        first_track = np.cumsum(turns) - turns
        self.course = courses_of_cars(setup.weights, first_car + n_cars)[first_car:]
        self.track_index = first_track[self.course]
        self._driven = np.zeros((n_cars, len(turns)), np.int64)
        self._period_s = setup.car.control_period_s
        self._front_point_m = setup.car.front_point_m
        self._everyone = np.arange(n_cars)
        self.now: Measures
        self.episode = np.full(n_cars, -1)
        self.steps = np.zeros(n_cars, np.int64)
        self.clock_steps = np.zeros(n_cars, np.int64)
        self.start_ndist = np.zeros(n_cars)
        self._previous = np.zeros(n_cars)
        self._last_progress = np.zeros(n_cars)
        self._last_front = np.zeros((n_cars, 2))
        self._still = np.zeros(n_cars, np.int64)
        self._falling = np.zeros(n_cars, np.int64)
        self.episodes = Episodes(
            self.cars,
            self.course,
            self.track_index,
            self._driven,
            self.episode,
            self.start_ndist,
            self.steps,
            self.clock_steps,
            self._previous,
            self._last_progress,
            self._last_front,
            self._still,
            self._falling,
        )
        episode = setup.episode
        self._starts = Starts(episode.start_offset, episode.start_advance, first_track, turns)
        self._rules = Rules(
            (
                episode.max_steps,
                episode.immobilized_steps,
                float(episode.immobilized_m),
                episode.reversed_steps,
            ),
            _CODES,
            _ENDINGS,
            episode.lap_terminates,
            np.array(setup.car.wheel_points_m, np.float64),
        )

    def restart(self) -> None:
        """Start over: clocks at 0, and the next episode is the first."""
        self.episode[:] = -1
        self.clock_steps[:] = 0
        self._driven[:] = 0

    @property
    def length_m(self) -> Floats:
        """Return the length of each car's track, (N,)."""
        length_m: Floats = self.tracks.length_m[self.track_index]
        return length_m

    def reset(
        self, ids: Ids | None = None, start_ndist: np.ndarray | None = None, course: np.ndarray | None = None
    ) -> Pose:
        """Begin an episode with each of the cars and return the start poses of the chassis origins.

        Args:
            ids: indices of the cars, None: all of them.
            start_ndist: where they start, as shares of the lap, (n,); None: the start advances by
                `episode.start_advance` with every episode, as on the service, and from car to car.
            course: indices of the courses to move to, (n,); None: each car stays on its own. Where the direction
                alternates, it does so with each episode that the car begins there.
        """
        ids = self._everyone if ids is None else ids
        if course is not None:
            self.course[ids] = course
        begins = _NOWHERE if start_ndist is None else np.asarray(start_ndist, np.float64)
        center, closed = self.tracks.lines[0], self.tracks.closed
        return Pose(*begin_episodes(ids, begins, self.episodes, self._starts, center, closed))

    def put_back(self, ids: Ids, percent: np.ndarray) -> Pose:
        """Continue the cars' episodes from another place and return where their chassis origins are put.

        As on the service the chassis origin is put where the front was at that progress in per cent, (n,).
        """
        self._previous[ids] = percent
        self._last_progress[ids] = percent
        self.rest(ids)
        return self.tracks.start_pose(self.start_ndist[ids] + percent / 100.0, self.track_index[ids])

    def start_midway(self, steps: np.ndarray, progress: np.ndarray) -> None:
        """Put all cars in the middle of their episodes, after `steps` control steps, at `progress` per cent, (N,)."""
        self.steps[:] = steps
        self._previous[:] = progress
        self._last_progress[:] = progress

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything the next steps depend on; `measure` must have been called.

        The measurements are part of it: cars may have been measured apart from others, and NumPy does not promise the
        same last bit for an array of another length.
        """
        kept = {key: getattr(self, name).copy() for name, key in _KEPT.items()}
        counters = {"still": self._still.copy(), "falling": self._falling.copy()}
        return {**kept, "rules": counters, "now": self.now.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`.

        Raises:
            BadInput: it is of another number of cars or tracks.
        """
        for name, key in _KEPT.items():
            array = getattr(self, name)
            array[:] = checked_array(state, key, array.shape)
        self._still[:] = checked_array(state["rules"], "still", self._still.shape)
        self._falling[:] = checked_array(state["rules"], "falling", self._falling.shape)
        self.now = Measures.from_state_dict(state["now"], self.n_cars)

    def measure(self, cars: CarState) -> Measures:
        """Measure the poses of all cars."""
        self.now = Measures.of(cars, self._front_point_m, self.tracks, self.track_index)
        return self.now

    def measure_some(self, ids: Ids, cars: CarState) -> Measures:
        """Measure new poses of the cars `ids` alone and return these; the others keep their last measurements."""
        measures = Measures.of(cars, self._front_point_m, self.tracks, self.track_index[ids])
        self.now.replace(ids, measures)
        return measures

    def apply(self) -> StepResult:
        """Apply the rules to the measured poses: one control step of every car."""
        now = self.now
        places = Places(now.x_m, now.y_m, now.yaw_rad, now.front, now.ndist)
        closed, road = self.tracks.closed, self.tracks.road
        return StepResult(now, *step_cars(places, self.episodes, self._rules, closed, road))

    def ends(self, status: NDArray[np.int64]) -> tuple[Bools, Bools]:
        """Return which status codes of all cars, (N,), terminate and which truncate their episodes, (N,) each."""
        lap_terminates, closed = self._rules.lap_terminates, self.tracks.closed
        terminated, truncated = endings_of(status, self.track_index, closed, lap_terminates, _ENDINGS)
        return terminated, truncated

    def rest(self, ids: Ids) -> None:
        """Forget how long the cars `ids` have stood or driven backwards."""
        self._still[ids] = 0
        self._falling[ids] = 0

    def params(
        self, result: StepResult, steering_deg: np.ndarray, speed_mps: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Return the columns of `params.BATCH_COLUMNS` for the last step and the commands chosen at its poses, (N,)."""
        now = result.now
        return {
            "all_wheels_on_track": result.all_wheels_on_track,
            "x": now.front[:, 0],
            "y": now.front[:, 1],
            "heading": np.degrees(now.yaw_rad),
            "distance_from_center": now.distance_m,
            "projection_distance": now.ndist * self.length_m,
            "progress": result.progress,
            "steps": self.steps.astype(np.float64),
            "speed": speed_mps,
            "steering_angle": steering_deg,
            "track_width": now.track_width_m,
            "closest_waypoints": now.closest_waypoints,
            "is_left_of_center": now.is_left,
            "is_offtrack": result.off_track,
            "sim_time": self.clock_steps * self._period_s,
            "previous_progress": result.previous_progress,
        }


def wheels_on_road(
    tracks: Tracks, track_index: Ids, x_m: Floats, y_m: Floats, yaw_rad: Floats, wheels_m: ArrayLike
) -> Bools:
    """Return which wheel centres are on the road, (N, 4); the cars count as level, as in the service's log.

    Args:
        tracks: the courses.
        track_index: index in them of each car's track, (N,), or of that of all, (1,).
        x_m: where the cars are, (N,).
        y_m: likewise.
        yaw_rad: headings, (N,).
        wheels_m: wheels ahead and to the left of there, (4, 2).
    """
    wheels_m = np.asarray(wheels_m, np.float64)
    poses = (np.ascontiguousarray(values, np.float64) for values in (x_m, y_m, yaw_rad))
    return np.asarray(wheels_of_cars(tracks.road, track_index, tuple(poses), wheels_m))
