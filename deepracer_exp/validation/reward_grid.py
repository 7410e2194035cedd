"""Sample a reward function over the track, and by offset, heading, speed and steering angle."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.tracks.track import Track

from .probe import Probe
from .situations import OFF_ROAD_M, middle_speed_mps, poses, sample, situations

Floats = NDArray[np.float64]
State = Literal["none", "earlier calls", "randomness"]
HEADINGS_DEG = 180.0
_PLACES, _HEADINGS, _OFFSETS, _SPEEDS, _STEERINGS = 10, 25, 25, 13, 13
BESIDE_M = 0.3
"""Width of the ground shown beside the track."""
_PIXELS = 16_000
"""Points of the track sampled at detail 1."""


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
    pixels: Floats
    """Driving along the track at middle speed, at points on and beside it, (Y, X); NaN elsewhere."""
    extent: tuple[float, float, float, float]
    """Left, right, lower and upper end of the pixels, m."""

    @property
    def along(self) -> int:
        """The index in `headings_rad` of driving along the track."""
        return len(self.headings_rad) // 2


def sample_reward_grid(setup: RaceSetup, state: State, detail: float) -> RewardGrid:
    """Sample the rewards over the whole track; `detail` is 1, or less for slow functions.

    A reward that depends on earlier calls is first called with the step before.
    """
    probe = Probe(setup)
    low, high = setup.actions.low, setup.actions.high

    def rewards(*pose: ArrayLike) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the rewards of `situations.poses` and whether they are off the track, both of their shape."""
        shape = np.broadcast_shapes(*map(np.shape, pose))
        at = poses(setup, *pose)
        now = situations(setup, at)
        before = situations(setup, at, earlier=True) if state == "earlier calls" else None
        return probe.rewards(now, before).reshape(shape), now.columns["is_offtrack"].reshape(shape)

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

    track = setup.track
    (left, lower), (right, upper) = map_corners(track)
    cell_m = float(np.sqrt(track.road.buffer(BESIDE_M).area / (_PIXELS * detail**2)))
    x, y = (np.arange(a, b, cell_m) + cell_m / 2 for a, b in ((left, right), (lower, upper)))
    grid_x, grid_y = np.meshgrid(x, y)
    near = shapely.contains_xy(track.road.buffer(BESIDE_M + 1.5 * cell_m), grid_x, grid_y)
    place = track.project(np.column_stack([grid_x[near], grid_y[near]]))
    pixels = np.full(grid_x.shape, np.nan)
    pixels[near], _ = rewards(place.ndist, place.offset_m, 0.0, middle_speed_mps(setup))
    half_m = cell_m / 2
    return RewardGrid(
        speeds_mps=speeds_mps,
        headings_rad=headings_rad,
        offsets_m=offsets_m,
        reward=reward,
        off_track=off_track,
        all_speeds_mps=all_speeds_mps,
        steerings_deg=steerings_deg,
        by_command=np.nanmean(by_command, axis=0),
        pixels=pixels,
        extent=(x[0] - half_m, x[-1] + half_m, y[0] - half_m, y[-1] + half_m),
    )


def map_corners(track: Track) -> tuple[Floats, Floats]:
    """Return the lower left and the upper right corner of the map, m."""
    borders = np.concatenate([track.inner, track.outer])
    return borders.min(axis=0) - BESIDE_M - 0.1, borders.max(axis=0) + BESIDE_M + 0.1


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
