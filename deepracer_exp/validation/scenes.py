"""The situations a reward function is tried in."""

from dataclasses import dataclass, replace

import numpy as np

from deepracer_exp.env.action_space import ContinuousActions
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.tracks.track import Track

from .situations import Poses, Situations, poses, situations

OFF_ROAD_M = 0.5
"""How far beyond the border cars are looked at: an episode ends there."""


@dataclass(frozen=True)
class Scene:
    """A situation with a name."""

    name: str
    now: Situations
    """One situation."""
    before: Situations | None
    """The one a step earlier; None where there was none."""


def middle_speed_mps(setup: RaceSetup) -> float:
    """Return the middle between the slowest and the fastest command of the action space."""
    return float(setup.actions.low[1] + setup.actions.high[1]) / 2


def scenes(setup: RaceSetup, against: Track) -> list[Scene]:
    """Return start, mid-lap, off-track, finish, wrong way, and mid-lap on the track driven in reverse.

    Args:
        setup: the track, the car and the action space.
        against: the same track in the other direction.
    """
    speed = middle_speed_mps(setup)
    track = setup.track
    # The second step is the first that is paid; the car has stood on the line in the one before.
    start = poses(setup, setup.car.front_point_m / track.length_m, 0.0, 0.0, speed, lateness=0.0)
    line = np.array([1.0 if not track.closed else 0.05 / track.length_m])
    finish = replace(poses(setup, line, 0.0, 0.0, speed), progress_before=np.array([99.5]))
    lap_steps = track.length_m / speed / setup.car.control_period_s
    finish = replace(finish, steps=np.array([2 + int(lap_steps)]))
    backwards = setup.on(against)
    return [
        Scene("start", situations(setup, start), None),
        _scene("mid-lap", setup, poses(setup, 0.5, 0.0, 0.0, speed)),
        _scene("off the track", setup, _off_track(setup, speed)),
        _scene("finish", setup, finish),
        _scene("wrong way", setup, poses(setup, 0.5, 0.0, np.pi, speed)),
        _scene("reversed track", backwards, poses(backwards, 0.5, 0.0, 0.0, speed)),
    ]


def _scene(name: str, setup: RaceSetup, at: Poses) -> Scene:
    return Scene(name, situations(setup, at), situations(setup, at, earlier=True))


def seam(setup: RaceSetup) -> Situations:
    """Return the last point of the line, where the closing waypoint is behind and its repetition ahead.

    The service gives these two indices there (`bisect_right` past the end); a car hardly ever hits that very point.
    """
    at = situations(setup, poses(setup, 0.5, 0.0, 0.0, middle_speed_mps(setup)))
    track = setup.track
    x, y = track.waypoints[-1]
    return at.given(
        x=np.array([x]),
        y=np.array([y]),
        projection_distance=np.array([track.length_m]),
        progress=np.array([99.9]),
        closest_waypoints=np.array([[len(track.waypoints) - 1, 0]]),
    )


def _off_track(setup: RaceSetup, speed_mps: float) -> Poses:
    """Return a pose with no wheel on the road, as near to the road and to the middle of the lap as can be."""
    half_m = setup.track.width_m / 2
    away_m, ndist, side = np.meshgrid(
        half_m + np.array([0.2, 0.3, 0.5, 1.0, 2.0]), 0.5 + np.arange(8) / 20, [1.0, -1.0], indexing="ij"
    )
    at = poses(setup, ndist, side * away_m, 0.0, speed_mps)
    first = int(np.argmax(situations(setup, at).columns["is_offtrack"]))
    return pick(at, np.array([first]))


def pick(at: Poses, which: np.ndarray) -> Poses:
    """Return some of the poses."""
    return Poses(**{name: values[which] for name, values in vars(at).items()})


def sample(setup: RaceSetup, n: int) -> Poses:
    """Return n poses a learning car may well get into, the same at every call: most on the road and looking ahead."""
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
