"""Race protocol: laps, resets, penalties and the race clock of cars."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.env.trace_columns import EPISODE_STATUS, STATUS_CODE

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]

_LAP, _UP, _CRASH = "lap_complete", "time_up", "crashed"
_ROUNDING_S = 1e-9


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One attempted lap."""

    trial: int
    """Row of the trial in its batch."""
    begin_s: float
    """Race clock at its start."""
    time_s: float
    """Lap time, penalties included."""
    penalty_s: float
    resets: int
    progress: float
    """Per cent of the lap, 100 if complete."""
    end: str
    """`lap_complete`, the reason of its failure (`off_track`, `crashed`, `reversed`, `immobilized`), or `time_up`."""
    crashes: int = 0
    """Number of crashes into a box or bot by the car's own fault."""

    @property
    def complete(self) -> bool:
        """Whether it counts as a lap."""
        return self.end == _LAP

    @property
    def crash_free(self) -> bool:
        """Whether it counts as a lap without a crash."""
        return self.complete and not self.crashes

    @property
    def cut_off(self) -> bool:
        """Whether the end of the race interrupted the lap."""
        return self.end == _UP


class PutBack(NamedTuple):
    """Cars to put back on the track, at rest; arrays (n,)."""

    cars: Ids
    percent: Floats
    """Progress at which they continue."""
    crashed: NDArray[np.bool_]
    restarts: NDArray[np.bool_]
    """Whether they begin a new lap at its start."""
    hold_s: Floats
    """Seconds for which they are held there."""


class RaceProtocol:
    """Applies a protocol to N cars, one trial each: decides which are put back and which have finished.

    The race clock of a trial is that of `rules.lap_clock_s`, which starts with the reset before the prepare step. A car
    alone on the track continues at once, and a penalty advances its clock by its seconds; among others it is held for
    so long, while bots drive on.

    Attributes:
        running: unfinished trials, (N,), bool.
        attempts: laps attempted so far, in the order of their ends.
        clock_s: race clock at the latest poses, (N,).
    """

    def __init__(
        self, config: EvaluationConfig, closed: NDArray[np.bool_], period_s: float, among_others: bool = False
    ):
        """Start all trials.

        `closed` says whether a completed lap leads into the next one, (N,).
        """
        n_cars = len(closed)
        self._config, self._closed, self._period_s = config, closed, period_s
        self._penalty_s = vars(config.penalty_s)
        self._among_others = among_others
        self._steps = 0
        self.running = np.ones(n_cars, bool)
        self.attempts: list[Attempt] = []
        self.clock_s = np.zeros(n_cars)
        self._laps = np.zeros(n_cars, np.int64)
        self._begin_s, self._lap_penalty_s, self._all_penalties_s = (np.zeros(n_cars) for _ in range(3))
        self._resets = np.zeros(n_cars, np.int64)
        self._crashes = np.zeros(n_cars, np.int64)
        self._progress = np.zeros(n_cars)

    def step(self, status: NDArray[np.int64], progress: Floats) -> PutBack:
        """Process one control step and return the cars to put back.

        Status codes are those of `env.trace_columns.STATUS_CODE`, progress is in per cent of the lap, (N,) each.
        """
        self._steps += 1
        driven_s = lap_clock_s(self._steps, self._period_s)
        self.clock_s = np.where(self.running, driven_s + self._all_penalties_s, self.clock_s)
        late = self.running & (self.clock_s > self._config.time_s + _ROUNDING_S)
        for car in np.flatnonzero(late).tolist():
            self.clock_s[car] = self._config.time_s
            self._close(car, _UP, progress[car])
            self.running[car] = False
        back: list[_Back] = []
        over = (status > STATUS_CODE["in_progress"]) & (status != STATUS_CODE["pause"])
        for car in np.flatnonzero(self.running & over).tolist():
            self._decide(car, EPISODE_STATUS[status[car]], progress[car], back)
        # The last progress on the track: beyond its border another section may be closer.
        self._progress = np.where(status == STATUS_CODE[_LAP], 0.0, progress)
        for placed in back:
            self._progress[placed.car] = placed.percent
        columns = zip(*back, strict=True) if back else ((),) * len(_Back._fields)
        types = (np.intp, np.float64, np.bool_, np.bool_, np.float64)
        return PutBack(*(np.array(values, kind) for values, kind in zip(columns, types, strict=True)))

    def _decide(self, car: int, what: str, progress: float, back: list["_Back"]) -> None:
        config = self._config
        self._crashes[car] += what == _CRASH
        if what == _LAP:
            self._close(car, what, 100.0)
            self._laps[car] += 1
            if self._laps[car] == config.laps:
                self.running[car] = False
            elif not self._closed[car]:
                back.append(_Back(car, 0.0, restarts=True))
        elif self._resets[car] < config.resets_per_lap:
            self._resets[car] += 1
            penalty_s = self._penalty_s[what]
            self._lap_penalty_s[car] += penalty_s
            self._all_penalties_s[car] += 0.0 if self._among_others else penalty_s
            hold_s = penalty_s if self._among_others else 0.0
            back.append(_Back(car, max(0.0, self._progress[car]), what == _CRASH, hold_s=hold_s))
        else:
            self._close(car, what, progress)
            if config.failed_lap == "ends_trial":
                self.running[car] = False
            else:
                back.append(_Back(car, 0.0, restarts=True))

    def _close(self, car: int, end: str, progress: float) -> None:
        """Record the attempted lap and start the next one."""
        self.attempts.append(
            Attempt(
                trial=car,
                begin_s=float(self._begin_s[car]),
                time_s=float(self.clock_s[car] - self._begin_s[car]),
                penalty_s=float(self._lap_penalty_s[car]),
                resets=int(self._resets[car]),
                progress=float(np.clip(progress, 0.0, 100.0)),
                end=end,
                crashes=int(self._crashes[car]),
            )
        )
        self._begin_s[car] = self.clock_s[car]
        self._lap_penalty_s[car] = 0.0
        self._resets[car] = 0
        self._crashes[car] = 0


class _Back(NamedTuple):
    """One car of a `PutBack`."""

    car: int
    percent: float
    crashed: bool = False
    restarts: bool = False
    hold_s: float = 0.0
