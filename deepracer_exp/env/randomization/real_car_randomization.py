"""Randomization towards the physical car: drawn for each episode of a training, complete in an evaluation."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.driving import CarRandomizationConfig
from deepracer_exp.config.evaluation import RealCarConfig
from deepracer_exp.env.real_car import AS_SIMULATED, UNCOMPRESSED, split_delay
from deepracer_exp.sim.batch import CarBatch

from .car_randomization import CarStreams, Ids, Purpose

Floats = NDArray[np.float64]

_QUALITY, _LATENCY, _LOCK, _CURVE = range(4)
_OFF = ((AS_SIMULATED, AS_SIMULATED), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
"""Ranges of the simulator's unchanged car, in the order of the draws."""


class RealCarRandomization:
    """Draws how the cars of N episodes see and act, between the simulator's car and the physical one.

    What an episode draws depends only on the seed, the car's number and the episode's number. The attributes are
    written in place.

    Attributes:
        jpeg_quality: of each car's pictures, 1 to 100, `UNCOMPRESSED` or `AS_SIMULATED`, (N,), int64.
        full_lock_deg: angle that the largest one of the action space becomes; 0: controls as simulated, (N,).
        throttle_curve: share of the physical car's throttle curve in that of each car, (N,).
        late_steps: whole control steps by which steering and speed commands arrive late, (2, N), int64.
        most_late_steps: the largest delay that can be drawn.
    """

    def __init__(
        self,
        configs: Sequence[CarRandomizationConfig | None],
        cars: Sequence[int],
        batch: CarBatch,
        fixed: RealCarConfig | None = None,
        late_steps: tuple[int, int] = (0, 0),
    ) -> None:
        """Take each car's ranges and its number over all processes; call `seed` and then `begin` next.

        The parts of `fixed` replace those of the ranges for all cars. Its timing is that of `batch` already, and of
        `late_steps`, by which all commands are late.
        """
        ranges = np.array([_ranges(config, fixed) for config in configs], np.float64)
        self._cars, self._batch = list(cars), batch
        self._low: Floats = ranges[..., 0]
        self._span: Floats = ranges[..., 1] - self._low
        self._draws = bool(self._span.any() or self._low[:, _LATENCY].any())
        # All whole numbers of a range are equally probable.
        self._span[:, _QUALITY] += self._low[:, _QUALITY] >= 1
        self.jpeg_quality = self._low[:, _QUALITY].astype(np.int64)
        self.full_lock_deg = self._low[:, _LOCK].copy()
        self.throttle_curve = self._low[:, _CURVE].copy()
        self.late_steps = np.tile(np.array(late_steps)[:, None], len(self._cars))
        self._late_for_all = np.array(late_steps)[:, None]
        self._own_s = np.array([[batch.car.steering_delay_s], [batch.car.speed_delay_s]])
        most_s = self._own_s + ranges[:, _LATENCY, 1].max()
        self.most_late_steps = int((self._late_for_all + self._split(most_s)[0]).max())

    def seed(self, seed: int) -> None:
        """Start all streams from `seed`."""
        self._streams = CarStreams(seed, self._cars, Purpose.REAL_CAR)

    def begin(self, ids: Ids, episodes: NDArray[np.int64]) -> None:
        """Draw for new episodes of the cars `ids`; episodes are numbered per car from 0."""
        if not self._draws:
            return
        # All are drawn, so that a part that is left out does not change the others.
        uniform = np.empty((len(ids), len(_OFF)))
        for row, car, episode in zip(uniform, ids.tolist(), episodes.tolist(), strict=True):
            self._streams.stream(car, episode).random(out=row)
        drawn = self._low[ids] + self._span[ids] * uniform
        self.jpeg_quality[ids] = np.floor(drawn[:, _QUALITY])
        self.full_lock_deg[ids] = drawn[:, _LOCK]
        self.throttle_curve[ids] = drawn[:, _CURVE]
        whole, rest = self._split(self._own_s + drawn[:, _LATENCY])
        self.late_steps[:, ids] = self._late_for_all + whole
        self._batch.set_delays(ids, *rest)

    def _split(self, delay_s: Floats) -> tuple[NDArray[np.int64], Floats]:
        return split_delay(delay_s, self._batch.car.control_period_s)


def _ranges(config: CarRandomizationConfig | None, fixed: RealCarConfig | None) -> Sequence[Sequence[float]]:
    """Return the ranges of a car in the order of `_OFF`."""
    ranges: list[Sequence[float]] = list(_OFF)
    if config is not None and config.picture is not None:
        ranges[_QUALITY] = config.picture.jpeg_quality
    if config is not None and config.timing is not None:
        ranges[_LATENCY] = config.timing.latency_s
    if config is not None and config.controls is not None:
        ranges[_LOCK], ranges[_CURVE] = config.controls.full_lock_deg, config.controls.throttle_curve
    if fixed is not None and fixed.picture is not None:
        ranges[_QUALITY] = [fixed.picture.jpeg_quality or UNCOMPRESSED] * 2
    if fixed is not None and fixed.timing is not None:
        ranges[_LATENCY] = [0.0, 0.0]
    if fixed is not None and fixed.controls is not None:
        ranges[_LOCK], ranges[_CURVE] = [fixed.controls.full_lock_deg] * 2, [1.0, 1.0]
    return ranges
