"""Laps of one line at several shares of its speeds, driven in the simulated car by a simple driver."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.env.others import RaceOthers
from deepracer_exp.env.rules import RaceRules, lap_clock_s
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.env.state import Measures
from deepracer_exp.env.trace import STATUS_CODE
from deepracer_exp.rewards.params import BATCH_COLUMNS, MASK, OBJECT_COLUMNS
from deepracer_exp.sim.batch import CarBatch

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


@dataclass(frozen=True, eq=False)
class DrivenLap:
    """A complete lap with all wheels on the track."""

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
    laps = drive_laps(setup, np.repeat(_LATERAL_MPS2, len(shares)), np.tile(shares, len(_LATERAL_MPS2)))
    for first in range(0, len(laps), len(shares)):
        complete = [lap for lap in laps[first : first + len(shares)] if lap is not None]
        if len(complete) > len(best):
            best = complete
    return best


def drive_laps(setup: RaceSetup, lateral_mps2: Floats, share: Floats) -> list[DrivenLap | None]:
    """Drive n laps side by side by pursuit of the centre line; None: not completed with all wheels on the track.

    In a race among others these are always half a lap away.

    Args:
        setup: the track, the car, and the action space with the highest speed and the lowest, which holds in bends.
        lateral_mps2: lateral acceleration in bends, (n,).
        share: factor on the speed at each place, (n,).
    """
    n = len(share)
    car = setup.car
    lowest_mps, highest_mps = float(setup.actions.low[1]), float(setup.actions.high[1])
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
        steering_deg = _steer(setup, now)
        wanted_mps = share * np.minimum(_bend_speed(setup, now, lateral_mps2), highest_mps)
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


def _bend_speed(setup: RaceSetup, now: Measures, lateral_mps2: Floats) -> Floats:
    """Return the highest speed from which a car can still brake for every bend ahead, (n,)."""
    track = setup.track
    place = now.ndist[:, None] + _LOOK_M / track.length_m
    around_m = 0.25
    behind, ahead = (track.start_pose(place + side * around_m / track.length_m).yaw_rad for side in (-1, 1))
    turn_rad = np.abs(np.mod(ahead - behind + np.pi, 2 * np.pi) - np.pi)
    curvature = np.maximum(turn_rad / (2 * around_m), 1e-3)
    braking_m = np.maximum(_LOOK_M - 0.3, 0.0)
    fastest: Floats = np.sqrt(lateral_mps2[:, None] / curvature + 2 * _BRAKING_MPS2 * braking_m).min(axis=1)
    return fastest


def _steer(setup: RaceSetup, now: Measures) -> Floats:
    """Return pure-pursuit steering angles in degrees, from the predicted pose to a point ahead, (n,)."""
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
