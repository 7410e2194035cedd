"""The LIDAR of an observation: each car's readings, in the forms of the service's three sensors."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.driving import LidarConfig
from deepracer_exp.env.randomization.car_randomization import CarStreams, Ids, Purpose
from deepracer_exp.sim.batch import CarState
from deepracer_exp.sim.lidar_rays import (
    FURTHEST_M,
    MOUNT_X_M,
    MOUNT_Z_M,
    NEAREST_M,
    RAYS,
    SCANS_PER_S,
    box_sides,
    scan,
)
from deepracer_exp.sim.scenery import wall_ring
from deepracer_exp.tracks.track import Track

_NOISE_NUMBERS = 2**16
"""Standard normal numbers that all scans share as noise: drawing new ones would take longer than the scan."""
_NEXT_SCAN = 7919
"""Offset among these numbers from one scan to the next."""

Readings = NDArray[np.float32]


class Lidar:
    """The LIDARs of N cars; each stays at its height, however the body leans, and sees walls and boxes.

    The noise of a scan depends only on the seed, the car's number, and the numbers of its episode and step.
    """

    def __init__(
        self,
        config: LidarConfig,
        tracks: Sequence[Track],
        cars: Sequence[int],
        period_s: float,
        boxes: int,
        others: int = 0,
    ) -> None:
        """Set up the walls; call `seed` and then `begin` next.

        `cars` are numbers over all processes; `boxes` stand beside the road around each car, `others` are boxes and
        bots on it.
        """
        self._config, self._cars = config, list(cars)
        rings = [None if track.floor.walls_height_m < MOUNT_Z_M else wall_ring(track) for track in tracks]
        walls = [np.empty((0, 4)) if ring is None else np.hstack([ring[:-1], ring[1:]]) for ring in rings]
        # Of each course, filled up with NaN, (courses, segments, 4).
        self._walls = np.full((len(walls), max(map(len, walls)), 4), np.nan)
        for row, some in zip(self._walls, walls, strict=True):
            row[: len(some)] = some
        self._standing = self._walls.shape[1] + 4 * boxes
        self._segments = np.empty((len(self._cars), self._standing + 4 * others, 4))
        self._scans_per_step = SCANS_PER_S * period_s
        self._noise_start = np.zeros(len(self._cars), np.int64)
        self._noise = np.random.default_rng(0).standard_normal(_NOISE_NUMBERS)

    def seed(self, seed: int) -> None:
        """Start all streams from `seed`."""
        self._streams = CarStreams(seed, self._cars, Purpose.LIDAR)

    def begin(
        self,
        ids: Ids,
        episodes: NDArray[np.int64],
        course: NDArray[np.intp],
        boxes: NDArray[np.float32] | None,
    ) -> None:
        """Draw the noise of new episodes of the cars `ids`; episodes are numbered per car from 0.

        Args:
            ids: indices of the cars, (n,).
            episodes: of these cars, (n,).
            course: index of each of these cars' track, (n,).
            boxes: around these cars, (n, boxes, 6 or more), see `camera.take_pictures`; None: there are none.
        """
        walls = self._walls[course]
        standing = walls if boxes is None else np.hstack([walls, box_sides(boxes)])
        self._segments[ids, : self._standing] = standing
        for car, episode in zip(ids.tolist(), episodes.tolist(), strict=True):
            self._noise_start[car] = self._streams.stream(car, episode).integers(_NOISE_NUMBERS)

    def show(self, ids: Ids, others: NDArray[np.float32]) -> None:
        """Set where boxes and bots on the road of the cars `ids` are, (n, others, 9), see `camera.take_pictures`."""
        self._segments[ids, self._standing :] = box_sides(others)

    def read(self, ids: Ids, state: CarState, steps: NDArray[np.int64]) -> Readings:
        """Return the readings of new scans by the cars `ids`, (n, size).

        State and control steps are those of these cars' episodes, arrays (n,).
        """
        poses = np.stack(
            [
                state.x_m + MOUNT_X_M * np.cos(state.yaw_rad),
                state.y_m + MOUNT_X_M * np.sin(state.yaw_rad),
                state.yaw_rad + np.radians(self._config.yaw_deg),
            ],
            axis=1,
        )
        distances = scan(poses, self._segments[ids])
        distances[distances > FURTHEST_M] = np.inf
        counter = self._noise_start[ids] + _NEXT_SCAN * steps
        noise = self._noise[(counter[:, None] + np.arange(RAYS)) % _NOISE_NUMBERS]
        return readings(self._config, distances + self._config.noise_m * noise)

    def next(
        self,
        before: Readings,
        state: CarState,
        steps: NDArray[np.int64],
        dropped: NDArray[np.bool_] | None,
    ) -> Readings:
        """Return the readings of all cars after `before`, (N, size): of a new scan, or the same until there is one.

        Args:
            before: readings of the step before, (N, size).
            state: arrays (N,).
            steps: control steps of each car's episode, (N,).
            dropped: cars that see nothing new, (N,); None: there are none.
        """
        # At 15 Hz a step is 2/3 of a scan; the margin is for rounding.
        scans = np.floor(self._scans_per_step * np.stack([steps, steps - 1]) + 1e-6)
        same = scans[0] == scans[1]
        if dropped is not None:
            same |= dropped
        now = self.read(np.arange(len(before)), state, steps)
        return np.where(same[:, None], before, now)


def readings(config: LidarConfig, distances_m: NDArray[np.float64]) -> Readings:
    """Return scans (n, RAYS) as the policy sees them, (n, size).

    `plain`: the distances, clipped. Otherwise one-hot for each sector: which of `values_per_sector` equal steps up to
    the furthest distance the nearest thing is in; all 0 where there is nothing nearer than that (deepracer-simapp,
    `bundle/markov/filters/observation/observation_sector_discretize_filter.py`).
    """
    furthest_m = config.furthest_m
    clipped = np.clip(distances_m, NEAREST_M, furthest_m)
    if config.kind == "plain":
        return clipped.astype(np.float32)
    sectors, values = config.sector_shape
    nearest = clipped.reshape(len(clipped), sectors, -1).min(axis=2)
    step = np.where(nearest < furthest_m, np.floor(nearest * (values / furthest_m)), values)
    seen: Readings = (step[..., None] == np.arange(values)).astype(np.float32)
    return seen.reshape(len(seen), -1)


def reach_of_rays(config: LidarConfig, seen: Readings) -> NDArray[np.float64]:
    """Return the range of each ray in metres, (n, RAYS), from readings (n, size); NaN: no hit.

    In a sector, it is the far end of the step that holds the nearest hit.
    """
    furthest_m = config.furthest_m
    if config.kind == "plain":
        return np.where(seen < furthest_m, seen, np.nan).astype(np.float64)
    sectors, values = config.sector_shape
    steps = seen.reshape(len(seen), sectors, values)
    ends_m = np.where(steps.any(axis=2), (steps.argmax(axis=2) + 1) * (furthest_m / values), np.nan)
    return np.repeat(ends_m, RAYS // sectors, axis=1)
