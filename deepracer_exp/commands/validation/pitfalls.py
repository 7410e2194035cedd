"""Warn of common mistakes in reward functions that run without an error; some are measured on driven laps."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.rewards.reward import RewardFunction

from .objects import QUIRKS, Floats, all_at
from .probe import Probe
from .reward_map import RewardGrid
from .simple_driver import DrivenLap
from .situations import Situations, near_the_start, quirky, sample, situations

_QUIRKY = 150
"""Situations in which the service's params are compared with the documented ones, at three places of the others."""
_HELD = 15
"""Steps without moving after which the service ends the episode."""
_FASTER = 1.1
"""Two laps are compared only if one is faster than the other by this factor."""
_MARGIN = 0.01
"""Rewards closer than this, relative, count as equal."""
_LAP_MARGIN = 0.02
"""Margin for returns of laps, whose lines are not quite the same."""
_ASKS = 0.2
"""Elasticity of the return to time saved, below which speed counts little; that of a race score is 1."""


def constant_reward(rewards: np.ndarray) -> Iterator[str]:
    """Warn of a constant reward; `rewards` (n,) come from very different situations."""
    if np.ptp(rewards) <= 1e-9 * max(1.0, float(np.abs(rewards).max())):
        yield f"always returns {rewards[0]:.3g}, whatever the car does: there is nothing to learn"


def pays_off_the_road(of: RewardGrid) -> Iterator[str]:
    """Warn if driving beside the track returns as much as driving on it, at medium speed."""
    reward, off = of.reward[1, :, of.along], of.off_track[1, :, of.along]
    on_road, off_road = _best_by_offset(reward, ~off), _best_by_offset(reward, off)
    if on_road is None or off_road is None:
        return
    (on, _), (beyond, place) = on_road, off_road
    margin = _MARGIN * max(abs(on), abs(beyond))
    if beyond >= on - margin:
        than = "more off the track than" if beyond > on + margin else "as much off the track as"
        side = "left" if of.offsets_m[place] > 0 else "right"
        where = f"{abs(of.offsets_m[place]):.2f} m {side} of the centre line"
        yield f"returns {than} on it: {beyond:.3g} per step {where}, at best {on:.3g} on the track"


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
        yield f"rewards standing still: {still:.3g} per step, {moving:.3g} for driving"


def _held(lap: Situations, row: int, step_s: float) -> Situations:
    """Return the steps of a car that does not move after one step of a lap."""
    held = lap[np.full(_HELD, row)]
    later = np.arange(1, _HELD + 1)
    still = np.zeros(_HELD)
    return held.with_columns(
        steps=held.columns["steps"] + later,
        sim_time=held.columns["sim_time"] + later * step_s,
        speed=still,
        steering_angle=still,
    )


@dataclass(frozen=True)
class LapReturn:
    """The sum of rewards for a driven lap."""

    time_s: float
    total: float
    """Sum of the rewards."""
    discounted: float
    """Sum of the rewards, each discounted from the start of the lap."""


def lap_returns(setup: RaceSetup, laps: Sequence[DrivenLap], discount: float) -> list[LapReturn]:
    """Return the sums of the rewards of each lap; `discount` is the experiment's, per control step."""
    returns = []
    for lap in laps:
        rewards = Probe(setup).rewards(lap.paid)
        discounted = float(rewards @ discount ** np.arange(len(rewards)))
        returns.append(LapReturn(lap.time_s, float(rewards.sum()), discounted))
    return returns


def flaws_return_more(good: LapReturn, flawed: Mapping[str, LapReturn]) -> Iterator[str]:
    """Warn of laps with a flaw, by its name, that return more than the good lap, which is no slower."""
    better = {name: lap for name, lap in flawed.items() if _grows(good.total, lap.total)}
    if better:
        laps = ", ".join(
            f"{name} ({lap.total:.4g} in {lap.time_s:.1f} s"
            f"{'' if _grows(good.discounted, lap.discounted) else '; not with the discount'})"
            for name, lap in better.items()
        )
        yield (
            f"returns more for a lap with a flaw than for a good one ({good.total:.4g} in {good.time_s:.1f} s): {laps}"
        )


def _grows(before: float, after: float) -> bool:
    return after > before + _LAP_MARGIN * max(abs(before), abs(after))


def slow_laps_return_as_much(laps: Sequence[LapReturn], discount: float) -> Iterator[str]:
    """Warn if a slower lap returns more than the fastest, or the fastest hardly more.

    Speed counts little where the return grows by less than `_ASKS` of the share of the time that is saved; a race
    score grows by all of it, so such a policy gives up speed for safety that no race rewards. Of several slower laps
    the one that returns most is compared, or the slowest if none returns more than the fastest.
    """
    fast = min(laps, key=lambda lap: lap.time_s, default=None)
    slower = [lap for lap in laps if fast is not None and lap.time_s >= _FASTER * fast.time_s]
    if fast is None or not slower:
        return

    def gain(slow: LapReturn) -> float:
        """Return the elasticity of the return to time saved: its relative growth per relative saving."""
        scale = max(abs(slow.total), abs(fast.total), 1e-9)
        return (fast.total - slow.total) / scale / (1 - fast.time_s / slow.time_s)

    slow = max(slower, key=lambda lap: lap.total)
    if not _grows(fast.total, slow.total):
        slow = max(slower, key=lambda lap: lap.time_s)
    if gain(slow) >= _ASKS:
        return
    by_discount = f"({discount:g} a step: {slow.discounted:.4g} against {fast.discounted:.4g})"
    helps = discount < 1 and _grows(slow.discounted, fast.discounted)
    if _grows(fast.total, slow.total):
        discounted = "only the discount asks for speed" if helps else "the discount does not make up for it"
        yield (
            f"returns more for a slow lap than for a fast one: {slow.total:.4g} in {slow.time_s:.1f} s, "
            f"{fast.total:.4g} in {fast.time_s:.1f} s; {discounted} {by_discount}"
        )
        return
    asks = "little asks" if _grows(slow.total, fast.total) else "nothing asks"
    yield (
        f"a lap in {slow.time_s:.1f} s returns {slow.total:.4g}, one in {fast.time_s:.1f} s {fast.total:.4g}: "
        f"{asks} for speed{' except the discount' if helps else ', and the discount does not either'} {by_discount}"
    )


def batch_differs(setup: RaceSetup, n: int) -> Iterator[str]:
    """Warn if the module's `reward_batch`, which trainings use, differs from its `reward_function` in n situations.

    `reward_function` gets the step before each of them first: it may remember params that `reward_batch` gets.

    Raises:
        BadInput, RewardFailed: `reward_batch` cannot be used.
    """
    batch = RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    if not batch.is_batch:
        return
    places = sample(setup, n)
    before = situations(setup, places, earlier=True)
    now = situations(setup, places).with_columns(previous_progress=before.columns["progress"])
    paid, rewards = batch(now.columns, (now.road,)), Probe(setup).rewards(now, before)
    wrong = np.flatnonzero(~np.isclose(paid, rewards, rtol=1e-6, atol=1e-9))
    if len(wrong):
        first = f"first {paid[wrong[0]]:.6g} instead of {rewards[wrong[0]]:.6g}"
        yield f"reward_batch, which trainings use, differs in {len(wrong)} of {n:,} situations: {first}"


def mistakes_with_objects(setup: RaceSetup) -> list[str]:
    """Warn of misread params about boxes and bots."""
    text = setup.reward.text
    pairs = [tuple(float(Probe(setup).rewards(now)[0]) for now in pair) for pair in near_the_start(setup)]
    near_start, elsewhere = zip(*pairs, strict=True)
    rewards: dict[str, list[tuple[Floats, Floats]]] = {}
    for part in range(3):
        # At other places of the lap: a bot on a straight along the x axis has the same heading in every unit.
        placed = all_at(setup, part / 3 * setup.track.length_m)
        # Bots before boxes, so that they are the next ones mostly.
        placement = replace(placed, places_m=placed.places_m[::-1].copy())
        for key, (documented, service) in quirky(setup, sample(setup, _QUIRKY), placement).items():
            if key in text:
                paid = (Probe(setup).rewards(documented), Probe(setup).rewards(service))
                rewards.setdefault(key, []).append(paid)
    joined = {
        key: (
            np.concatenate([documented for documented, _ in parts]),
            np.concatenate([service for _, service in parts]),
        )
        for key, parts in rewards.items()
    }
    return [*distance_is_relative(near_start, elsewhere), *service_differs(joined)]


def service_differs(rewards_by_key: dict[str, tuple[Floats, Floats]]) -> Iterator[str]:
    """Warn of params about others on which the reward depends and that the service gets wrong.

    `rewards_by_key` has for each key of `QUIRKS` the rewards of the same situations with the documented values and with
    the service's, (n,) each.
    """
    for key, (documented, service) in rewards_by_key.items():
        wrong = int((~np.isclose(documented, service, rtol=1e-6, atol=1e-9)).sum())
        if wrong:
            yield (
                f"{key} decides in {wrong:,} of {len(documented):,} situations, and the service gets it wrong: "
                f"{QUIRKS[key]} (race.quirks=service does the same)"
            )


def distance_is_relative(near_start: Sequence[float], elsewhere: Sequence[float]) -> Iterator[str]:
    """Warn if an object half a lap away counts as near because it is near the start line.

    Both are rewards of a car in the middle of the lap: with an object just after the start line, and with one 3 m
    further, in the same lane.
    """
    for near, far in zip(near_start, elsewhere, strict=True):
        if abs(near - far) > 0.1 * max(abs(near), abs(far)):
            yield (
                f"takes objects_distance as the distance from the car: with an object just after the start line, half "
                f"a lap away, it returns {near:.3g}, with one 3 m further {far:.3g}; objects_distance is counted from "
                "waypoint 0: compare it with projection_distance"
            )
            return
