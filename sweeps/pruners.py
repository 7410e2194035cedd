"""What gives up a trial before its end, by name."""

import functools
import warnings
from collections.abc import Sequence

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

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.stopping import EntropyStopping
from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.errors import BadInput

from .entropy_pruner import EntropyPruner
from .verdict import ExplainedPruner, Verdict

_MEDIAN = 50.0
_LEVEL = 0.1
"""Of Wilcoxon's test at a look: how often a trial as good as the best one may be given up."""


class AnyPruner(ExplainedPruner):
    """Several pruners of one study: the first that gives a trial up has said so for good."""

    def __init__(self, pruners: Sequence[ExplainedPruner]):
        """Set it up; without a pruner no trial is given up."""
        self._pruners = tuple(pruners)
        self._given: dict[int, Verdict] = {}

    def verdict(self, study: Study, trial: FrozenTrial) -> Verdict | None:
        """Return the first verdict, None to go on.

        Raises:
            BadInput: as for `EntropyPruner.verdict`.
        """
        # Hyperband notes in the study that it was asked; a second time it would let the trial pass.
        if trial.number not in self._given:
            verdicts = (pruner.verdict(study, trial) for pruner in self._pruners)
            found = next((verdict for verdict in verdicts if verdict is not None), None)
            if found is None:
                return None
            self._given[trial.number] = found
        return self._given[trial.number]


class ComparingPruner(ExplainedPruner):
    """One of Optuna's pruners that compare the scores of trials, with words for its verdict."""

    def __init__(self, name: str, pruner: BasePruner, percentile: float | None):
        """Set it up.

        Args:
            name: for the verdict.
            pruner: of Optuna.
            percentile: per cent of the trials that are kept at each evaluation; None for hyperband.
        """
        self._name, self._pruner, self._percentile = name, pruner, percentile

    def verdict(self, study: Study, trial: FrozenTrial) -> Verdict | None:
        """Return why the trial is beaten, None to go on."""
        step = trial.last_step
        if step is None or not self._pruner.prune(study, trial):
            return None
        if self._percentile is None:
            score = trial.intermediate_values[step]
            return Verdict(self._name, f"{score:.4g} at evaluation {step} is not in the best third")
        return Verdict(self._name, self._bound(study, trial, step, self._percentile))

    def _bound(self, study: Study, trial: FrozenTrial, step: int, percentile: float) -> str:
        upwards = study.direction == StudyDirection.MAXIMIZE
        best = (max if upwards else min)(trial.intermediate_values.values())
        trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        there = [one.intermediate_values[step] for one in trials if step in one.intermediate_values]
        bound = float(np.percentile(there, 100 - percentile if upwards else percentile))
        what = "median" if percentile == _MEDIAN else f"bound of the best {percentile:g} %"
        return f"{best:.4g} is the best up to evaluation {step}, {bound:.4g} the {what} there, trials: {len(there)}"


def build_pruner(config: SweepConfig, evaluations: int | None = None) -> AnyPruner:
    """Build the pruners that look at a running trial; wilcoxon looks at its seeds, see `is_beaten_across_seeds`.

    Args:
        config: of the sweep.
        evaluations: that a trial has at most on its way, for hyperband's brackets. None: as many as the first complete
            trial had; each worker finds that out by itself, and not all of them find the same.

    Raises:
        BadInput: pruners compare trials that have several objectives.
    """
    comparing = [name for name in config.pruners if name not in ("entropy", "wilcoxon")]
    if comparing and len(config.objectives) > 1:
        raise BadInput(
            f"sweep.pruners={_list(config.pruners)}: {', '.join(comparing)} compare one score, and "
            f"sweep.objectives={_list(config.objectives)}; accepted with several: [entropy] or []"
        )
    pruners: list[ExplainedPruner] = []
    if "entropy" in config.pruners:
        pruners.append(EntropyPruner(_standard_rules()))
    pruners += [_comparing(name, config, evaluations) for name in comparing]
    return AnyPruner(pruners)


def is_beaten_across_seeds(study: Study, values: Sequence[float]) -> bool:
    """Return whether the best trial has beaten these values seed by seed, by Wilcoxon's signed-rank test.

    The level is 0.1; with fewer than five seeds it is what the test can reach before the last seed, 2^-(seeds - 1),
    and after one seed no test can say anything. With several objectives no trial is the best, and none is beaten.

    Args:
        study: its complete trials have `runs` in their user attributes.
        values: of the first seeds of a trial, in the order of the seeds.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete or len(study.directions) > 1:
        return False
    best = study.best_trial
    rival = [run["value"][0] for run in best.user_attrs["runs"]]
    level = max(_LEVEL, 1.01 * 0.5 ** (len(rival) - 1))
    with warnings.catch_warnings():
        # Optuna may change WilcoxonPruner in a later version; its version is pinned.
        warnings.simplefilter("ignore", ExperimentalWarning)
        pruner = WilcoxonPruner(p_threshold=level)
    # Of the best one the same seeds: its mean over more of them would say nothing about these.
    return pruner.prune(_BySeed(study.direction, _by_seed(rival[: len(values)])), _by_seed(values))


class _BySeed(Study):
    """A study whose best trial has a value at each seed instead of each evaluation; no more is asked of it."""

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


def _comparing(name: str, config: SweepConfig, evaluations: int | None) -> ComparingPruner:
    first = config.warmup_evaluations + 1
    percentile = {"median": _MEDIAN, "percentile": config.percentile}.get(name)
    pruner: BasePruner
    if name == "median":
        pruner = MedianPruner(n_startup_trials=config.startup_trials, n_warmup_steps=first)
    elif name == "percentile":
        pruner = PercentilePruner(
            config.percentile, n_startup_trials=config.startup_trials, n_warmup_steps=first
        )
    else:
        longest = "auto" if evaluations is None else max(evaluations, first)
        pruner = HyperbandPruner(min_resource=first, max_resource=longest, reduction_factor=3)
    if config.patience is not None:
        with warnings.catch_warnings():
            # Optuna may change PatientPruner in a later version; its version is pinned.
            warnings.simplefilter("ignore", ExperimentalWarning)
            pruner = PatientPruner(pruner, config.patience)
    return ComparingPruner(name, pruner, percentile)


@functools.cache
def _standard_rules() -> EntropyStopping:
    rules = compose_experiment(["stopping=entropy"])[0].stopping
    if not isinstance(rules, EntropyStopping):
        raise TypeError(f"stopping=entropy is a {type(rules).__name__}")
    return rules


def _list(names: Sequence[str]) -> str:
    return f"[{','.join(names)}]"
