"""What a reward function pays, asked all over the track."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.env.setup import RaceSetup

from .probe import Probe
from .scenes import OFF_ROAD_M, middle_speed_mps, sample
from .situations import poses, situations

Floats = NDArray[np.float64]
Memory = Literal["none", "earlier calls", "chance"]
HEADINGS_DEG = 180.0
_PLACES, _HEADINGS, _OFFSETS, _SPEEDS, _STEERINGS = 10, 25, 25, 13, 13


class Surveyor:
    """Asks one module about poses; a function that remembers is told first where the car was a step before."""

    def __init__(self, setup: RaceSetup, memory: Memory):
        """Load the module of `setup`."""
        self._setup = setup
        self._remembers = memory == "earlier calls"
        self._probe = Probe(setup.reward, setup.reward_time_limit_s)

    def ask(
        self,
        ndist: ArrayLike,
        offset_m: ArrayLike,
        heading_error_rad: ArrayLike,
        speed_mps: ArrayLike,
        steering_deg: ArrayLike = 0.0,
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the reward at poses (see `situations.poses`) and whether they are off the track.

        Both have the shape the arguments have when broadcast together.
        """
        shape = np.broadcast_shapes(
            *(np.shape(v) for v in (ndist, offset_m, heading_error_rad, speed_mps, steering_deg))
        )
        at = poses(self._setup, ndist, offset_m, heading_error_rad, speed_mps, steering_deg)
        now = situations(self._setup, at)
        before = situations(self._setup, at, earlier=True) if self._remembers else None
        rewards = self._probe.rewards(now, before)
        return rewards.reshape(shape), now.columns["is_offtrack"].reshape(shape)


@dataclass(frozen=True, eq=False)
class Survey:
    """Rewards at places spread evenly over the lap."""

    speeds_mps: Floats
    """Slowest, middle and fastest of the action space, (3,)."""
    headings_rad: Floats
    """Against the centre line, (H,)."""
    offsets_m: Floats
    """To the left of the centre line, (W,)."""
    reward: Floats
    """By speed, place, heading and offset, (3, P, H, W)."""
    off_track: NDArray[np.bool_]
    """The same shape."""
    all_speeds_mps: Floats
    """(S,)"""
    steerings_deg: Floats
    """(T,)"""
    by_command: Floats
    """On the centre line and along it, mean of the places by speed and steering, (S, T)."""

    @property
    def along(self) -> int:
        """The place in `headings_rad` of driving along the road."""
        return len(self.headings_rad) // 2


def survey(setup: RaceSetup, surveyor: Surveyor, detail: float) -> Survey:
    """Ask all over the track.

    Args:
        setup: the experiment's race.
        surveyor: whom to ask.
        detail: 1, or less for functions that take long.
    """
    low, high = setup.actions.low, setup.actions.high

    def points(n: int) -> int:
        """Return an odd number of points, so that the middle is one of them."""
        return max(5, round(n * detail)) // 2 * 2 + 1

    ndist = (np.arange(max(4, round(_PLACES * detail))) + 0.5) / max(4, round(_PLACES * detail))
    speeds_mps = np.array([low[1], middle_speed_mps(setup), high[1]])
    headings_rad = np.radians(np.linspace(-HEADINGS_DEG, HEADINGS_DEG, points(_HEADINGS)))
    beyond_m = setup.track.width_m / 2 + OFF_ROAD_M
    offsets_m = np.linspace(-beyond_m, beyond_m, points(_OFFSETS))
    reward, off_track = surveyor.ask(
        ndist[:, None, None], offsets_m, headings_rad[:, None], speeds_mps[:, None, None, None]
    )
    all_speeds_mps = np.linspace(low[1], high[1], points(_SPEEDS) if high[1] > low[1] else 1)
    steerings_deg = np.linspace(low[0], high[0], points(_STEERINGS) if high[0] > low[0] else 1)
    by_command, _ = surveyor.ask(ndist[:, None, None], 0.0, 0.0, all_speeds_mps[:, None], steerings_deg)
    return Survey(
        speeds_mps=speeds_mps,
        headings_rad=headings_rad,
        offsets_m=offsets_m,
        reward=reward,
        off_track=off_track,
        all_speeds_mps=all_speeds_mps,
        steerings_deg=steerings_deg,
        by_command=np.nanmean(by_command, axis=0),
    )


def memory_of(setup: RaceSetup, probe: Probe, n: int = 40) -> Memory:
    """Find out whether a reward depends on more than the params: on earlier calls, or on chance.

    Args:
        setup: the experiment's race.
        probe: a module that was not called before; failures stand in it afterwards.
        n: how many situations to look at.
    """
    at = sample(setup, n)
    now = situations(setup, at)
    before = situations(setup, at, earlier=True)
    alone = probe.rewards(now)
    if probe.failures:
        return "none"
    again = Probe(setup.reward, setup.reward_time_limit_s)
    if not np.array_equal(alone, again.rewards(now), equal_nan=True):
        return "chance"
    same = np.array_equal(alone, probe.rewards(now, before), equal_nan=True)
    same = same and np.array_equal(alone, again.rewards(now, now), equal_nan=True)
    return "none" if same else "earlier calls"
