"""Samplers by name: they choose the parameters of the next trial."""

import copy
import math
import warnings
from collections.abc import Callable, Container, Sequence
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.samplers import (
    BaseSampler,
    CmaEsSampler,
    GPSampler,
    GridSampler,
    RandomSampler,
    TPESampler,
)
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.config.own_class import OwnClass, build_own
from deepracer_exp.config.sweep import SAMPLERS, SweepConfig
from deepracer_exp.errors import BadInput

from .space import SearchSpace


def build_sampler(config: SweepConfig, space: SearchSpace) -> BaseSampler:
    """Build the sampler of a study; every worker builds its own.

    Raises:
        BadInput: the sampler cannot search this space, or not for these objectives; or it is a class that cannot be
            built.
    """
    if config.sampler == "cmaes":
        _check_cmaes(config, space)
    if config.sampler == "grid":
        _check_grid(config, space)

    def make(number: int) -> BaseSampler:
        seed = int(np.random.SeedSequence([config.seed, number]).generate_state(1)[0])
        with warnings.catch_warnings():
            # Experimental in Optuna, whose version is pinned: group, with_margin, and some of its other samplers.
            warnings.simplefilter("ignore", ExperimentalWarning)
            if config.sampler in SAMPLERS:
                return _SAMPLERS[config.sampler](config, space, number, seed)
            chosen = OwnClass(target=config.sampler, kwargs={"seed": seed})
            return build_own(chosen, "sweep.sampler", BaseSampler)  # type: ignore[type-abstract]

    if config.sampler not in SAMPLERS:
        make(0)
    return _PerTrialSampler(make)


class _PerTrialSampler(BaseSampler):
    """A fresh sampler for each trial, seeded by the trial's number.

    Workers share the study's seed, so with a single sampler per process each worker, and each start of a study, would
    try the same first points. Here the draws of a trial depend on its number, not on the worker or the moment; the
    results of earlier trials are in the study.
    """

    def __init__(self, make: Callable[[int], BaseSampler]):
        """Start without any sampler; `make` returns the sampler of a trial by the trial's number."""
        self._make = make
        self._open: dict[int, BaseSampler] = {}

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        self._of(trial).before_trial(study, trial)

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        return self._of(trial).sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        self._of(trial).after_trial(study, trial, state, values)
        del self._open[trial.number]

    def _of(self, trial: FrozenTrial) -> BaseSampler:
        if trial.number not in self._open:
            self._open[trial.number] = self._make(trial.number)
        return self._open[trial.number]


class _EndlessGrid(GridSampler):
    """Optuna's own ends `Study.optimize` after its last point; here the number of trials ends the study."""

    def after_trial(
        self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        pass


class _LearnsFromPruned(GPSampler):
    """Learns from the last values of pruned trials, too.

    Optuna's own sampler uses complete and running trials only: if its best guess is pruned, it guesses the same again.
    """

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return super().infer_relative_search_space(_WithPruned(study), trial)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        return super().sample_relative(_WithPruned(study), trial, search_space)


class _WithPruned(Study):
    """A study whose pruned trials count as complete."""

    def __init__(self, study: Study):
        self.__dict__ |= study.__dict__

    def _get_trials(
        self, deepcopy: bool = True, states: Container[TrialState] | None = None, use_cache: bool = False
    ) -> list[FrozenTrial]:
        trials = [_as_complete(trial) for trial in super()._get_trials(deepcopy, None, use_cache)]
        return [trial for trial in trials if states is None or trial.state in states]


def _as_complete(trial: FrozenTrial) -> FrozenTrial:
    if trial.state != TrialState.PRUNED or trial.values is None:
        return trial
    seen = copy.copy(trial)
    seen.state = TrialState.COMPLETE
    return seen


_SAMPLERS: dict[str, Callable[[SweepConfig, SearchSpace, int, int], BaseSampler]] = {
    # group: keys that only some trials have get a model of their own.
    "tpe": lambda config, space, number, seed: TPESampler(
        n_startup_trials=config.startup_trials, seed=seed, multivariate=True, group=True, constant_liar=True
    ),
    # Keys that only some trials have are drawn at random; Optuna would warn of it at each trial.
    "gp": lambda config, space, number, seed: _LearnsFromPruned(
        n_startup_trials=config.startup_trials, seed=seed, warn_independent_sampling=False
    ),
    "cmaes": lambda config, space, number, seed: CmaEsSampler(
        n_startup_trials=config.startup_trials, seed=seed, with_margin=True, warn_independent_sampling=False
    ),
    # The sweep's seed gives the order of all points.
    "grid": lambda config, space, number, seed: _EndlessGrid(dict(space.grid()), seed=config.seed),
    "random": lambda config, space, number, seed: RandomSampler(seed=seed),
}
"""Samplers by name, from (sweep, space, number of the trial, seed of the trial)."""


def _check_cmaes(config: SweepConfig, space: SearchSpace) -> None:
    others = ", ".join(name for name in SAMPLERS if name != "cmaes")
    if len(config.objectives) > 1:
        raise BadInput(
            f"sweep.sampler=cmaes: follows one objective, and sweep.objectives has {len(config.objectives)}; "
            f"accepted with several: {others}"
        )
    if all(isinstance(dimension.distribution, CategoricalDistribution) for dimension in space.dimensions):
        raise BadInput(
            "sweep.sampler=cmaes",
            f"searches ranges, and the space has choices only; accepted for them: {others}",
        )


def _check_grid(config: SweepConfig, space: SearchSpace) -> None:
    if config.enqueue:
        raise BadInput(
            "sweep.enqueue", "the grid drives each of its points anyway", "[] with sweep.sampler=grid"
        )
    points = math.prod(map(len, space.grid().values()))
    if config.trials > points:
        raise BadInput(
            f"sweep.trials={config.trials}: the grid has {points} points, and the others would be trained twice; "
            f"accepted: 1 to {points}"
        )
