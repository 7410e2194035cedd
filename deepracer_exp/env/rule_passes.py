"""The passes of the rules over the cars, compiled; `rules` says what each rule is."""

import math

import numpy as np

from deepracer_exp.compiled import compiled
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


@compiled
def judge_cars(  # type: ignore[no-untyped-def]
    steps, progress, last_progress, moved_m, off_track, limits, still, falling, codes, status
):
    """Write every car's status code and counters; see `EpisodeRules.apply`."""
    for car in range(len(steps)):
        status[car], still[car], falling[car] = judge_car(
            steps[car],
            progress[car],
            last_progress[car],
            moved_m[car],
            off_track[car],
            limits,
            still[car],
            falling[car],
            codes,
        )


@compiled
def judge_car(  # type: ignore[no-untyped-def]
    step, progress, last_progress, moved_m, off_track, limits, still, falling, codes
):
    """Return a car's status code, and for how many steps it has now stood and driven backwards.

    Args: see `EpisodeRules`; `codes` are those of `rules`.
    """
    max_steps, immobilized_steps, immobilized_m, reversed_steps = limits
    prepare, in_progress, reverse, immobilized, off, lap_complete, time_up = codes
    if step <= 1:
        return prepare, 0, 0
    still = still + 1 if moved_m <= immobilized_m else 0
    falling = falling + 1 if progress < last_progress else 0
    if max_steps and step >= max_steps:
        status = time_up
    elif progress >= 100.0:
        status = lap_complete
    elif off_track:
        status = off
    elif immobilized_steps and still >= immobilized_steps:
        status = immobilized
    elif reversed_steps and falling >= reversed_steps:
        status = reverse
    else:
        status = in_progress
    return status, still, falling


@compiled
def wheels_of_cars(road, track_index, x_m, y_m, yaw_rad, wheels_m):  # type: ignore[no-untyped-def]
    """Return which wheels of every car are on the road, (N, 4); see `wheels_on_road`."""
    on = np.empty((len(x_m), len(wheels_m)), np.bool_)
    for car in range(len(x_m)):
        line = track_index[car if len(track_index) > 1 else 0]
        wheels_of_car(road, line, x_m[car], y_m[car], yaw_rad[car], wheels_m, on[car])
    return on


@compiled
def wheels_of_car(road, line, x_m, y_m, yaw_rad, wheels_m, on):  # type: ignore[no-untyped-def]
    """Write which wheels of a car are on the road, (4,)."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    for wheel in range(len(wheels_m)):
        ahead, left = wheels_m[wheel, 0], wheels_m[wheel, 1]
        on[wheel] = is_on_road(road, line, x_m + cos * ahead - sin * left, y_m + sin * ahead + cos * left)


@compiled
def begin_episodes(  # type: ignore[no-untyped-def]
    ids,
    cars,
    course,
    begins,
    start_offset,
    start_advance,
    first_track,
    turns,
    center,
    closed,
    episode,
    driven,
    track_index,
    start_ndist,
    steps,
    previous,
    last_progress,
    still,
    falling,
):
    """Begin an episode with each of the cars `ids` and return its start pose; see `RaceRules.reset`.

    Arrays from `episode` on are changed in place. `begins` has no entry where the start advances.
    """
    x, y, yaw_rad = np.empty(len(ids)), np.empty(len(ids)), np.empty(len(ids))
    for i in range(len(ids)):
        car = ids[i]
        episode[car] += 1
        where = course[car]
        line = track_index[car] = first_track[where] + driven[car, where] % turns[where]
        driven[car, where] += 1
        if len(begins):
            start_ndist[car] = begins[i]
        else:
            # An open course is driven from its start: from anywhere else it could not be completed.
            advanced = cars[car] + episode[car] if closed[line] else 0
            start_ndist[car] = (start_offset + start_advance * advanced) % 1.0
        steps[car] = still[car] = falling[car] = 0
        previous[car] = last_progress[car] = 0.0
        x[i], y[i], yaw_rad[i] = pose_at(center, closed[line], line, start_ndist[car])
    return x, y, yaw_rad


@compiled
def step_cars(  # type: ignore[no-untyped-def]
    x_m,
    y_m,
    yaw_rad,
    front,
    ndist,
    track_index,
    closed,
    road,
    wheels_m,
    start_ndist,
    limits,
    lap_terminates,
    codes,
    endings,
    steps,
    clock_steps,
    previous,
    last_progress,
    last_front,
    still,
    falling,
):
    """Apply the rules to one control step of every car and return the arrays of `StepResult` from `running` on.

    Arrays from `steps` on are changed in place.
    """
    cars = len(x_m)
    running, percent, before = np.empty(cars, np.bool_), np.empty(cars), np.empty(cars)
    all_on, off_track = np.empty(cars, np.bool_), np.empty(cars, np.bool_)
    status, wheels_on = np.empty(cars, np.int64), np.empty(len(wheels_m), np.bool_)
    for car in range(cars):
        steps[car] += 1
        clock_steps[car] += 1
        running[car] = steps[car] > 1
        percent[car], previous[car] = lap_progress(ndist[car], start_ndist[car], previous[car])
        wheels_of_car(road, track_index[car], x_m[car], y_m[car], yaw_rad[car], wheels_m, wheels_on)
        all_on[car], off_track[car] = wheels_on.all(), not wheels_on.any()
        x, y = front[car, 0], front[car, 1]
        status[car], still[car], falling[car] = judge_car(
            steps[car],
            percent[car],
            last_progress[car],
            math.hypot(x - last_front[car, 0], y - last_front[car, 1]),
            off_track[car],
            limits,
            still[car],
            falling[car],
            codes,
        )
        before[car] = last_progress[car] if steps[car] > 2 else percent[car]
        last_progress[car], last_front[car, 0], last_front[car, 1] = percent[car], x, y
    terminated, truncated = endings_of(status, track_index, closed, lap_terminates, endings)
    return running, percent, before, all_on, off_track, status, terminated, truncated


@compiled
def endings_of(status, track_index, closed, lap_terminates, endings):  # type: ignore[no-untyped-def]
    """Return which statuses terminate episodes, and which cut them off, (N,) each; `endings` are those of `rules`."""
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
