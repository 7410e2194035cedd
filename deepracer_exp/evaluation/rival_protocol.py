"""Races of two cars under a protocol: the rival's laps and penalties, and who wins."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.env.others.head_to_head import HeadToHead
from deepracer_exp.env.trace_columns import PACKED

from .race_protocol import Attempt, RaceProtocol

WON, DRAWN, LOST = 1.0, 0.5, 0.0
_ENDLESS = 10**9


class RivalProtocol:
    """Applies a protocol to the rivals of N cars, and compares them with the cars.

    A rival has the penalties of the protocol, but its laps never fail and its race lasts until the car's is over.
    """

    def __init__(self, config: EvaluationConfig, closed: NDArray[np.bool_], period_s: float):
        """Start all races; arguments as for `RaceProtocol`."""
        endless = replace(config, laps=None, time_s=_ENDLESS, resets_per_lap=_ENDLESS)
        self._protocol = RaceProtocol(endless, closed, period_s, among_others=True)
        self._laps = config.laps
        self._driven = np.zeros(len(closed))

    def step(self, race: HeadToHead, running: NDArray[np.bool_]) -> None:
        """Process one control step of the rivals, and put back those that have to be.

        Args:
            race: the cars and their rivals.
            running: cars whose race is not over, (N,).
        """
        row = race.rival.trace
        status, progress = row[:, PACKED["episode_status"]].astype(np.int64), row[:, PACKED["progress"]]
        back = self._protocol.step(status, progress)
        if len(back.cars):
            race.put_rivals_back(*back)
        complete = np.bincount([attempt.trial for attempt in self._protocol.attempts], minlength=len(running))
        self._driven = np.where(running, complete + np.clip(progress, 0, None) % 100 / 100, self._driven)

    def results(self, cars: RaceProtocol) -> tuple[float, ...]:
        """Return for each car whether it has won against its rival: `WON`, `DRAWN` or `LOST`.

        The car that finishes the laps first wins. If the time is up before, the car with more progress wins; a car
        whose last lap has failed has lost.
        """
        results = []
        for trial in range(len(self._driven)):
            mine = [attempt for attempt in cars.attempts if attempt.trial == trial]
            theirs = [attempt for attempt in self._protocol.attempts if attempt.trial == trial]
            finish_s, rival_s = self._finish_s(mine), self._finish_s(theirs)
            if min(finish_s, rival_s) < math.inf:
                results.append(_compare(-finish_s, -rival_s))
            elif mine[-1].cut_off:
                driven = sum(a.complete for a in mine) + (not mine[-1].complete) * mine[-1].progress / 100
                results.append(_compare(driven, float(self._driven[trial])))
            else:
                results.append(LOST)
        return tuple(results)

    def _finish_s(self, attempts: list[Attempt]) -> float:
        """Return the race clock at the end of the last lap; infinity if that was not completed."""
        complete = [attempt for attempt in attempts if attempt.complete]
        if self._laps is None or len(complete) < self._laps:
            return math.inf
        last = complete[self._laps - 1]
        return last.begin_s + last.time_s


def _compare(mine: float, theirs: float) -> float:
    """Return the result of a race that the larger number wins, from the view of `mine`."""
    return DRAWN if mine == theirs else WON if mine > theirs else LOST
