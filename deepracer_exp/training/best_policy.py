"""The best policy of a run so far, by its evaluation, or, without evaluations, by its own episodes."""

from collections.abc import Mapping
from typing import Any

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.evaluation.results import NOT_EVALUATED, Evaluation, Rank, eval_columns

from .metrics import Finished, Ranking

_DRIVING = "driving"
"""The measure of a policy that is not evaluated: the training's own episodes."""


class BestPolicy:
    """Remembers the best policy of a run, and ranks each new one against it.

    Attributes:
        record: iteration and env steps of the best policy, its criterion, rank and evaluation, JSON types; None before
            there is one.
    """

    def __init__(self, experiment: Experiment, setup: RaceSetup):
        self._metric = experiment.checkpoints.metric
        self._by_driving = experiment.checkpoints.every is None
        self._ranking = Ranking([course.tracks[0].length_m for course in setup.courses])
        self.record: dict[str, Any] | None = None

    def drove_best(self, finished: Finished, moment: Mapping[str, int]) -> bool:
        """Return whether the policy that drove these episodes is the best; with evaluations, these decide."""
        rank = self._ranking.rank(finished) if self._by_driving else None
        return rank is not None and self._is_better(rank, _DRIVING, NOT_EVALUATED, moment)

    def evaluated_best(self, evaluation: Evaluation | None, moment: Mapping[str, int]) -> bool:
        """Return whether the policy of this evaluation, None if it was not evaluated, is the best."""
        return evaluation is not None and self._is_better(
            evaluation.rank(self._metric), self._metric, eval_columns(evaluation), moment
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the best policy's record, and the last result of each track."""
        return {"best": self.record, "ranking": self._ranking.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore both."""
        self.record = state["best"]
        self._ranking.load_state_dict(state["ranking"])

    def _is_better(
        self, rank: Rank, metric: str, columns: Mapping[str, float | None], moment: Mapping[str, int]
    ) -> bool:
        if self.record is not None and list(rank) <= self.record["rank"]:
            return False
        self.record = {
            "iteration": moment["iteration"],
            "env_steps": moment["env_steps"],
            "metric": metric,
            "rank": list(rank),
            **columns,
        }
        return True
