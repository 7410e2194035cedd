"""The best policy of a run so far."""

from typing import Any

from deepracer_exp.evaluation.result import Rank

from .examination import NOT_EVALUATED, Mark

DRIVING = "driving"
"""What ranks a policy that is not evaluated: the training's own episodes."""


class Best:
    """Remembers which policy was the best, and why.

    Attributes:
        policy: iteration and env steps of the policy, what it was ranked by, its rank and its evaluation, JSON types;
            None before the first.
    """

    def __init__(self, metric: str):
        """Begin without one.

        Args:
            metric: what evaluations are ranked by.
        """
        self._metric = metric
        self.policy: dict[str, Any] | None = None

    def beaten_by_driving(self, rank: Rank | None, counters: dict[str, int]) -> bool:
        """Return whether a policy drove better than any before, and remember it then.

        Args:
            rank: of its episodes; None: not known.
            counters: iteration and env steps.
        """
        return rank is not None and self._beaten(rank, counters, DRIVING, NOT_EVALUATED)

    def beaten_by(self, mark: Mark | None, counters: dict[str, int]) -> bool:
        """Return whether an evaluation was better than any before, and remember its policy then.

        Args:
            mark: the evaluation; None: there was none.
            counters: iteration and env steps.
        """
        return mark is not None and self._beaten(mark.rank, counters, self._metric, mark.columns())

    def _beaten(
        self, rank: Rank, counters: dict[str, int], metric: str, columns: dict[str, float | None]
    ) -> bool:
        if self.policy is not None and list(rank) <= self.policy["rank"]:
            return False
        moment = {name: counters[name] for name in ("iteration", "env_steps")}
        self.policy = {**moment, "metric": metric, "rank": list(rank), **columns}
        return True
