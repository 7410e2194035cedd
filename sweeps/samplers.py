"""What chooses the values of the next trial, by name."""

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
    NSGAIISampler,
    QMCSampler,
    RandomSampler,
    TPESampler,
)
from optuna.samplers.nsgaii import BLXAlphaCrossover
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.errors import BadInput

from .space import SearchSpace

Values = dict[str, list[Any]]
"""What a grid is made of: the values of each key."""


def build_sampler(config: SweepConfig, space: SearchSpace) -> BaseSampler:
    """Build the sampler of a study; every worker builds its own.

    Raises:
        BadInput: the sampler cannot search this space, or not for these objectives.
    """
    grid: Values = {}
    if config.sampler == "cmaes":
        _check_cmaes(config, space)
    if config.sampler == "grid":
        grid = space.grid()
        _check_grid(config, grid)

    def make(slot: int) -> BaseSampler:
        with warnings.catch_warnings():
            # Optuna calls group, with_margin, QMCSampler and BLXAlphaCrossover experimental: they may change in a
            # later version. Its version is pinned, and the racer can do nothing about it.
            warnings.simplefilter("ignore", ExperimentalWarning)
            return _make(config, space, grid, slot)

    return NumberedSampler(make)


class NumberedSampler(BaseSampler):
    """A sampler that begins anew with each trial, seeded by the trial's slot.

    A sampler draws from its seed on. Workers share the study's seed, so that each of them, and each start of a
    study, would try the same first points once more. Here the draws of a trial depend on its slot, not on who makes
    it or when; what was learned from earlier trials is in the study.
    """

    def __init__(self, make: Callable[[int], BaseSampler]):
        """Set it up.

        Args:
            make: returns the sampler of a slot's trial.
        """
        self._make = make
        self._open: dict[int, BaseSampler] = {}

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        """Begin a trial."""
        self._of(trial).before_trial(study, trial)

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """Return what is sampled together."""
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Return the values that are sampled together."""
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Return one value that is sampled by itself."""
        return self._of(trial).sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """End a trial."""
        self._of(trial).after_trial(study, trial, state, values)
        del self._open[trial.number]

    def _of(self, trial: FrozenTrial) -> BaseSampler:
        if trial.number not in self._open:
            self._open[trial.number] = self._make(trial.user_attrs.get("slot", trial.number))
        return self._open[trial.number]


class _WholeSpaceQMC(QMCSampler):
    """Point n of one sequence over the whole space for slot n, whichever worker asks.

    Optuna's own counts the points in the study, where two workers may read the same count, and knows the space only
    from the first trial: keys of other options would be left to chance.
    """

    def __init__(self, space: dict[str, BaseDistribution], slot: int, seed: int):
        super().__init__(scramble=True, seed=seed)
        self._space, self._slot = space, slot

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return self._space

    def _find_sample_id(self, study: Study, search_space: dict[str, BaseDistribution]) -> int:
        return self._slot


class _EndlessGrid(GridSampler):
    """Optuna's own ends `Study.optimize` after its last point; here the number of trials ends the study."""

    def after_trial(
        self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        pass


class _PrunedToo(GPSampler):
    """Learns from pruned trials what they were worth at their end.

    Optuna's own knows complete and running trials only: where the best guess is pruned it guesses the same again.
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
        found = super()._get_trials(deepcopy, None, use_cache)
        seen = [_as_complete(trial) for trial in found]
        return [trial for trial in seen if states is None or trial.state in states]


def _as_complete(trial: FrozenTrial) -> FrozenTrial:
    if trial.state != TrialState.PRUNED or trial.values is None:
        return trial
    seen = copy.copy(trial)
    seen.state = TrialState.COMPLETE
    return seen


def _make(config: SweepConfig, space: SearchSpace, grid: Values, slot: int) -> BaseSampler:
    seed = int(np.random.SeedSequence([config.seed, slot]).generate_state(1)[0])
    startup = config.startup_trials
    match config.sampler:
        case "tpe":
            # group: keys that only some trials have get a model of their own.
            return TPESampler(
                n_startup_trials=startup, seed=seed, multivariate=True, group=True, constant_liar=True
            )
        case "gp":
            # It would warn at each trial that keys which only some trials have are left to chance.
            return _PrunedToo(n_startup_trials=startup, seed=seed, warn_independent_sampling=False)
        case "cmaes":
            # As for gp, and the same of choices.
            return CmaEsSampler(
                n_startup_trials=startup, seed=seed, with_margin=True, warn_independent_sampling=False
            )
        case "qmc":
            return _WholeSpaceQMC(_distributions(space), slot, config.seed)
        case "nsga2":
            # The first generation is what others call the start: drawn by chance. Children are blends of both parents:
            # a copy of one would be the same training once more.
            return NSGAIISampler(
                population_size=max(startup, 2), seed=seed, crossover=BLXAlphaCrossover(), crossover_prob=1.0
            )
        case "grid":
            return _EndlessGrid(grid, seed=config.seed)  # the order of all points
        case _:
            return RandomSampler(seed=seed)


def _distributions(space: SearchSpace) -> dict[str, BaseDistribution]:
    return {dimension.key: dimension.distribution for dimension in space.dimensions}


def _check_cmaes(config: SweepConfig, space: SearchSpace) -> None:
    if len(config.objectives) > 1:
        raise BadInput(
            f"sweep.sampler=cmaes: follows one objective, and sweep.objectives has {len(config.objectives)}; "
            "accepted with several: tpe, gp, nsga2, qmc, random, grid"
        )
    if all(isinstance(found, CategoricalDistribution) for found in _distributions(space).values()):
        raise BadInput(
            "sweep.sampler=cmaes: searches ranges, and the space has choices only; "
            "accepted for them: tpe, gp, nsga2, qmc, random, grid"
        )


def _check_grid(config: SweepConfig, grid: Values) -> None:
    points = math.prod(map(len, grid.values()))
    if config.trials > points:
        raise BadInput(
            f"sweep.trials={config.trials}: the grid has {points} points, and the others would be trained twice; "
            f"accepted: 1 to {points}"
        )
