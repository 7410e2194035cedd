"""The courses of a recording, found by name or recognised by the car's positions."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from deepracer_exp.aws.logs.recorded import LogProblem, Recording
from deepracer_exp.aws.logs.sim_trace import EARLIEST_CLOCK_S
from deepracer_exp.aws.worlds.catalogue import find_world, worlds
from deepracer_exp.aws.worlds.routes import NEAR_M, recognise, world_rows
from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.driving import TrackConfig
from deepracer_exp.config.named import service_car
from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.env.rules import wheels_on_road
from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.runs.run_files import CONFIG, read_config
from deepracer_exp.tracks.sectors import waypoint_positions
from deepracer_exp.tracks.track import Track, TrackIndex, Tracks, world_track

_SAMPLE = 2000
"""Rows of a course that are used to recognise it."""
_HEAD = 20_000
"""Rows of a course that show in which direction it is driven."""
_LENGTH_NEAR = 0.01
"""Share by which a logged length may differ from that of the course."""
_INSIDE = 0.95
"""Share of the rows that must be on or just beside the road."""
_BESIDE_M = 0.3
"""Metres beside the road at which a car's episode ends."""
_MISJUDGED = 0.02
"""Share of the rows whose wheels may be on the other side of the borders than logged: on the right world at most half a
per cent (rounding), on one of another width four to ten."""
_SAME_NUMBERS = 0.9
"""Share of the rows whose waypoint must be one of the two around them; the rest is rounding."""
_LEAST_WAYPOINTS = 20
_ESTIMATE_NEAR = 0.1
"""Share by which an estimated centre line may be longer or shorter than the logged length."""
_HALF_CAR_M = 0.1
_DIRECTION_ROWS = 60
"""Rows of an episode from which its driving direction is determined: 4 s."""
_JUMP = 20.0
"""Per cent of progress between adjacent rows beyond which the car must have been reset."""


def find_courses(recording: Recording) -> tuple[dict[str, Track], tuple[LogProblem, ...]]:
    """Find the course of each name in a recording's `steps.track`, in the direction in which most rows were driven.

    One of our own runs has its courses in its config.yaml. Other names are looked up among the service's worlds; a
    course without a known name, or with one that does not match the positions of the car, is recognised by its length,
    its width, its waypoint numbers and the positions of the car.

    Returns:
        The courses by name, and those that were not recognised, or not for certain, with the reason.
    """
    configs: Mapping[str, TrackConfig] = {}
    problems: list[LogProblem] = []
    for file in recording.files:
        if file.name == CONFIG:
            try:
                configs = parse_experiment(read_config(file.parent)).tracks
            except BadInput as error:
                problems.append(LogProblem(str(file), None, str(error)))
            break
    tracks: dict[str, Track] = {}
    steps = recording.steps
    names = steps["track"].astype("category").cat.remove_unused_categories()
    for code, name in enumerate(map(str, names.cat.categories)):
        rows = np.flatnonzero(names.cat.codes == code)
        sample = _with_late_wheels(steps, rows[:: max(1, len(rows) // _SAMPLE)])
        logged = name or recording.track or ""
        try:
            if logged in configs:
                both = [Track.from_config(configs[logged], reversed=back) for back in (False, True)]
            elif (world := _recognised(logged, sample)) is not None:
                both = [world_track(world.name, back) for back in (False, True)]
                if world.misjudged > _MISJUDGED and world.name != find_world(logged):
                    problems.append(LogProblem(recording.name, None, _of_another_width(logged, world)))
            else:
                raise BadInput(_unknown(logged, sample))
            tracks[name] = directed(both[0], both[1], steps.iloc[rows[:_HEAD]])
        except BadInput as error:
            problems.append(LogProblem(recording.name, None, str(error)))
    return tracks, tuple(problems)


def catalogue_track(name: str, reversed: bool = False) -> Track:
    """Return a world of the service, or the course of a route file (.npy) or a YAML of knots.

    Raises:
        BadInput: there is no such course.
    """
    path = Path(name)
    if path.suffix in (".npy", ".yaml", ".yml"):
        return Track.from_file(path, reversed)
    if find_world(name) is None:
        raise BadInput(
            f"--track {name}: no such world{nearest(name, worlds())}; accepted: a name that `deepracer-exp tracks` "
            "lists, or the file of a route (.npy) or of knots (.yaml)"
        )
    return world_track(name, reversed)


class _Recognised(NamedTuple):
    name: str
    """Name of the world."""
    misjudged: float
    """Share of the rows whose wheels are on the other side of its borders than logged."""


def _recognised(logged: str, sample: pd.DataFrame) -> _Recognised | None:
    """Return the world whose length, width and waypoint numbers are those of the rows; None if the car was elsewhere.

    Several worlds have one shape: resampled, with other borders, or on other floors. The width decides before the
    waypoint numbers, because a wrong one makes off-tracks; the name decides last, because worlds were resampled under
    the names they had.
    """
    waypoint = sample["closest_waypoint"].to_numpy(np.intp)
    usable = np.isfinite(sample[["X", "Y", "yaw"]].to_numpy(np.float64)).all(axis=1) & (waypoint >= 0)
    sample, waypoint = sample[usable], waypoint[usable]
    if not len(sample):
        return None
    points = sample[["X", "Y"]].to_numpy(np.float64)
    length_m = float(sample["track_len"].median())
    away_m: dict[str, float] = {}
    for match in recognise(points, waypoint):
        away_m.setdefault(match.name, match.distance_m)
    named, car = find_world(logged), service_car()
    ranked: list[tuple[tuple[bool, float, bool, float], _Recognised]] = []
    for name in worlds():
        steps_m = np.linalg.norm(np.diff(world_rows(name)[:, :2], axis=0), axis=1)
        if abs(steps_m.sum() - length_m) > _LENGTH_NEAR * length_m or not _inside(world_track(name), points):
            continue
        share = _misjudged(world_track(name), sample, car)
        rank = share > _MISJUDGED, round(away_m.get(name, NEAR_M), 3), name != named, share
        ranked.append((rank, _Recognised(name, share)))
    # Worlds that differ in their floors only are equal: the first one is used.
    return min(ranked, key=lambda entry: entry[0])[1] if ranked else None


def _misjudged(track: Track, sample: pd.DataFrame, car: CarConfig) -> float:
    """Return the share of rows whose `all_wheels_on_track`, in time or late, contradicts a course's borders."""
    on_road = recorded_wheels_on_road(Tracks([track]), np.zeros(1, np.intp), sample, car).all(axis=1)
    logged = sample[["all_wheels_on_track", "late_wheels"]].to_numpy(bool)
    return min(float(np.mean(on_road != column)) for column in logged.T)


def _with_late_wheels(steps: pd.DataFrame, rows: NDArray[np.intp]) -> pd.DataFrame:
    """Return rows of the steps with `late_wheels`: the next row's wheels if the simulator was not paused.

    The service's simulator of 2019 and 2020 was not paused between control steps, and wheels are logged a step late.
    Its time stamps are those of a clock.
    """
    sample = steps.iloc[rows]
    following = steps.iloc[np.minimum(rows + 1, len(steps) - 1)]
    wheels, late = (some["all_wheels_on_track"].to_numpy(bool) for some in (sample, following))
    follows = sample["episode"].to_numpy() == following["episode"].to_numpy()
    follows &= sample["tstamp"].to_numpy() >= EARLIEST_CLOCK_S
    return sample.assign(late_wheels=np.where(follows, late, wheels))


def recorded_wheels_on_road(
    tracks: Tracks, track_index: TrackIndex, steps: pd.DataFrame, car: CarConfig
) -> NDArray[np.bool_]:
    """Rebuild which wheels of a recorded car were on the road, (n, 4), rebuilt from X, Y and yaw.

    The steps have finite X, Y and yaw, (n,); `track_index` is the course of each, as `Tracks.on_road` takes it.
    """
    # Recorded poses are of the front point; wheels are measured from the chassis origin.
    wheels_m = np.array(car.wheel_points_m) - [car.front_point_m, 0.0]
    x_m, y_m, yaw_deg = steps[["X", "Y", "yaw"]].to_numpy(np.float64).T
    return wheels_on_road(tracks, track_index, x_m, y_m, np.radians(yaw_deg), wheels_m)


def _of_another_width(logged: str, world: _Recognised) -> str:
    who = f"track {logged!r}" if logged else "the track, which the log does not name,"
    return (
        f"{who} has the shape of {world.name}, but {world.misjudged:.0%} of the rows have wheels on the other side of "
        "its borders than logged, so its width may be another; `--track ROUTE` takes the file of its route (.npy)"
    )


def _inside(track: Track, points: NDArray[np.float64]) -> bool:
    off_m = np.abs(track.project(points).offset_m)
    return bool(np.mean(off_m < track.width_max_m / 2 + _BESIDE_M) >= _INSIDE)


def was_driven_on(track: Track, steps: pd.DataFrame) -> bool:
    """Return whether logged lengths and positions are those of a course."""
    length_m = float(steps["track_len"].median())
    near = abs(track.length_m - length_m) <= _LENGTH_NEAR * length_m
    return near and _inside(track, steps[["X", "Y"]].to_numpy(np.float64))


def numbered_as_logged(course: Track, steps: pd.DataFrame) -> Track:
    """Return the course with the waypoint numbers of the log.

    A route that was sampled differently has other numbers; then the waypoints are moved to where the log has them.
    """
    sample = steps.iloc[:: max(1, len(steps) // (10 * _SAMPLE))]
    waypoint = sample["closest_waypoint"].to_numpy(np.intp)
    projected = course.project(sample[["X", "Y"]].to_numpy(np.float64))
    if np.mean((waypoint == projected.previous) | (waypoint == projected.next)) >= _SAME_NUMBERS:
        return course
    # The first waypoint of a closed course is at 0 and at 1, so the mean is taken on the circle.
    turn = pd.Series(np.exp(2j * np.pi * projected.ndist)).groupby(waypoint).sum()
    logged = turn.index.to_numpy()
    place = np.unwrap(np.angle(turn) / (2 * np.pi), period=1.0)
    if len(logged) < 2 or (np.diff(place) <= 0).any() or place[-1] - place[0] >= 1.0:
        return course
    numbers = np.arange(logged[-1] + 1)
    pace = (place[-1] - place[0]) / (logged[-1] - logged[0])
    placed = np.interp(numbers, logged, place) + pace * np.minimum(numbers - logged[0], 0)
    # No car drove beyond the highest number in the log, so the spacing there is arbitrary.
    positions = (
        np.concatenate([placed, np.arange(placed[-1] + pace, placed[0] + 1.0 - 0.5 * pace, pace)]) % 1.0
    )
    course_positions = waypoint_positions(course)
    borders = [np.interp(positions, course_positions, axis) for axis in (*course.inner.T, *course.outer.T)]
    rows = np.column_stack([course.points_at(positions), *borders])
    rows = np.vstack([rows, rows[:1]]) if course.closed else rows
    rows = rows[::-1] if course.reversed else rows
    return Track.from_route(
        rows, course.name, title=course.title, reversed=course.reversed, floor=course.floor
    )


def estimated_course(name: str, steps: pd.DataFrame) -> Track | None:
    """Return a course estimated from the recorded positions, for drawing; None if they do not cover the whole lap.

    Its centre line is the median of the positions at which each waypoint was the closest, its width what the car used
    with all wheels on the road.
    """
    rows = steps[(steps["closest_waypoint"] >= 0) & (steps["episode_status"] != "prepare")]
    middle = rows.groupby("closest_waypoint")[["X", "Y"]].median()
    if len(middle) < max(_LEAST_WAYPOINTS, _INSIDE * (int(rows["closest_waypoint"].max()) + 1)):
        return None
    center = middle.reindex(range(int(middle.index[-1]) + 1)).interpolate(limit_direction="both").to_numpy()
    length_m = float(rows["track_len"].median())
    ring = np.vstack([center, center[:1]])
    steps_m = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    if abs(steps_m.sum() - length_m) > _ESTIMATE_NEAR * length_m or steps_m[-1] > 10 * np.median(steps_m):
        return None
    ahead = np.roll(center, -1, axis=0) - np.roll(center, 1, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)[:, None]
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    on_road = rows[rows["all_wheels_on_track"].to_numpy(bool)]
    index = on_road["closest_waypoint"].to_numpy(np.intp)
    aside = np.abs(((on_road[["X", "Y"]].to_numpy(np.float64) - center[index]) * left[index]).sum(axis=1))
    half_m = _HALF_CAR_M + (float(np.quantile(aside, 0.98)) if len(aside) else _HALF_CAR_M)
    side = left if shapely.is_ccw(shapely.LinearRing(ring)) else -left
    route = np.column_stack([center, center + half_m * side, center - half_m * side])
    title = f"{name or 'unknown'} (drawn from recorded positions)"
    try:
        return Track.from_route(np.vstack([route, route[:1]]), name, title=title)
    except BadInput:
        return None


def directed(forward: Track, backward: Track, steps: pd.DataFrame) -> Track:
    """Return the course in the direction in which progress grows in most of the first rows."""
    head = steps.iloc[:_HEAD].sort_values("episode", kind="stable")
    along = progress_along(forward, head, head["episode"].to_numpy(np.int64))
    return backward if along.sum() < 0.0 else forward


def progress_along(course: Track, steps: pd.DataFrame, episode: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return each row's movement along a course since the last row, times its gain of progress, (n,).

    It is positive where the course is driven in its own direction, and 0 in the first row of an episode (their numbers
    are `episode`, contiguous) and where the car was reset.
    """
    gone = np.diff(course.project(steps[["X", "Y"]].to_numpy(np.float64)).ndist, prepend=np.nan)
    gone = (gone + 0.5) % 1.0 - 0.5 if course.closed else gone
    gained = np.diff(steps["progress"].to_numpy(np.float64), prepend=np.nan)
    counted = (np.diff(episode, prepend=-1) == 0) & (np.abs(gained) < _JUMP) & np.isfinite(gone)
    return np.where(counted, gone * gained, 0.0)


def driven_against(course: Track, steps: pd.DataFrame, episode: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether each row is of an episode driven against the course's own direction, (n,).

    `episode` is the number of each row's episode, non-decreasing. An episode that does not move counts as driven in the
    course's own direction.
    """
    within = np.arange(len(episode)) - np.searchsorted(episode, episode)
    finite = np.isfinite(steps[["X", "Y", "progress"]].to_numpy()).all(axis=1)
    rows = np.flatnonzero(finite & (within < _DIRECTION_ROWS))
    along = progress_along(course, steps.iloc[rows], episode[rows])
    sums = np.bincount(episode[rows], along, minlength=int(episode.max(initial=0)) + 1)
    return (sums < 0)[episode]


def _unknown(name: str, rows: pd.DataFrame) -> str:
    who = f"track {name!r} is" if name else "the log does not name its track, which is"
    return (
        f"{who} none of the service's {len(worlds())} worlds ({float(rows['track_len'].median()):.3f} m long); "
        "`--track ROUTE` takes the file of its route (.npy)"
    )
