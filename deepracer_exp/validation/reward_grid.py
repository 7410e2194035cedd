"""Sample a reward function on a grid of positions, headings, speeds and steering angles."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.env.setup import RaceSetup

from .probe import Probe
from .situations import OFF_ROAD_M, middle_speed_mps, poses, sample, situations

Floats = NDArray[np.float64]
State = Literal["none", "earlier calls", "randomness"]
HEADINGS_DEG = 180.0
_PLACES, _HEADINGS, _OFFSETS, _SPEEDS, _STEERINGS = 10, 25, 25, 13, 13


Sampler = Callable[..., tuple[Floats, NDArray[np.bool_]]]
"""See `reward_sampler`."""


def reward_sampler(setup: RaceSetup, state: State) -> Sampler:
    """Return a function that returns the rewards of poses and whether they are off the track.

    It takes the arguments of `situations.poses` after the race; both results have their broadcast shape. A reward that
    depends on earlier calls is first called with the step before.
    """
    probe = Probe(setup)

    def rewards(*pose: ArrayLike) -> tuple[Floats, NDArray[np.bool_]]:
        shape = np.broadcast_shapes(*map(np.shape, pose))
        at = poses(setup, *pose)
        now = situations(setup, at)
        before = situations(setup, at, earlier=True) if state == "earlier calls" else None
        return probe.rewards(now, before).reshape(shape), now.columns["is_offtrack"].reshape(shape)

    return rewards


@dataclass(frozen=True, eq=False)
class RewardGrid:
    """Rewards at positions spread evenly over the lap."""

    speeds_mps: Floats
    """Slowest, middle and fastest of the action space, (3,)."""
    headings_rad: Floats
    """Against the centre line, (H,)."""
    offsets_m: Floats
    """To the left of the centre line, in ascending order, (W,)."""
    reward: Floats
    """By speed, position, heading and offset, (3, P, H, W)."""
    off_track: NDArray[np.bool_]
    """The same shape."""
    all_speeds_mps: Floats
    """(S,)"""
    steerings_deg: Floats
    """(T,)"""
    by_command: Floats
    """Driving along the centre line, mean over positions by speed and steering, (S, T)."""

    @property
    def along(self) -> int:
        """The index in `headings_rad` of driving along the track."""
        return len(self.headings_rad) // 2


def sample_reward_grid(setup: RaceSetup, rewards: Sampler, detail: float) -> RewardGrid:
    """Sample the rewards on a grid over the whole track; `detail` is 1, or less for slow functions."""
    low, high = setup.actions.low, setup.actions.high

    def points(n: int) -> int:
        """Return an odd number of points, so that the middle is one of them."""
        return max(5, round(n * detail)) // 2 * 2 + 1

    places = max(4, round(_PLACES * detail))
    ndist = (np.arange(places) + 0.5) / places
    speeds_mps = np.array([low[1], middle_speed_mps(setup), high[1]])
    headings_rad = np.radians(np.linspace(-HEADINGS_DEG, HEADINGS_DEG, points(_HEADINGS)))
    beyond_m = setup.track.width_m / 2 + OFF_ROAD_M
    offsets_m = np.linspace(-beyond_m, beyond_m, points(_OFFSETS))
    reward, off_track = rewards(
        ndist[:, None, None], offsets_m, headings_rad[:, None], speeds_mps[:, None, None, None]
    )
    all_speeds_mps = np.linspace(low[1], high[1], points(_SPEEDS) if high[1] > low[1] else 1)
    steerings_deg = np.linspace(low[0], high[0], points(_STEERINGS) if high[0] > low[0] else 1)
    by_command, _ = rewards(ndist[:, None, None], 0.0, 0.0, all_speeds_mps[:, None], steerings_deg)
    return RewardGrid(
        speeds_mps=speeds_mps,
        headings_rad=headings_rad,
        offsets_m=offsets_m,
        reward=reward,
        off_track=off_track,
        all_speeds_mps=all_speeds_mps,
        steerings_deg=steerings_deg,
        by_command=np.nanmean(by_command, axis=0),
    )


def state_of(setup: RaceSetup, probe: Probe, n: int = 40) -> State:
    """Find out whether a reward depends on more than the params: on earlier calls, or on randomness.

    `probe` must not have been called before; it collects the failures.
    """
    at = sample(setup, n)
    now = situations(setup, at)
    before = situations(setup, at, earlier=True)
    alone = probe.rewards(now)
    if probe.failures:
        return "none"
    again = Probe(setup)
    if not np.array_equal(alone, again.rewards(now), equal_nan=True):
        return "randomness"
    same = np.array_equal(alone, probe.rewards(now, before), equal_nan=True)
    same = same and np.array_equal(alone, again.rewards(now, now), equal_nan=True)
    return "none" if same else "earlier calls"
