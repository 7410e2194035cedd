"""Situations of a car and the reward params that the environment computes for them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.env.action_space import ContinuousActions
from deepracer_exp.env.others.placement import Placement
from deepracer_exp.env.rules import RaceRules
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.rewards.params import TrackParams, row_keys, rows, scalar_params, select
from deepracer_exp.sim.batch import CarState
from deepracer_exp.tracks.lanes import INNER, OUTER
from deepracer_exp.tracks.track import Track

from .objects import QUIRKS, Quirks, all_at, first_placement, object_columns

Floats = NDArray[np.float64]

FIRST_STEP = 2
"""`steps` of the first call of an episode, on the service since 2020: its first step, the prepare step, has no call."""


@dataclass(frozen=True, eq=False)
class Situations:
    """Params of n situations on one road."""

    columns: dict[str, np.ndarray]
    """`rewards.params.BATCH_COLUMNS`, each (n,), `closest_waypoints` (n, 2); among others also `OBJECT_COLUMNS` and
    their mask."""
    road: TrackParams

    def __len__(self) -> int:
        """Return the number of situations."""
        return len(self.columns["x"])

    def params(self) -> Iterator[dict[str, Any]]:
        """Yield fresh params of each situation."""
        selected = select(self.columns, np.arange(len(self)))
        keys = row_keys(selected)
        for row in rows(selected):
            yield scalar_params(row, self.road, keys)

    def __getitem__(self, which: slice | np.ndarray) -> "Situations":
        """Return a selection; an array of numbers may repeat some."""
        return Situations({key: column[which] for key, column in self.columns.items()}, self.road)

    def with_columns(self, **columns: np.ndarray) -> "Situations":
        """Return the same situations with some columns replaced."""
        return Situations({**self.columns, **columns}, self.road)


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses:
    """Poses of cars relative to the centre line, and their commands; all (n,)."""

    ndist: Floats
    """Share of the lap."""
    offset_m: Floats
    """Front point to the left of the centre line."""
    heading_error_rad: Floats
    """Against the centre line, positive to the left."""
    speed_mps: Floats
    """Commanded."""
    steering_deg: Floats
    """Commanded, positive to the left."""
    steps: NDArray[np.int64]
    progress_before: Floats
    """Per cent at the step before."""


def poses(
    setup: RaceSetup,
    ndist: ArrayLike,
    offset_m: ArrayLike,
    heading_error_rad: ArrayLike,
    speed_mps: ArrayLike,
    steering_deg: ArrayLike = 0.0,
    *,
    lateness: ArrayLike = 1.0,
) -> Poses:
    """Return poses, with the number of steps to get there; the arguments are broadcast together.

    `lateness` is the number of steps taken so far, relative to driving at the commanded speed all the way.
    """
    values = np.broadcast_arrays(ndist, offset_m, heading_error_rad, speed_mps, steering_deg, lateness)
    ndist_, offset_m_, error_rad, speed, steering, late = (np.array(v, np.float64).ravel() for v in values)
    driven_m = ndist_ * setup.track.length_m
    steps = driven_m / np.maximum(speed, 0.1) / setup.car.control_period_s * late
    return Poses(
        ndist=ndist_,
        offset_m=offset_m_,
        heading_error_rad=error_rad,
        speed_mps=speed,
        steering_deg=steering,
        steps=FIRST_STEP + steps.astype(np.int64),
        progress_before=100.0 * ndist_,
    )


def situations(
    setup: RaceSetup,
    where: Poses,
    earlier: bool = False,
    placement: Placement | None = None,
    quirks: Quirks | None = None,
) -> Situations:
    """Return the params that the environment's rules compute for poses, or `earlier`, one step before.

    Cars have driven straight at the commanded speed since then. In a race among others all meet those of one placement,
    by default that of the first episode; bots stand where they start.
    """
    n = len(where.ndist)
    place = setup.track.start_pose(where.ndist)
    yaw_rad = place.yaw_rad + where.heading_error_rad
    behind_m = setup.car.front_point_m + where.speed_mps * setup.car.control_period_s * earlier
    still = np.zeros(n)
    cars = CarState(
        x_m=place.x - where.offset_m * np.sin(place.yaw_rad) - behind_m * np.cos(yaw_rad),
        y_m=place.y + where.offset_m * np.cos(place.yaw_rad) - behind_m * np.sin(yaw_rad),
        yaw_rad=np.mod(yaw_rad + np.pi, 2 * np.pi) - np.pi,
        speed_mps=where.speed_mps,
        lateral_mps=still,
        yaw_rate_radps=still,
        wheel_angle_rad=still,
    )
    steps_before = np.maximum(where.steps - 1 - earlier, 0)
    rules = RaceRules(setup, n)
    rules.reset(start_ndist=still)
    rules.measure(cars)
    rules.start_midway(steps_before, where.progress_before)
    rules.clock_steps[:] = steps_before
    result = rules.apply()
    columns = rules.params(result, where.steering_deg, where.speed_mps)
    if setup.others is not None:
        columns |= object_columns(setup, rules, result, placement or first_placement(setup), quirks)
    return Situations(columns, rules.track_params[0])


OFF_ROAD_M = 0.5
"""Largest sampled distance beyond the border; an episode ends there."""


@dataclass(frozen=True)
class NamedSituation:
    """A situation with a name, and the step before it."""

    name: str
    setup: RaceSetup
    """The race in which it is."""
    now: Situations
    """The situation."""
    before: Situations
    """The situation one step earlier."""


def middle_speed_mps(setup: RaceSetup) -> float:
    """Return the mean of the slowest and the fastest speed of the action space, at least the car's slowest."""
    return max(float(setup.actions.low[1] + setup.actions.high[1]) / 2, setup.car.min_speed_mps)


def start(setup: RaceSetup) -> Situations:
    """Return the first rewarded step of an episode, its second; in the first the car stood on the start line."""
    front = setup.car.front_point_m / setup.track.length_m
    return situations(setup, poses(setup, front, 0.0, 0.0, middle_speed_mps(setup), lateness=0.0))


def named_situations(setup: RaceSetup, against: Track) -> list[NamedSituation]:
    """Return mid-lap, off-track, finish, wrong way, and mid-lap on the track driven in reverse."""
    speed = middle_speed_mps(setup)
    track = setup.track
    line = np.array([1.0 if not track.closed else 0.05 / track.length_m])
    steps = np.array([2 + int(track.length_m / speed / setup.car.control_period_s)])
    finish = replace(poses(setup, line, 0.0, 0.0, speed), progress_before=np.array([99.5]), steps=steps)
    backwards = setup.on(against)
    return [
        _named("mid-lap", setup, poses(setup, 0.5, 0.0, 0.0, speed)),
        _named("off the track", setup, _off_track(setup, speed)),
        _named("finish", setup, finish),
        _named("wrong way", setup, poses(setup, 0.5, 0.0, np.pi, speed)),
        _named("reversed track", backwards, poses(backwards, 0.5, 0.0, 0.0, speed)),
        *_among_others(setup, speed),
    ]


def _named(name: str, setup: RaceSetup, where: Poses, placement: Placement | None = None) -> NamedSituation:
    if placement is None and setup.others is not None:
        placement = all_at(setup, float(where.ndist[0] + 0.4) * setup.track.length_m)
    now, before = (situations(setup, where, earlier, placement) for earlier in (False, True))
    return NamedSituation(name, setup, now, before)


def _among_others(setup: RaceSetup, speed_mps: float) -> Iterator[NamedSituation]:
    """Yield a car in the middle of the lap behind, beside and in the first box and the first bot of its race."""
    race, track = setup.others, setup.track
    if race is None:
        return
    inner_m = 0.25 * track.width_m * (-1 if track.is_clockwise else 1)
    half_m = 0.5 * track.length_m
    firsts = [("box", 0, race.boxes.count), ("bot", race.boxes.count, race.bots.count)]
    for what, other, count in firsts:
        if not count:
            continue
        for words, offset_m, ahead_m in (
            (f"{what} ahead in its lane", inner_m, 0.8),
            (f"{what} ahead in the other lane", -inner_m, 0.8),
            (f"beside a {what}", -inner_m, 0.0),
            (f"in a {what}", inner_m, 0.1),
        ):
            placement = all_at(setup, 0.0, INNER, other, half_m + ahead_m)
            yield _named(words, setup, poses(setup, 0.5, offset_m, 0.0, speed_mps), placement)


def quirky(setup: RaceSetup, where: Poses, placement: Placement) -> dict[str, tuple[Situations, Situations]]:
    """Return situations with the documented value of each param that the service gets wrong, and with the service's."""
    kinds: tuple[Quirks, Quirks] = ("fixed", "service")
    documented, service = (situations(setup, where, placement=placement, quirks=kind) for kind in kinds)
    return {key: (documented, documented.with_columns(**{key: service.columns[key]})) for key in QUIRKS}


def near_the_start(setup: RaceSetup) -> Iterator[tuple[Situations, Situations]]:
    """Yield a car in the middle of the lap, with an object just after the start line, and with one 3 m further."""
    where = poses(setup, 0.5, 0.0, 0.0, middle_speed_mps(setup))
    for lane in (INNER, OUTER):
        for at_m in (0.1, 0.4, 0.7):
            near, far = (
                situations(setup, where, placement=all_at(setup, 4.0, lane, 0, place_m))
                for place_m in (at_m, at_m + 3.0)
            )
            yield near, far


def seam(setup: RaceSetup) -> Situations:
    """Return the end of the centre line, where the closest waypoints are the last one and its duplicate, the first.

    The service returns these two indices there (`bisect_right` past the end); a car hardly ever hits that point.
    """
    half_way = situations(setup, poses(setup, 0.5, 0.0, 0.0, middle_speed_mps(setup)))
    track = setup.track
    x, y = track.waypoints[-1]
    return half_way.with_columns(
        x=np.array([x]),
        y=np.array([y]),
        projection_distance=np.array([track.length_m]),
        progress=np.array([99.9]),
        closest_waypoints=np.array([[len(track.waypoints) - 1, 0]]),
    )


def _off_track(setup: RaceSetup, speed_mps: float) -> Poses:
    """Return a pose with no wheel on the track, as close to the track and to the middle of the lap as possible."""
    half_m = setup.track.width_m / 2
    away_m, ndist, side = np.meshgrid(
        half_m + np.array([0.2, 0.3, 0.5, 1.0, 2.0]), 0.5 + np.arange(8) / 20, [1.0, -1.0], indexing="ij"
    )
    where = poses(setup, ndist, side * away_m, 0.0, speed_mps)
    first = int(np.argmax(situations(setup, where).columns["is_offtrack"]))
    return Poses(**{name: values[first : first + 1] for name, values in vars(where).items()})


def sample(setup: RaceSetup, n: int) -> Poses:
    """Return n poses typical of a learning car, the same at every call: mostly on the track and facing ahead."""
    random = np.random.default_rng(0)
    half_m = setup.track.width_m / 2
    beyond_m = half_m + OFF_ROAD_M
    offset_m = np.where(
        random.random(n) < 0.7, random.uniform(-half_m, half_m, n), random.uniform(-beyond_m, beyond_m, n)
    )
    kind = random.random(n)
    error_rad = np.where(kind < 0.6, random.normal(0.0, 0.3, n), random.uniform(-np.pi / 2, np.pi / 2, n))
    error_rad = np.where(kind < 0.85, error_rad, random.uniform(-np.pi, np.pi, n))
    if isinstance(setup.actions, ContinuousActions):
        steering_deg, speed_mps = setup.actions.commands(random.uniform(-1.0, 1.0, (n, 2)))
    else:
        steering_deg, speed_mps = setup.actions.commands(random.integers(0, setup.actions.n, n))
    lateness = random.uniform(0.5, 2.0, n)
    return poses(setup, random.random(n), offset_m, error_rad, speed_mps, steering_deg, lateness=lateness)
