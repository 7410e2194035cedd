"""What often goes wrong with reward functions that run without an error."""

from collections.abc import Iterator

import numpy as np

from deepracer_exp.env.reward import RewardFunction
from deepracer_exp.env.setup import RaceSetup

from .laps import Lap
from .probe import Probe
from .situations import Situations, together
from .survey import Survey

_HELD = 15
"""Steps a car stands before the service ends the episode."""
_FASTER = 1.1
"""Two laps are compared only where one is faster than the other by this factor."""
_MARGIN = 0.01
"""Pays closer than this, relative, count as the same."""


def constant_reward(rewards: np.ndarray) -> Iterator[str]:
    """Warn of a function that pays the same whatever happens; `rewards` (n,) of very different situations."""
    known = rewards[np.isfinite(rewards)]
    if len(known) and np.ptp(known) <= 1e-9 * max(1.0, float(np.abs(known).max())):
        yield f"pays {known[0]:.3g} whatever the car does: there is nothing to learn"


def pays_off_the_road(of: Survey) -> Iterator[str]:
    """Warn where driving along beside the road pays as much as on it, at a middle speed."""
    reward, off = of.reward[1, :, of.along], of.off_track[1, :, of.along]
    on_road, off_road = _best_by_offset(reward, ~off), _best_by_offset(reward, off)
    if on_road is None or off_road is None:
        return
    (on, _), (beyond, at) = on_road, off_road
    margin = _MARGIN * max(abs(on), abs(beyond))
    if beyond >= on - margin:
        than = "more off the road than" if beyond > on + margin else "as much off the road as"
        side = "left" if of.offsets_m[at] > 0 else "right"
        where = f"{abs(of.offsets_m[at]):.2f} m {side} of the centre line"
        yield f"pays {than} on it: {beyond:.3g} a step {where}, at best {on:.3g} on the road"


def _best_by_offset(reward: np.ndarray, counts: np.ndarray) -> tuple[float, int] | None:
    """Return the highest mean over places, and the offset it is at, of rewards (P, W) that count."""
    counts = counts & np.isfinite(reward)
    enough = counts.sum(axis=0) >= max(1, len(reward) // 2)
    if not enough.any():
        return None
    total = np.where(counts, reward, 0.0).sum(axis=0)
    mean = np.where(enough, total / np.maximum(counts.sum(axis=0), 1), -np.inf)
    return float(mean.max()), int(mean.argmax())


def pays_for_standing(setup: RaceSetup, laps: list[Lap]) -> Iterator[str]:
    """Warn where a car that stands for a second gets as much a step as one that drives on."""
    if not laps:
        return
    lap = laps[len(laps) // 2].paid
    probe = Probe(setup.reward, setup.reward_time_limit_s)
    standing, driving = [], []
    for place in np.linspace(0.15, 0.75, 4):
        i = max(1, int(place * (len(lap) - _HELD)))
        driving.append(probe.rewards(lap[i - 1 : i + 1 + _HELD])[2:])
        probe.rewards(lap[i - 1 : i + 1])
        standing.append(probe.rewards(_held(lap[i : i + 1], setup.car.control_period_s)))
    still, moving = float(np.mean(standing)), float(np.mean(driving))
    if still >= moving - _MARGIN * max(abs(still), abs(moving)):
        yield f"pays for standing still: {still:.3g} a step, {moving:.3g} for driving on"


def _held(at: Situations, step_s: float) -> Situations:
    """Return the steps that follow when the car does not move."""
    held = together([at] * _HELD)
    later = np.arange(1, _HELD + 1)
    still = np.zeros(_HELD)
    return held.given(
        steps=held.columns["steps"] + later,
        sim_time=held.columns["sim_time"] + later * step_s,
        speed=still,
        steering_angle=still,
    )


def pays_for_slowness(setup: RaceSetup, laps: list[Lap]) -> Iterator[str]:
    """Warn where a slow lap is paid more in all than a fast one."""
    if not laps or laps[0].time_s < _FASTER * laps[-1].time_s:
        return
    slow, fast = (
        float(Probe(setup.reward, setup.reward_time_limit_s).rewards(lap.paid).sum())
        for lap in (laps[0], laps[-1])
    )
    if slow > fast + _MARGIN * max(abs(slow), abs(fast)):
        yield (
            f"pays more for a slow lap than for a fast one: {slow:.4g} in {laps[0].time_s:.1f} s, "
            f"{fast:.4g} in {laps[-1].time_s:.1f} s"
        )


def batch_differs(setup: RaceSetup, asked: Situations, rewards: np.ndarray) -> Iterator[str]:
    """Warn where the module's `reward_batch`, which trainings use, is not what `reward_function` pays.

    Args:
        setup: the experiment's race.
        asked: n situations.
        rewards: what `reward_function` paid, (n,).

    Raises:
        BadInput, RewardFailed: `reward_batch` cannot be used.
    """
    batch = RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    if not batch.is_batch:
        return
    paid = batch(asked.columns, (asked.road,))
    wrong = np.flatnonzero(~np.isclose(paid, rewards, rtol=1e-6, atol=1e-9))
    if len(wrong):
        first = f"first {paid[wrong[0]]:.6g} for {rewards[wrong[0]]:.6g}"
        yield f"reward_batch, which trainings use, pays otherwise in {len(wrong)} of {len(asked):,}: {first}"
