"""Pruners that compare a trial with others and give the reason for its early end.

The pruner `entropy` is none of them: it is the stopping rule that each trial trains with.
"""

import warnings
from collections.abc import Mapping
from typing import NamedTuple

from optuna.exceptions import ExperimentalWarning
from optuna.pruners import (
    BasePruner,
    HyperbandPruner,
    MedianPruner,
    PatientPruner,
    PercentilePruner,
)
from optuna.study import Study
from optuna.trial import FrozenTrial

from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.errors import BadInput


class PruneDecision(NamedTuple):
    """Why a trial is pruned."""

    name: str
    """`median`, `percentile` or `hyperband`; the trial's ending."""
    reason: str
    """The reason, one line."""


class FirstOf(BasePruner):
    """Several of Optuna's pruners: the first that prunes a trial decides and gives the reason."""

    def __init__(self, pruners: Mapping[str, tuple[BasePruner, str]]):
        """Combine pruners by name, each with a description of the trials it keeps; without any, no trial is pruned."""
        self._pruners = pruners

    def decide(self, study: Study, trial: FrozenTrial) -> PruneDecision | None:
        """Return why the trial is pruned, None to continue.

        Asked once an evaluation: Hyperband records in the study that it was asked.
        """
        step = trial.last_step
        for name, (pruner, kept) in self._pruners.items():
            if step is not None and pruner.prune(study, trial):
                score = trial.intermediate_values[step]
                return PruneDecision(name, f"{score:.4g} at evaluation {step} is not in the {kept}")
        return None

    def prune(self, study: Study, trial: FrozenTrial) -> bool:
        """Return whether the trial is pruned."""
        return self.decide(study, trial) is not None


def build_pruner(config: SweepConfig, evaluations: int | None = None) -> FirstOf:
    """Build the pruners for running trials.

    Args:
        config: of the sweep.
        evaluations: most evaluations of a trial before its end, for hyperband's brackets. None: as many as the first
            complete trial had; each worker finds that out by itself, and they may differ.

    Raises:
        BadInput: a pruner compares trials, and they have several objectives.
    """
    startup, first = config.startup_trials, config.warmup_evaluations + 1
    longest = "auto" if evaluations is None else max(evaluations, first)
    pruners: dict[str, tuple[BasePruner, str]] = {
        "median": (MedianPruner(startup, n_warmup_steps=first), "better half"),
        "percentile": (
            PercentilePruner(config.percentile, startup, n_warmup_steps=first),
            f"best {config.percentile:g}%",
        ),
        "hyperband": (HyperbandPruner(first, longest, reduction_factor=3), "best third"),
    }
    chosen = {name: pruners[name] for name in map(str, config.pruners) if name in pruners}
    if chosen and len(config.objectives) > 1:
        raise BadInput(
            f"sweep.pruners=[{','.join(config.pruners)}]: {', '.join(chosen)} compare one score, and "
            f"sweep.objectives=[{','.join(config.objectives)}]; accepted with several: [entropy] or []"
        )
    if config.patience is not None:
        with warnings.catch_warnings():
            # Experimental in Optuna, whose version is pinned.
            warnings.simplefilter("ignore", ExperimentalWarning)
            chosen = {
                name: (PatientPruner(pruner, config.patience), kept)
                for name, (pruner, kept) in chosen.items()
            }
    return FirstOf(chosen)
