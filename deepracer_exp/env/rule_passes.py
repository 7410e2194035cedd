"""Compiled loops that apply the rules to all cars; `rules` defines each rule."""

import math
from typing import Any, NamedTuple

import numpy as np

from deepracer_exp.jit import compiled
from deepracer_exp.tracks.segments import is_on_road, pose_at


@compiled
def lap_progress(ndist, start_ndist, previous):  # type: ignore[no-untyped-def]
    """Return progress in per cent and the value to pass as `previous` at the next step.

    The rule is that of deepracer-simapp (agent_ctrl/utils.py): a fall by more than half a lap means that
    the start line was passed forwards, a rise by more than half a lap that the car rolled back over it.

    Args:
        ndist: Normalised projection on the centre line, 0 to 1.
        start_ndist: Where the episode began, 0 to 1.
        previous: Second result of the step before; 0 at an episode's first step.

    Returns:
        Progress (at most 100; below 0 behind the start), and the next `previous` (0 after a full lap).
    """
    p = 100.0 * (ndist - start_ndist)
    if p <= 0.0:
        p += 100.0
    if previous > p + 50.0:
        p += 100.0
    if p > previous + 50.0:
        p -= 100.0
    if p >= 100.0:
        return 100.0, 0.0
    return p, p


class Judged(NamedTuple):
    """Inputs of the rules for one car at a control step."""

    steps: Any
    """The prepare step is 1."""
    progress: Any
    """Per cent of the lap, and that at the step before."""
    last_progress: Any
    moved_m: Any
    """Distance since the step before."""
    off_track: Any
    """Whether no wheel is on the road."""


@compiled
def judge_car(judged, still, falling, rules):  # type: ignore[no-untyped-def]
    """Return a car's status code, and for how many steps it has now stood and driven backwards.

    The rules are those of deepracer-simapp (markov/reset/rules and rollout_agent_ctrl.py). Where several hold, the
    service's priority decides: time_up, lap_complete, the others. `rules` are the limits and the codes of `Rules`.
    """
    limits, codes = rules
    max_steps, immobilized_steps, immobilized_m, reversed_steps = limits
    prepare, in_progress, reverse, immobilized, off, lap_complete, time_up = codes
    if judged.steps <= 1:
        return prepare, 0, 0
    still = still + 1 if judged.moved_m <= immobilized_m else 0
    falling = falling + 1 if judged.progress < judged.last_progress else 0
    if max_steps and judged.steps >= max_steps:
        status = time_up
    elif judged.progress >= 100.0:
        status = lap_complete
    elif judged.off_track:
        status = off
    elif immobilized_steps and still >= immobilized_steps:
        status = immobilized
    elif reversed_steps and falling >= reversed_steps:
        status = reverse
    else:
        status = in_progress
    return status, still, falling


@compiled
def wheels_of_cars(road, track_index, poses, wheels_m):  # type: ignore[no-untyped-def]
    """Return which wheels of every car are on the road, (N, 4); see `wheels_on_road`."""
    x_m, y_m, yaw_rad = poses
    on = np.empty((len(x_m), len(wheels_m)), np.bool_)
    for car in range(len(x_m)):
        line = track_index[car if len(track_index) > 1 else 0]
        wheels_of_car(road, line, (x_m[car], y_m[car], yaw_rad[car]), wheels_m, on[car])
    return on


@compiled
def wheels_of_car(road, line, pose, wheels_m, on):  # type: ignore[no-untyped-def]
    """Write which wheels of a car at x, y and yaw are on the road, (4,)."""
    x_m, y_m, yaw_rad = pose
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    for wheel in range(len(wheels_m)):
        ahead, left = wheels_m[wheel, 0], wheels_m[wheel, 1]
        on[wheel] = is_on_road(road, line, x_m + cos * ahead - sin * left, y_m + sin * ahead + cos * left)


class Episodes(NamedTuple):
    """Progress of N cars in their episodes: arrays with a row per car, changed in place; see `RaceRules`."""

    cars: np.ndarray
    """Numbers of the cars over all processes."""
    course: np.ndarray
    track_index: np.ndarray
    driven: np.ndarray
    """Episodes that a car has begun on each course, (N, courses)."""
    episode: np.ndarray
    start_ndist: np.ndarray
    steps: np.ndarray
    clock_steps: np.ndarray
    previous: np.ndarray
    """Second result of `lap_progress`."""
    last_progress: np.ndarray
    last_front: np.ndarray
    still: np.ndarray
    """For how many steps a car has stood, and driven backwards."""
    falling: np.ndarray


class Starts(NamedTuple):
    """Starts of the episodes."""

    offset: float
    """Start of the first episode, and what each after it adds: shares of the lap."""
    advance: float
    first_track: np.ndarray
    """For each course: index of its track in the first direction, and in how many it is driven, (courses,)."""
    turns: np.ndarray


@compiled
def begin_episodes(ids, begins, episodes, starts, center, closed):  # type: ignore[no-untyped-def]
    """Begin an episode with each of the cars `ids` and return its start pose; see `RaceRules.reset`.

    `episodes` are changed in place. `begins` has no entry where the start advances; `center` are the centre lines, of
    which some are closed.
    """
    x, y, yaw_rad = np.empty(len(ids)), np.empty(len(ids)), np.empty(len(ids))
    for i in range(len(ids)):
        car = ids[i]
        episodes.episode[car] += 1
        where = episodes.course[car]
        line = starts.first_track[where] + episodes.driven[car, where] % starts.turns[where]
        episodes.track_index[car] = line
        episodes.driven[car, where] += 1
        if len(begins):
            episodes.start_ndist[car] = begins[i]
        else:
            # An open course is driven from its start: from anywhere else it could not be completed.
            advanced = episodes.cars[car] + episodes.episode[car] if closed[line] else 0
            episodes.start_ndist[car] = (starts.offset + starts.advance * advanced) % 1.0
        episodes.steps[car] = episodes.still[car] = episodes.falling[car] = 0
        episodes.previous[car] = episodes.last_progress[car] = 0.0
        x[i], y[i], yaw_rad[i] = pose_at(center, closed[line], line, episodes.start_ndist[car])
    return x, y, yaw_rad


class Rules(NamedTuple):
    """The rules of a race."""

    limits: tuple[int, int, float, int]
    """`max_steps`, `immobilized_steps`, `immobilized_m` and `reversed_steps` of `EpisodeConfig`."""
    codes: tuple[int, ...]
    """Codes of `rules`, which also has `endings`."""
    endings: tuple[int, ...]
    lap_terminates: bool
    wheels_m: np.ndarray
    """Wheels ahead and to the left of the chassis origin, (4, 2)."""


class Places(NamedTuple):
    """Positions of cars: the arrays of `Measures` that the rules need."""

    x_m: np.ndarray
    y_m: np.ndarray
    yaw_rad: np.ndarray
    front: np.ndarray
    ndist: np.ndarray


@compiled
def step_cars(places, episodes, rules, closed, road):  # type: ignore[no-untyped-def]
    """Apply the rules to one control step of every car and return the arrays of `StepResult` from `running` on.

    `episodes` are changed in place; `closed` and `road` are those of `Tracks`.
    """
    cars, wheels_m = len(places.x_m), rules.wheels_m
    steps, previous, last_progress = episodes.steps, episodes.previous, episodes.last_progress
    last_front, still, falling = episodes.last_front, episodes.still, episodes.falling
    running, percent, before = np.empty(cars, np.bool_), np.empty(cars), np.empty(cars)
    all_on, off_track = np.empty(cars, np.bool_), np.empty(cars, np.bool_)
    status, wheels_on = np.empty(cars, np.int64), np.empty(len(wheels_m), np.bool_)
    for car in range(cars):
        steps[car] += 1
        episodes.clock_steps[car] += 1
        running[car] = steps[car] > 1
        percent[car], previous[car] = lap_progress(
            places.ndist[car], episodes.start_ndist[car], previous[car]
        )
        pose = places.x_m[car], places.y_m[car], places.yaw_rad[car]
        wheels_of_car(road, episodes.track_index[car], pose, wheels_m, wheels_on)
        all_on[car], off_track[car] = wheels_on.all(), not wheels_on.any()
        x, y = places.front[car, 0], places.front[car, 1]
        moved_m = math.hypot(x - last_front[car, 0], y - last_front[car, 1])
        judged = Judged(steps[car], percent[car], last_progress[car], moved_m, off_track[car])
        status[car], still[car], falling[car] = judge_car(
            judged, still[car], falling[car], (rules.limits, rules.codes)
        )
        before[car] = last_progress[car] if steps[car] > 2 else percent[car]
        last_progress[car], last_front[car, 0], last_front[car, 1] = percent[car], x, y
    terminated, truncated = endings_of(
        status, episodes.track_index, closed, rules.lap_terminates, rules.endings
    )
    return running, percent, before, all_on, off_track, status, terminated, truncated


@compiled
def endings_of(status, track_index, closed, lap_terminates, endings):  # type: ignore[no-untyped-def]
    """Return which statuses terminate and which truncate episodes, (N,) each; `endings` are those of `rules`."""
    in_progress, pause, lap_complete, time_up = endings
    terminated, truncated = np.empty(len(status), np.bool_), np.empty(len(status), np.bool_)
    for car in range(len(status)):
        code = status[car]
        cut = code == time_up
        if not lap_terminates:
            cut |= code == lap_complete and closed[track_index[car]]
        truncated[car] = cut
        terminated[car] = not (cut or code <= in_progress or code == pause)
    return terminated, truncated


@compiled
def nearer_of(closest, front, waypoints, first):  # type: ignore[no-untyped-def]
    """Return which of the two waypoints around a car is nearer to its front, the one behind if both are equally far.

    Args:
        closest: the waypoint behind and the one ahead, (2,).
        front: front point, (2,).
        waypoints: of all courses, see `Tracks.waypoints`.
        first: where those of the car's course begin among them.
    """
    behind, ahead = closest[0], closest[1]
    at_behind, at_ahead = waypoints[first + behind], waypoints[first + ahead]
    behind_m = math.hypot(at_behind[0] - front[0], at_behind[1] - front[1])
    ahead_m = math.hypot(at_ahead[0] - front[0], at_ahead[1] - front[1])
    return ahead if ahead_m < behind_m else behind
