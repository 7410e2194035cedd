"""Warn of common mistakes in reward functions that run without an error; some are measured on driven laps."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.deepracer.trace import STATUS_CODE
from deepracer_exp.env.rules import RaceRules, lap_clock_s
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.env.state import Measures
from deepracer_exp.rewards.params import COLUMNS
from deepracer_exp.rewards.reward import RewardFunction
from deepracer_exp.sim.batch import CarBatch

from .probe import Probe
from .reward_map import RewardGrid
from .situations import Situations

Floats = NDArray[np.float64]

_SPEEDS = 5
_LATERAL_MPS2 = (2.0, 1.0)
"""Lateral acceleration in bends; the second is used where the first leaves the track."""
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
    """Its rewarded steps."""


def action_space_laps(setup: RaceSetup) -> list[DrivenLap]:
    """Drive laps at speeds from the lowest to the highest of the action space; return the complete ones, slowest first.

    The driver may steer any angle and slow down to the lowest speed, whatever the action space allows.
    """
    low, high = float(setup.actions.low[1]), float(setup.actions.high[1])
    speeds = np.linspace(low, high, _SPEEDS) if high > low else np.array([low])
    laps: dict[float, DrivenLap] = {}
    for lap in drive_laps(setup, np.repeat(speeds, len(_LATERAL_MPS2)), np.tile(_LATERAL_MPS2, len(speeds))):
        laps.setdefault(lap.speed_mps, lap)
    return list(laps.values())


def drive_laps(setup: RaceSetup, speed_mps: Floats, lateral_mps2: Floats) -> list[DrivenLap]:
    """Drive n laps side by side by pursuit of the centre line and return those completed with all wheels on the track.

    Args:
        setup: the track, the car and the lowest speed, which also holds in bends.
        speed_mps: target speed of each car, (n,).
        lateral_mps2: lateral acceleration in bends, (n,).
    """
    n = len(speed_mps)
    car = setup.car
    batch = CarBatch(car, n, 1, setup.track.floor.friction)
    rules = RaceRules(setup, n)
    pose = rules.reset(start_ndist=np.zeros(n))
    batch.place(np.arange(n), pose.x, pose.y, pose.yaw_rad)
    driving, complete = np.ones(n, bool), np.zeros(n, bool)
    steps: list[dict[str, np.ndarray]] = []
    ends = np.zeros(n, np.int64)
    lowest_mps = float(speed_mps.min())
    # Twice the duration of a lap, plus the standing start.
    most = 30 + int(2 * setup.track.length_m / lowest_mps * car.control_hz)
    while driving.any() and len(steps) < most:
        now = rules.measure(batch.read())
        result = rules.apply()
        steering_deg = _steer(setup, now)
        wanted_mps = np.clip(_bend_speed(setup, now, lateral_mps2), lowest_mps, speed_mps)
        steps.append(rules.params(result, steering_deg, wanted_mps))
        done = driving & (result.status == STATUS_CODE["lap_complete"])
        ends[done] = len(steps)
        complete |= done
        # On an open track the rear wheels start behind the road.
        driving &= ~done & (result.all_wheels_on_track | (result.progress < 5))
        batch.drive(wanted_mps, np.radians(steering_deg), moving=result.running & driving)
    columns = {key: np.stack([step[key] for step in steps]) for key in COLUMNS}
    return [
        DrivenLap(
            speed_mps=float(speed_mps[i]),
            time_s=float(lap_clock_s(ends[i], car.control_period_s)),
            paid=Situations(
                {key: column[1 : ends[i], i] for key, column in columns.items()}, rules.track_params[0]
            ),
        )
        for i in np.flatnonzero(complete)
    ]


def _bend_speed(setup: RaceSetup, now: Measures, lateral_mps2: Floats) -> Floats:
    """Return the highest speed from which a car can still brake for every bend ahead, (n,)."""
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


_HELD = 15
"""Steps without moving after which the service ends the episode."""
_FASTER = 1.1
"""Two laps are compared only if one is faster than the other by this factor."""
_MARGIN = 0.01
"""Rewards closer than this, relative, count as equal."""


def constant_reward(rewards: np.ndarray) -> Iterator[str]:
    """Warn of a constant reward; `rewards` (n,) come from very different situations."""
    if np.ptp(rewards) <= 1e-9 * max(1.0, float(np.abs(rewards).max())):
        yield f"always returns {rewards[0]:.3g}, whatever the car does: there is nothing to learn"


def pays_off_the_road(of: RewardGrid) -> Iterator[str]:
    """Warn if driving beside the track pays as much as driving on it, at medium speed."""
    reward, off = of.reward[1, :, of.along], of.off_track[1, :, of.along]
    on_road, off_road = _best_by_offset(reward, ~off), _best_by_offset(reward, off)
    if on_road is None or off_road is None:
        return
    (on, _), (beyond, at) = on_road, off_road
    margin = _MARGIN * max(abs(on), abs(beyond))
    if beyond >= on - margin:
        than = "more off the track than" if beyond > on + margin else "as much off the track as"
        side = "left" if of.offsets_m[at] > 0 else "right"
        where = f"{abs(of.offsets_m[at]):.2f} m {side} of the centre line"
        yield f"pays {than} on it: {beyond:.3g} per step {where}, at best {on:.3g} on the track"


def _best_by_offset(reward: np.ndarray, counts: np.ndarray) -> tuple[float, int] | None:
    """Return the highest mean over positions of the rewards (P, W) that count, and the index of its offset."""
    counts = counts & np.isfinite(reward)
    enough = counts.sum(axis=0) >= max(1, len(reward) // 2)
    if not enough.any():
        return None
    total = np.where(counts, reward, 0.0).sum(axis=0)
    mean = np.where(enough, total / np.maximum(counts.sum(axis=0), 1), -np.inf)
    return float(mean.max()), int(mean.argmax())


def pays_for_standing(setup: RaceSetup, laps: list[DrivenLap]) -> Iterator[str]:
    """Warn if a car standing for a second gets as much reward per step as one that keeps driving."""
    if not laps:
        return
    lap = laps[len(laps) // 2].paid
    probe = Probe(setup)
    standing, driving = [], []
    for place in np.linspace(0.15, 0.75, 4):
        i = max(1, int(place * (len(lap) - _HELD)))
        driving.append(probe.rewards(lap[i - 1 : i + 1 + _HELD])[2:])
        probe.rewards(lap[i - 1 : i + 1])
        standing.append(probe.rewards(_held(lap, i, setup.car.control_period_s)))
    still, moving = float(np.mean(standing)), float(np.mean(driving))
    if still >= moving - _MARGIN * max(abs(still), abs(moving)):
        yield f"pays for standing still: {still:.3g} per step, {moving:.3g} for driving"


def _held(lap: Situations, at: int, step_s: float) -> Situations:
    """Return the steps of a car that does not move after one step of a lap."""
    held = lap[np.full(_HELD, at)]
    later = np.arange(1, _HELD + 1)
    still = np.zeros(_HELD)
    return held.given(
        steps=held.columns["steps"] + later,
        sim_time=held.columns["sim_time"] + later * step_s,
        speed=still,
        steering_angle=still,
    )


def pays_for_slowness(setup: RaceSetup, laps: list[DrivenLap]) -> Iterator[str]:
    """Warn if a slow lap earns more reward in total than a fast one."""
    if not laps or laps[0].time_s < _FASTER * laps[-1].time_s:
        return
    slow, fast = (float(Probe(setup).rewards(lap.paid).sum()) for lap in (laps[0], laps[-1]))
    if slow > fast + _MARGIN * max(abs(slow), abs(fast)):
        yield (
            f"pays more for a slow lap than for a fast one: {slow:.4g} in {laps[0].time_s:.1f} s, "
            f"{fast:.4g} in {laps[-1].time_s:.1f} s"
        )


def batch_differs(setup: RaceSetup, sampled: Situations, rewards: np.ndarray) -> Iterator[str]:
    """Warn if the module's `reward_batch`, which trainings use, differs from its `reward_function`.

    Raises:
        BadInput, RewardFailed: `reward_batch` cannot be used.
    """
    batch = RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    if not batch.is_batch:
        return
    paid = batch(sampled.columns, (sampled.road,))
    wrong = np.flatnonzero(~np.isclose(paid, rewards, rtol=1e-6, atol=1e-9))
    if len(wrong):
        first = f"first {paid[wrong[0]]:.6g} instead of {rewards[wrong[0]]:.6g}"
        yield f"reward_batch, which trainings use, differs in {len(wrong)} of {len(sampled):,} situations: {first}"
