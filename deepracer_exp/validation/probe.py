"""Calls a reward function in one situation after the other and notes what comes of it."""

import time
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.env.reward import RewardFailed, RewardFunction
from deepracer_exp.env.reward_guard import CtrlC, Guard, Misconduct
from deepracer_exp.env.reward_source import RewardSource

from .situations import Situations

NOT_CALLED = "not called"
"""The failure of a call that was left out, since an earlier one hung."""


@dataclass(frozen=True)
class Answer:
    """What a call came to."""

    reward: float
    """NaN where it failed."""
    failure: str | None = None
    """What went wrong, and in which line."""


class Probe:
    """A reward module, loaded once as for one car.

    Attributes:
        failures: what went wrong so far, with the params it went wrong with, in the order of the calls.
        hangs: a call took longer than the time limit, or spoiled what everything uses; from then on every call counts
            as failed unasked.

    Raises:
        BadInput: The module cannot be run.
    """

    def __init__(self, source: RewardSource, time_limit_s: float):
        """Load the module.

        Args:
            source: the module.
            time_limit_s: seconds of CPU of a single call.
        """
        self._function = RewardFunction(source, 1, time_limit_s, None, scalar=True)
        self.failures: list[tuple[str, dict[str, Any]]] = []
        self.hangs = False

    def ask(self, params: dict[str, Any]) -> Answer:
        """Call the function once."""
        return self._answers([params])[-1]

    def rewards(self, asked: Situations, before: Situations | None = None) -> NDArray[np.float64]:
        """Return the reward of each situation, (n,), called in their order; NaN where the call failed.

        Args:
            asked: n situations.
            before: what the function is called with just before each of them, n situations; None: nothing.
        """
        if before is None:
            answers = self._answers(asked.params())[: len(asked)]
        else:
            both = chain.from_iterable(zip(before.params(), asked.params(), strict=True))
            answers = self._answers(both)[1 : 2 * len(asked) : 2]
        return np.array([answer.reward for answer in answers])

    def _answers(self, asked: Iterable[dict[str, Any]]) -> list[Answer]:
        """Call the function with each; behind the answers stands what only the end of all calls showed."""
        answers: list[Answer] = []
        waiting = iter(asked)
        params: dict[str, Any] = {}
        try:
            with Guard(self._function.time_limit_s) as guard:
                for params in waiting:
                    if self.hangs:
                        answers.append(Answer(float("nan"), NOT_CALLED))
                        continue
                    guard.restart()
                    try:
                        answers.append(Answer(self._function.pay(params)))
                    except RewardFailed as error:
                        self.hangs = error.hung
                        self.failures.append((error.what, error.params or {}))
                        answers.append(Answer(float("nan"), error.what))
        except Misconduct as error:
            self.hangs = True
            self.failures.append((str(error), params))
            answers.append(Answer(float("nan"), str(error)))
            answers += (Answer(float("nan"), NOT_CALLED) for _ in waiting)
        return answers

    def median_s(self, params: dict[str, Any]) -> float | None:
        """Return the median time of a call, of as many as fit into 50 ms, 3 to 1000.

        None: a function with a memory fails when it is given the same params again.
        """
        call = self._function.functions[0]
        times: list[float] = []
        given = [{**params, "waypoints": params["waypoints"][:]} for _ in range(1000)]
        try:
            with Guard(self._function.time_limit_s):
                while len(times) < 3 or (len(times) < len(given) and sum(times) < 0.05):
                    began = time.perf_counter()
                    call(given[len(times)])
                    times.append(time.perf_counter() - began)
        except CtrlC:
            raise
        except BaseException:  # noqa: BLE001 - told where the car stands still and the same happens
            return None
        return median(times)
