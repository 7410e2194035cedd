"""Laps of a scripted driver in the simulated car: one line at several speeds, and laps with a flaw."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.env.others.race_others import RaceOthers
from deepracer_exp.env.rules import RaceRules, lap_clock_s
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.env.state import Measures
from deepracer_exp.env.trace_columns import STATUS_CODE
from deepracer_exp.rewards.params import BATCH_COLUMNS, MASK, OBJECT_COLUMNS
from deepracer_exp.sim.batch import CarBatch
from deepracer_exp.tracks.track import Track

from .objects import free_road
from .situations import Situations

Floats = NDArray[np.float64]

SHARES = (0.6, 0.8, 1.0)
"""Shares of the highest speed at each place at which the laps are driven."""
_LATERAL_MPS2 = (6.0, 5.0, 4.0, 3.0, 2.0, 1.0)
"""Lateral acceleration in bends; the first one with which all laps stay on the road is used."""
# Gains of the driver, chosen so that both the car of version 4, whose wheels lag commands by half a second, and the
# ideal car complete every track of the catalogue at 1 to 3 m/s.
_FORESIGHT_S = 0.25
_AHEAD_M, _AHEAD_S = 0.45, 0.2
_UNDERSTEER = 1.5
_BRAKING_MPS2 = 0.7
_LOOK_M = np.linspace(0.0, 2.4, 9)
_BEND_M, _BEND_RAD = 0.6, 0.4
"""Definition of a bend for a driver on its outside: the road turns by at least this angle within this distance."""
_WEAVE_S = 0.27
"""Time for which a driver that weaves steers to one side; about that of a car's steering."""


@dataclass(frozen=True, kw_only=True)
class SimpleDriver:
    """The style of a lap."""

    lateral_mps2: float
    """Lateral acceleration in bends."""
    share: float = 1.0
    """Factor on the speed at each place."""
    weave_deg: float = 0.0
    """Added to the steering angle, to the left and to the right in turn."""
    outwards: float = 0.0
    """Position towards the outer border of each bend: 0 is the centre line, 1 the border."""
    foresight: float = 1.0
    """Share of the distance ahead in which bends are seen; 0: the driver brakes only in them."""


@dataclass(frozen=True, eq=False)
class DrivenLap:
    """A complete lap with all wheels on the track."""

    driver: SimpleDriver
    speed_mps: float
    """Commanded on straights; less in bends."""
    time_s: float
    paid: Situations
    """Rewarded steps of the lap."""


def action_space_laps(setup: RaceSetup) -> list[DrivenLap]:
    """Drive one line at several shares of the speeds of the action space; return the complete laps, slowest first.

    The driver may steer any angle and slow down to the lowest speed, whatever the action space allows.
    """
    shares = [share for share in SHARES if share * setup.actions.high[1] > setup.actions.low[1]]
    shares = [*shares[:-1], 1.0]
    best: list[DrivenLap] = []
    laps = drive_laps(
        setup, [SimpleDriver(lateral_mps2=bend, share=share) for bend in _LATERAL_MPS2 for share in shares]
    )
    for first in range(0, len(laps), len(shares)):
        complete = [lap for lap in laps[first : first + len(shares)] if lap is not None]
        if len(complete) > len(best):
            best = complete
    return best


def flawed_laps(setup: RaceSetup, good: DrivenLap) -> dict[str, DrivenLap]:
    """Return laps like a good one but no faster, each with a flaw by which it is named.

    Each flaw is as strong as it can be with all wheels on the road; a lap that leaves the road even with the weakest
    flaw is missing.
    """

    def laps(bends: Sequence[float], **flaw: float) -> list[SimpleDriver]:
        return [replace(good.driver, lateral_mps2=bend * good.driver.lateral_mps2, **flaw) for bend in bends]

    flaws = {
        "zig-zag": [driver for deg in (20.0, 14.0, 8.0) for driver in laps([1.0, 0.8], weave_deg=deg)],
        "wide": [driver for share in (0.6, 0.4) for driver in laps([1.0, 0.8, 0.6], outwards=share)],
        # A driver that brakes late has to take the bend slower.
        "late braking": [
            driver for seen in (0.0, 0.3) for driver in laps([0.7, 0.5, 0.3, 0.15], foresight=seen)
        ],
    }
    driven = iter(drive_laps(setup, [driver for drivers in flaws.values() for driver in drivers]))
    flawed: dict[str, DrivenLap] = {}
    for name, drivers in flaws.items():
        for lap in [next(driven) for _ in drivers]:
            if lap is not None and lap.time_s >= good.time_s:
                flawed.setdefault(name, lap)
    return flawed


def drive_laps(setup: RaceSetup, drivers: Sequence[SimpleDriver]) -> list[DrivenLap | None]:
    """Drive laps side by side by pursuit of the centre line; None: not completed with all wheels on the track.

    In a race among others these are always half a lap away.

    Args:
        setup: the track, the car, and the action space with the highest speed and the lowest, which holds in bends.
        drivers: one for each lap.
    """
    n = len(drivers)
    share = np.array([driver.share for driver in drivers])
    car = setup.car
    # The car drives no slower than that.
    lowest_mps = max(float(setup.actions.low[1]), car.min_speed_mps)
    highest_mps = max(float(setup.actions.high[1]), lowest_mps)
    batch = CarBatch(car, n, 1, setup.track.floor.friction)
    rules = RaceRules(setup, n)
    pose = rules.reset(start_ndist=np.zeros(n))
    batch.place(np.arange(n), pose.x, pose.y, pose.yaw_rad)
    others = None if setup.others is None else RaceOthers(setup.others, setup, rules)
    driving, complete = np.ones(n, bool), np.zeros(n, bool)
    steps: list[dict[str, np.ndarray]] = []
    ends = np.zeros(n, np.int64)
    # Twice the duration of a lap, plus the standing start.
    most = 30 + int(2 * setup.track.length_m / lowest_mps * car.control_hz)
    while driving.any() and len(steps) < most:
        now = rules.measure(batch.read())
        result = rules.apply()
        steering_deg = _steer(setup, now, drivers, len(steps) * car.control_period_s)
        wanted_mps = share * np.minimum(_bend_speed(setup, now, drivers), highest_mps)
        wanted_mps = np.maximum(wanted_mps, lowest_mps)
        steps.append(rules.params(result, steering_deg, wanted_mps))
        if others is not None:
            steps[-1] |= free_road(setup, rules, result, others)
        done = driving & (result.status == STATUS_CODE["lap_complete"])
        ends[done] = len(steps)
        complete |= done
        # On an open track the rear wheels start behind the road.
        driving &= ~done & (result.all_wheels_on_track | (result.progress < 5))
        batch.drive(wanted_mps, np.radians(steering_deg), moving=result.running & driving)
    keys = (*BATCH_COLUMNS, *(() if others is None else (*OBJECT_COLUMNS, MASK)))
    columns = {key: np.stack([step[key] for step in steps]) for key in keys}
    return [
        DrivenLap(
            driver=drivers[i],
            speed_mps=float(max(share[i] * highest_mps, lowest_mps)),
            time_s=float(lap_clock_s(ends[i], car.control_period_s)),
            paid=Situations(
                {key: column[1 : ends[i], i] for key, column in columns.items()}, rules.track_params[0]
            ),
        )
        if complete[i]
        else None
        for i in range(n)
    ]


def _bend_speed(setup: RaceSetup, now: Measures, drivers: Sequence[SimpleDriver]) -> Floats:
    """Return the highest speed from which a car can still brake for every bend that its driver sees ahead, (n,)."""
    track = setup.track
    lateral_mps2 = np.array([driver.lateral_mps2 for driver in drivers])
    look_m = _LOOK_M * np.array([driver.foresight for driver in drivers])[:, None]
    place = now.ndist[:, None] + look_m / track.length_m
    around_m = 0.25
    curvature = np.maximum(np.abs(_turn_rad(track, place, around_m)) / (2 * around_m), 1e-3)
    braking_m = np.maximum(look_m - 0.3, 0.0)
    fastest: Floats = np.sqrt(lateral_mps2[:, None] / curvature + 2 * _BRAKING_MPS2 * braking_m).min(axis=1)
    return fastest


def _turn_rad(track: Track, ndist: Floats, around_m: float) -> Floats:
    """Return the centre line's turn to the left between a distance behind a place and a distance ahead of it."""
    behind, ahead = (track.start_pose(ndist + side * around_m / track.length_m).yaw_rad for side in (-1, 1))
    turn_rad: Floats = np.mod(ahead - behind + np.pi, 2 * np.pi) - np.pi
    return turn_rad


def _steer(setup: RaceSetup, now: Measures, drivers: Sequence[SimpleDriver], time_s: float) -> Floats:
    """Return pure-pursuit steering angles in degrees, from the predicted pose to a point ahead, (n,)."""
    car, track = setup.car, setup.track
    speed_mps = np.maximum(now.speed_mps, 0.3)
    turn_rad = now.yaw_rate_radps * _FORESIGHT_S
    direction_rad, yaw_rad = now.yaw_rad + turn_rad / 2, now.yaw_rad + turn_rad
    x_m = now.x_m + speed_mps * _FORESIGHT_S * np.cos(direction_rad)
    y_m = now.y_m + speed_mps * _FORESIGHT_S * np.sin(direction_rad)
    ndist = track.project(np.column_stack([x_m, y_m])).ndist
    ahead = ndist + (_AHEAD_M + _AHEAD_S * speed_mps) / track.length_m
    there = track.start_pose(ahead)
    # To the left of the centre line: to the outside of the bend in which the point is.
    outside = -np.tanh(_turn_rad(track, ahead, _BEND_M) / _BEND_RAD)
    side_m = outside * np.array([driver.outwards for driver in drivers]) * track.width_m / 2
    dx = there.x - side_m * np.sin(there.yaw_rad) - x_m
    dy = there.y + side_m * np.cos(there.yaw_rad) - y_m
    along, aside = dx * np.cos(yaw_rad) + dy * np.sin(yaw_rad), dy * np.cos(yaw_rad) - dx * np.sin(yaw_rad)
    curvature = 2.0 * aside / (along**2 + aside**2)
    angle_deg = np.degrees(np.arctan(_UNDERSTEER * car.wheelbase_m * curvature))
    to_the_left = int(time_s / _WEAVE_S) % 2 == 0
    angle_deg += np.array([driver.weave_deg for driver in drivers]) * (1 if to_the_left else -1)
    return np.clip(angle_deg, -car.max_steering_deg, car.max_steering_deg)
