"""Why a trial is given up."""

from abc import abstractmethod
from typing import NamedTuple

from optuna.pruners import BasePruner
from optuna.study import Study
from optuna.trial import FrozenTrial


class Verdict(NamedTuple):
    """Why a trial is given up."""

    name: str
    """`collapsed`, `not_learning`, `median`, `percentile`, `hyperband` or `wilcoxon`."""
    reason: str
    """One line."""


class ExplainedPruner(BasePruner):
    """A pruner that says why."""

    @abstractmethod
    def verdict(self, study: Study, trial: FrozenTrial) -> Verdict | None:
        """Return why the trial is given up, None to go on."""

    def prune(self, study: Study, trial: FrozenTrial) -> bool:
        """Return whether the trial is given up."""
        return self.verdict(study, trial) is not None
