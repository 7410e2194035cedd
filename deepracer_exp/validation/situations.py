"""Situations a car can be in, as the params that our environment makes of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.env.params import COLUMNS, Road, rows, scalar_params, select
from deepracer_exp.env.referee import Referee
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.sim.batch import CarState

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Situations:
    """Params of n situations on one road."""

    columns: dict[str, np.ndarray]
    """`env.params.COLUMNS`, each (n,), `closest_waypoints` (n, 2)."""
    road: Road

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.columns["x"])

    def params(self) -> Iterator[dict[str, Any]]:
        """Return the params of each situation, made anew."""
        for row in rows(select(self.columns, np.arange(len(self)))):
            yield scalar_params(row, *self.road)

    def __getitem__(self, which: slice | np.ndarray) -> "Situations":
        """Return some of them."""
        return Situations({key: column[which] for key, column in self.columns.items()}, self.road)

    def given(self, **columns: np.ndarray) -> "Situations":
        """Return the same situations with some columns replaced."""
        return Situations({**self.columns, **columns}, self.road)


def together(parts: "list[Situations]") -> Situations:
    """Join situations of one road."""
    columns = {key: np.concatenate([part.columns[key] for part in parts]) for key in COLUMNS}
    return Situations(columns, parts[0].road)


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses:
    """Where cars are along a road and what they are doing; all (n,)."""

    ndist: Floats
    """Share of the lap."""
    offset_m: Floats
    """Front point to the left of the centre line."""
    heading_error_rad: Floats
    """Against the centre line, positive to the left."""
    speed_mps: Floats
    """Commanded."""
    steering_deg: Floats
    """Commanded, positive to the left."""
    steps: NDArray[np.int64]
    progress_before: Floats
    """Per cent at the step before."""


def poses(
    setup: RaceSetup,
    ndist: ArrayLike,
    offset_m: ArrayLike,
    heading_error_rad: ArrayLike,
    speed_mps: ArrayLike,
    steering_deg: ArrayLike = 0.0,
    *,
    lateness: ArrayLike = 1.0,
) -> Poses:
    """Return poses with the steps it takes to come there.

    Args:
        setup: the track and the car.
        ndist: see `Poses`; all arguments are broadcast together.
        offset_m: see `Poses`.
        heading_error_rad: see `Poses`.
        speed_mps: see `Poses`.
        steering_deg: see `Poses`.
        lateness: steps taken so far over those of a lap at the commanded speed.
    """
    values = np.broadcast_arrays(ndist, offset_m, heading_error_rad, speed_mps, steering_deg, lateness)
    ndist_, offset_m_, error_rad, speed, steering, late = (np.array(v, np.float64).ravel() for v in values)
    driven_m = ndist_ * setup.track.length_m
    steps = driven_m / np.maximum(speed, 0.1) / setup.car.control_period_s * late
    return Poses(
        ndist=ndist_,
        offset_m=offset_m_,
        heading_error_rad=error_rad,
        speed_mps=speed,
        steering_deg=steering,
        # The prepare step is the first, the function is called from the second on.
        steps=2 + steps.astype(np.int64),
        progress_before=100.0 * ndist_,
    )


def situations(setup: RaceSetup, at: Poses, earlier: bool = False) -> Situations:
    """Let the environment's referee say what it makes of the poses.

    Args:
        setup: the experiment's race.
        at: n poses.
        earlier: one step before, as cars were that drove straight on at the commanded speed.
    """
    n = len(at.ndist)
    place = setup.track.start_pose(at.ndist)
    yaw_rad = place.yaw_rad + at.heading_error_rad
    behind_m = setup.car.front_point_m + at.speed_mps * setup.car.control_period_s * earlier
    still = np.zeros(n)
    cars = CarState(
        x_m=place.x - at.offset_m * np.sin(place.yaw_rad) - behind_m * np.cos(yaw_rad),
        y_m=place.y + at.offset_m * np.cos(place.yaw_rad) - behind_m * np.sin(yaw_rad),
        yaw_rad=np.mod(yaw_rad + np.pi, 2 * np.pi) - np.pi,
        speed_mps=at.speed_mps,
        lateral_mps=still,
        yaw_rate_radps=still,
    )
    steps_before = np.maximum(at.steps - 1 - earlier, 0)
    referee = Referee(setup, n)
    referee.reset(start_ndist=still)
    referee.see(cars)
    referee.resume(steps_before, at.progress_before)
    referee.clock_steps[:] = steps_before
    columns = referee.params(referee.judge(), at.steering_deg, at.speed_mps)
    return Situations(columns, referee.roads[0])
