"""Call a reward function in one situation after another, recording rewards and failures."""

import ast
import operator
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.rewards.reward import Failure, RewardFunction

from .situations import FIRST_STEP, Situations, start

NOT_CALLED = "not called"
"""The failure of a call that was skipped because an earlier one hung."""


@dataclass(frozen=True)
class Answer:
    """Result of a call."""

    reward: float
    """NaN where it failed."""
    failure: str | None = None
    """Error message with its line number."""


class Probe:
    """A reward module loaded for one car, whose first call is that at the start of an episode.

    Attributes:
        start: the answer at the start.
        calls: number of calls made since.
        failures: error messages and the params that caused them, in the order of these calls.
        without_line: the error messages of all calls without a line, which a bad return value causes.
        hangs: a call exceeded the time limit; every later call counts as failed without being made.

    Raises:
        BadInput: the module cannot be loaded.
    """

    def __init__(self, setup: RaceSetup, first_step: int = FIRST_STEP):
        """Load the module of a race and call it at the start, where functions with a memory set themselves up.

        `first_step` is the `steps` of that call.
        """
        self._function = RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None, scalar=True)
        self.hangs = False
        self.without_line: set[str] = set()
        self._forget()
        first = start(setup)
        steps = np.full_like(first.columns["steps"], first_step)
        self.start = self.call(next(first.with_columns(steps=steps).params()))
        self._forget()

    def _forget(self) -> None:
        self.calls = 0
        self.failures: list[tuple[str, dict[str, Any]]] = []

    def call(self, params: dict[str, Any]) -> Answer:
        """Call the function once."""
        return self._answers([params])[-1]

    def rewards(self, situations: Situations, before: Situations | None = None) -> NDArray[np.float64]:
        """Return the reward of each situation in order, (n,); NaN where the call failed.

        Each of the n situations `before` is passed to the function just before its counterpart.
        """
        if before is None:
            answers = self._answers(situations.params())
        else:
            both = chain.from_iterable(zip(before.params(), situations.params(), strict=True))
            answers = self._answers(both)[1::2]
        return np.array([answer.reward for answer in answers])

    def _answers(self, calls: Iterable[dict[str, Any]]) -> list[Answer]:
        """Call the function with each params."""
        waiting = iter(calls)
        answers = [] if self.hangs else [self._answer(answer) for answer in self._until_it_hangs(waiting)]
        return [*answers, *(Answer(float("nan"), NOT_CALLED) for _ in waiting)]

    def _until_it_hangs(self, calls: Iterator[dict[str, Any]]) -> Iterator[float | Failure]:
        for answer in self._function.answers(calls):
            yield answer
            if self.hangs:
                return

    def _answer(self, answer: float | Failure) -> Answer:
        """Count a call, and keep the reason of its failure."""
        self.calls += 1
        if not isinstance(answer, Failure):
            return Answer(answer)
        self.hangs = answer.hung
        self.without_line |= {answer.what} if answer.returned else set()
        self.failures.append((answer.what, answer.params))
        return Answer(float("nan"), answer.what)


_COMPARISONS: dict[type[ast.cmpop], Callable[[float, float], bool]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


def lines_for_step_1(text: str) -> set[int]:
    """Return the first lines of the branches that are taken only where the param `steps` is 1."""
    tree = ast.parse(text)
    names = {
        target.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and _reads_steps(node.value)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    lines = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If):
            for compare in ast.walk(node.test):
                at_1, later = (_holds(compare, names, steps) for steps in (1, FIRST_STEP))
                if at_1 != later:
                    lines |= {branch[0].lineno for branch in [node.body if at_1 else node.orelse] if branch}
    return lines


def _reads_steps(node: ast.expr) -> bool:
    return any(isinstance(part, ast.Constant) and part.value == "steps" for part in ast.walk(node))


def _holds(node: ast.AST, names: set[str], steps: int) -> bool | None:
    """Return whether a comparison of `steps`, or of one of these names, with a number holds; None: it is none."""
    match node:
        case ast.Compare(left=left, ops=[op], comparators=[ast.Constant(value=int() | float() as limit)]):
            if type(op) in _COMPARISONS and (
                left.id in names if isinstance(left, ast.Name) else _reads_steps(left)
            ):
                return _COMPARISONS[type(op)](steps, limit)
    return None
