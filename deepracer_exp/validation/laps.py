"""Laps of the project's own car, driven by pursuit of the centre line."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.env.measures import Measures
from deepracer_exp.env.params import COLUMNS
from deepracer_exp.env.referee import Referee
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.formats.trace import STATUS_CODE
from deepracer_exp.sim.batch import CarBatch

from .situations import Situations

Floats = NDArray[np.float64]

_SPEEDS = 5
_LATERAL_MPS2 = (2.0, 1.0)
"""How hard bends are taken: at the second where the first leads off the road."""
# The driver's numbers, chosen so that the fitted car, whose wheels follow commands half a second late, and the ideal
# one get round the courses of the catalogue at every speed from 1 to 3 m/s.
_FORESIGHT_S = 0.25
_AHEAD_M, _AHEAD_S = 0.45, 0.2
_UNDERSTEER = 1.5
_BRAKING_MPS2 = 0.7
_LOOK_M = np.linspace(0.0, 2.4, 9)


@dataclass(frozen=True, eq=False)
class Lap:
    """A complete lap with all wheels on the road."""

    speed_mps: float
    """Commanded, but less in bends."""
    time_s: float
    paid: Situations
    """Its steps for which a reward is paid."""


def action_space_laps(setup: RaceSetup) -> list[Lap]:
    """Drive at speeds from the lowest to the highest of the action space; those that get round, slowest first.

    The driver steers any angle and brakes to any speed from the lowest, whatever the action space.
    """
    low, high = float(setup.actions.low[1]), float(setup.actions.high[1])
    speeds = np.linspace(low, high, _SPEEDS) if high > low else np.array([low])
    laps: dict[float, Lap] = {}
    for lap in drive_laps(setup, np.repeat(speeds, len(_LATERAL_MPS2)), np.tile(_LATERAL_MPS2, len(speeds))):
        laps.setdefault(lap.speed_mps, lap)
    return list(laps.values())


def drive_laps(setup: RaceSetup, speed_mps: Floats, lateral_mps2: Floats) -> list[Lap]:
    """Drive n laps side by side and return those that were completed with all wheels on the road.

    Args:
        setup: the track, the car and the lowest speed, in bends, too.
        speed_mps: of each, (n,).
        lateral_mps2: acceleration in bends, (n,).
    """
    n = len(speed_mps)
    car = setup.car
    batch = CarBatch(car, n, 1, setup.track.floor.friction)
    referee = Referee(setup, n)
    pose = referee.reset(start_ndist=np.zeros(n))
    batch.place(np.arange(n), pose.x, pose.y, pose.yaw_rad)
    driving, complete = np.ones(n, bool), np.zeros(n, bool)
    steps: list[dict[str, np.ndarray]] = []
    ends = np.zeros(n, np.int64)
    lowest_mps = float(speed_mps.min())
    # Twice the time a lap takes, and pulling away.
    most = 30 + int(2 * setup.track.length_m / lowest_mps * car.control_hz)
    while driving.any() and len(steps) < most:
        now = referee.see(batch.read())
        verdict = referee.judge()
        steering_deg = _steer(setup, now)
        wanted_mps = np.clip(_bend_speed(setup, now, lateral_mps2), lowest_mps, speed_mps)
        steps.append(referee.params(verdict, steering_deg, wanted_mps))
        done = driving & (verdict.status == STATUS_CODE["lap_complete"])
        ends[done] = len(steps)
        complete |= done
        # On an open course the rear wheels start behind the road.
        driving &= ~done & (verdict.all_wheels_on_track | (verdict.progress < 5))
        batch.drive(wanted_mps, np.radians(steering_deg), moving=verdict.running & driving)
    columns = {key: np.stack([step[key] for step in steps]) for key in COLUMNS}
    return [
        Lap(
            speed_mps=float(speed_mps[i]),
            time_s=float((ends[i] - 1) * car.control_period_s),
            paid=Situations(
                {key: column[1 : ends[i], i] for key, column in columns.items()}, referee.roads[0]
            ),
        )
        for i in np.flatnonzero(complete)
    ]


def _bend_speed(setup: RaceSetup, now: Measures, lateral_mps2: Floats) -> Floats:
    """Return the speed from which a car can slow down for every bend ahead, (n,)."""
    track = setup.track
    at = now.ndist[:, None] + _LOOK_M / track.length_m
    around_m = 0.25
    behind, ahead = (track.start_pose(at + side * around_m / track.length_m).yaw_rad for side in (-1, 1))
    turn_rad = np.abs(np.mod(ahead - behind + np.pi, 2 * np.pi) - np.pi)
    curvature = np.maximum(turn_rad / (2 * around_m), 1e-3)
    braking_m = np.maximum(_LOOK_M - 0.3, 0.0)
    fastest: Floats = np.sqrt(lateral_mps2[:, None] / curvature + 2 * _BRAKING_MPS2 * braking_m).min(axis=1)
    return fastest


def _steer(setup: RaceSetup, now: Measures) -> Floats:
    """Return steering angles in degrees that lead, from where the car will be, to a point ahead (pure pursuit)."""
    car, track = setup.car, setup.track
    speed_mps = np.maximum(now.speed_mps, 0.3)
    turn_rad = now.yaw_rate_radps * _FORESIGHT_S
    direction_rad, yaw_rad = now.yaw_rad + turn_rad / 2, now.yaw_rad + turn_rad
    x_m = now.x_m + speed_mps * _FORESIGHT_S * np.cos(direction_rad)
    y_m = now.y_m + speed_mps * _FORESIGHT_S * np.sin(direction_rad)
    ndist = track.project(np.column_stack([x_m, y_m])).ndist
    target = track.points_at(ndist + (_AHEAD_M + _AHEAD_S * speed_mps) / track.length_m)
    dx, dy = target[:, 0] - x_m, target[:, 1] - y_m
    along, aside = dx * np.cos(yaw_rad) + dy * np.sin(yaw_rad), dy * np.cos(yaw_rad) - dx * np.sin(yaw_rad)
    curvature = 2.0 * aside / (along**2 + aside**2)
    angle_deg = np.degrees(np.arctan(_UNDERSTEER * car.wheelbase_m * curvature))
    return np.clip(angle_deg, -car.max_steering_deg, car.max_steering_deg)
