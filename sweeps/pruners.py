"""Pruners by name: what ends a trial early, and says why."""

import functools
import warnings
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from optuna.exceptions import ExperimentalWarning
from optuna.pruners import (
    BasePruner,
    HyperbandPruner,
    MedianPruner,
    PatientPruner,
    PercentilePruner,
    WilcoxonPruner,
)
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState, create_trial
from pydantic import TypeAdapter

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.stopping import EntropyStopping, StoppingConfig
from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.convergence import Decision, Row, StoppingRule, build_rule
from deepracer_exp.runs.files import METRICS, RunRecord, read_config, read_metrics
from deepracer_exp.training.stopping_replay import action_count

_MEDIAN = 50.0
_LEVEL = 0.1
"""Significance level of Wilcoxon's test: how often a trial as good as the best one may be pruned."""
_STOPPING: TypeAdapter[StoppingConfig] = TypeAdapter(StoppingConfig)
_FOLLOWED = 32  # runs at a time; one that was forgotten is read from its first row again


class PruneDecision(NamedTuple):
    """Why a trial is pruned."""

    name: str
    """`collapsed`, `not_learning`, `median`, `percentile`, `hyperband` or `wilcoxon`; the trial's outcome."""
    reason: str
    """One line."""


class ExplainingPruner(BasePruner):
    """A pruner that says why."""

    @abstractmethod
    def decide(self, study: Study, trial: FrozenTrial) -> PruneDecision | None:
        """Return why the trial is pruned, None to continue."""

    def prune(self, study: Study, trial: FrozenTrial) -> bool:
        """Return whether the trial is pruned."""
        return self.decide(study, trial) is not None


class AnyPruner(ExplainingPruner):
    """Several pruners of one study: the first that prunes a trial decides."""

    def __init__(self, pruners: Sequence[ExplainingPruner]):
        """Combine pruners; without any, no trial is pruned."""
        self._pruners = tuple(pruners)
        self._decided: dict[int, PruneDecision] = {}

    def decide(self, study: Study, trial: FrozenTrial) -> PruneDecision | None:
        """Return the first decision, None to continue.

        Raises:
            BadInput: as for `EntropyPruner.decide`.
        """
        # Hyperband records in the study that it was asked; a second time it would let the trial pass.
        if trial.number not in self._decided:
            decisions = (pruner.decide(study, trial) for pruner in self._pruners)
            found = next((decision for decision in decisions if decision is not None), None)
            if found is None:
                return None
            self._decided[trial.number] = found
        return self._decided[trial.number]


class ComparingPruner(ExplainingPruner):
    """One of Optuna's pruners that compare the scores of trials, with a reason."""

    def __init__(self, name: str, pruner: BasePruner, percentile: float | None):
        """Wrap a pruner.

        Args:
            name: of the decision.
            pruner: of Optuna.
            percentile: per cent of the trials that are kept at each evaluation; None for hyperband.
        """
        self._name, self._pruner, self._percentile = name, pruner, percentile

    def decide(self, study: Study, trial: FrozenTrial) -> PruneDecision | None:
        """Return why the trial is pruned, None to continue."""
        step = trial.last_step
        if step is None or not self._pruner.prune(study, trial):
            return None
        if self._percentile is None:
            score = trial.intermediate_values[step]
            return PruneDecision(self._name, f"{score:.4g} at evaluation {step} is not in the best third")
        return PruneDecision(self._name, self._bound(study, trial, step, self._percentile))

    def _bound(self, study: Study, trial: FrozenTrial, step: int, percentile: float) -> str:
        upwards = study.direction == StudyDirection.MAXIMIZE
        best = (max if upwards else min)(trial.intermediate_values.values())
        trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        there = [one.intermediate_values[step] for one in trials if step in one.intermediate_values]
        bound = float(np.percentile(there, 100 - percentile if upwards else percentile))
        what = "median" if percentile == _MEDIAN else f"bound of the best {percentile:g} %"
        return f"{best:.4g} is the best up to evaluation {step}, {bound:.4g} the {what} there, trials: {len(there)}"


class EntropyPruner(ExplainingPruner):
    """The stopping rule `entropy`, applied to the files of a trial's run, where it stops a run early.

    A run with a rule `entropy` of its own is judged by its own thresholds. The first decision on a run is final: a run
    that has converged is never pruned, whatever follows.
    """

    def __init__(self, rules: EntropyStopping):
        """Start without any run.

        Args:
            rules: for runs with another stopping rule.
        """
        self._rules = rules
        self._followed: dict[str, _Followed] = {}

    def decide(self, study: Study, trial: FrozenTrial) -> PruneDecision | None:
        """Return `collapsed` or `not_learning` and the reason, None to continue.

        A trial without a run, and a run without an iteration, continue.

        Raises:
            BadInput: the run's files are not what a training writes.
        """
        run_dir = trial.user_attrs.get("run_dir")
        decision = None if run_dir is None else self._decision(run_dir)
        if decision is None or not decision.hopeless:
            return None
        return PruneDecision(decision.rule, decision.why)

    def _decision(self, run_dir: str) -> Decision | None:
        path = Path(run_dir)
        metrics = path / METRICS
        if not metrics.exists():
            return None
        rows = read_metrics(metrics)
        followed = self._followed.pop(run_dir, None)
        if followed is None or not followed.continues_in(rows):
            followed = _Followed(self._stopping(path))
        followed.observe(rows)
        self._followed[run_dir] = followed
        if len(self._followed) > _FOLLOWED:
            del self._followed[next(iter(self._followed))]
        return followed.decision

    def _stopping(self, path: Path) -> StoppingRule:
        config = read_config(path)
        own: Any = _STOPPING.validate_python(config["stopping"])
        rules = own if isinstance(own, EntropyStopping) else self._rules
        return build_rule(rules, action_count(RunRecord(path, config, [], {}, {})))


@dataclass
class _Followed:
    """The part of a run seen so far."""

    stopping: StoppingRule
    rows: int = 0
    last: Row | None = None
    decision: Decision | None = None

    def continues_in(self, rows: list[dict[str, Any]]) -> bool:
        """Return whether these rows begin with those seen; a resumed run goes back to its checkpoint first."""
        return self.rows == 0 or (len(rows) >= self.rows and rows[self.rows - 1] == self.last)

    def observe(self, rows: list[dict[str, Any]]) -> None:
        for row in rows[self.rows :]:
            self.rows, self.last = self.rows + 1, row
            if self.decision is None:
                self.decision = self.stopping.observe(row)


def _hyperband(config: SweepConfig, first: int, evaluations: int | None) -> BasePruner:
    longest = "auto" if evaluations is None else max(evaluations, first)
    return HyperbandPruner(min_resource=first, max_resource=longest, reduction_factor=3)


_COMPARING: dict[str, Callable[[SweepConfig, int, int | None], BasePruner]] = {
    "median": lambda config, first, _: MedianPruner(config.startup_trials, n_warmup_steps=first),
    "percentile": lambda config, first, _: PercentilePruner(
        config.percentile, config.startup_trials, n_warmup_steps=first
    ),
    "hyperband": _hyperband,
}
"""Pruners that compare trials by their first objective, from (sweep, first evaluation that counts, evaluations)."""


def build_pruner(config: SweepConfig, evaluations: int | None = None) -> AnyPruner:
    """Build the pruners for running trials; wilcoxon compares seeds, see `is_worse_across_seeds`.

    Args:
        config: of the sweep.
        evaluations: the most that a trial has before its end, for hyperband's brackets. None: as many as the first
            complete trial had; each worker finds that out by itself, and they may differ.

    Raises:
        BadInput: a pruner compares trials, and they have several objectives.
    """
    comparing = [name for name in config.pruners if name in _COMPARING]
    if comparing and len(config.objectives) > 1:
        raise BadInput(
            f"sweep.pruners={_list(config.pruners)}: {', '.join(comparing)} compare one score, and "
            f"sweep.objectives={_list(config.objectives)}; accepted with several: [entropy] or []"
        )
    pruners: list[ExplainingPruner] = []
    if "entropy" in config.pruners:
        pruners.append(EntropyPruner(_standard_rules()))
    for name in comparing:
        pruner = _COMPARING[name](config, config.warmup_evaluations + 1, evaluations)
        if config.patience is not None:
            with warnings.catch_warnings():
                # Experimental in Optuna, whose version is pinned.
                warnings.simplefilter("ignore", ExperimentalWarning)
                pruner = PatientPruner(pruner, config.patience)
        percentile = {"median": _MEDIAN, "percentile": config.percentile}.get(name)
        pruners.append(ComparingPruner(name, pruner, percentile))
    return AnyPruner(pruners)


def is_worse_across_seeds(study: Study, values: Sequence[float]) -> bool:
    """Return whether these values are worse than the best trial's, seed by seed, by Wilcoxon's signed-rank test.

    The significance level is 0.1; with fewer than five seeds it is the least the test can reach before the last seed,
    2^-(seeds - 1); after one seed no test can decide. With several objectives there is no best trial: False.

    Args:
        study: its complete trials have `runs` in their user attributes.
        values: of the first seeds of a trial, in the order of the seeds.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete or len(study.directions) > 1:
        return False
    rival = [run["value"][0] for run in study.best_trial.user_attrs["runs"]]
    level = max(_LEVEL, 1.01 * 0.5 ** (len(rival) - 1))
    with warnings.catch_warnings():
        # Experimental in Optuna, whose version is pinned.
        warnings.simplefilter("ignore", ExperimentalWarning)
        pruner = WilcoxonPruner(p_threshold=level)
    # The best trial's same seeds only: its mean over more of them would say nothing about these.
    return pruner.prune(_BySeed(study.direction, _by_seed(rival[: len(values)])), _by_seed(values))


class _BySeed(Study):
    """A study whose best trial has a value per seed instead of per evaluation; the pruner asks for nothing else."""

    def __init__(self, direction: StudyDirection, best: FrozenTrial):
        self._direction, self._best = direction, best

    @property
    def direction(self) -> StudyDirection:
        return self._direction

    @property
    def best_trial(self) -> FrozenTrial:
        return self._best


def _by_seed(values: Sequence[float]) -> FrozenTrial:
    return create_trial(value=sum(values) / len(values), intermediate_values=dict(enumerate(values)))


@functools.cache
def _standard_rules() -> EntropyStopping:
    rules = compose_experiment(["stopping=entropy"])[0].stopping
    assert isinstance(rules, EntropyStopping)
    return rules


def _list(names: Sequence[str]) -> str:
    return f"[{','.join(names)}]"
