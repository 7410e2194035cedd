from dataclasses import dataclass

import numpy as np
import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import TrialState, create_trial

from deepracer_exp.config.own_class import allow
from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.sweeps.search.samplers import build_sampler

from . import studies

NAMES = ("tpe", "gp", "cmaes", "random")
"""Every sampler that searches ranges; grid has a space of its own."""


@dataclass
class Dimension:
    key: str
    distribution: optuna.distributions.BaseDistribution


class Space:
    """A mixed space with a key that only one of the options has."""

    dimensions = (
        Dimension("network", CategoricalDistribution(("mlp", "mlp_shared"))),
        Dimension("network.hidden", IntDistribution(16, 128, step=16)),
        Dimension("algorithm.lr", FloatDistribution(1e-5, 1e-3, log=True)),
        Dimension("algorithm.entropy_coeff", FloatDistribution(0.0, 0.05)),
    )

    def suggest(self, trial: optuna.Trial) -> dict:
        values = {}
        for one in self.dimensions:
            if one.key != "network.hidden" or values["network"] == "mlp":
                values[one.key] = trial._suggest(one.key, one.distribution)
        return values


class Choices(Space):
    dimensions = (
        Dimension("track", CategoricalDistribution(("reinvent_base", "Oval_track", "Bowtie_track"))),
        Dimension("reward", CategoricalDistribution(("progress", "racing_line"))),
    )

    def grid(self) -> dict:
        return {one.key: list(one.distribution.choices) for one in self.dimensions}


def settings(sampler: str, **changes) -> SweepConfig:
    return studies.settings(sampler=sampler, **{"seed": 5, "trials": 6, **changes})


def score(values: dict) -> float:
    """Return a value to minimize: best at lr 1e-4 without an entropy bonus."""
    hidden = values.get("network.hidden", 64)
    return abs(np.log10(values["algorithm.lr"]) + 4) + values["algorithm.entropy_coeff"] + hidden / 1000


def searched(sampler: str, trials: int = 10, **changes) -> list[dict]:
    """Return the values of each trial of a study; every third one is pruned."""
    study = optuna.create_study(sampler=build_sampler(settings(sampler, **changes), Space()))
    for number in range(trials):
        trial = study.ask()
        values = Space().suggest(trial)
        trial.report(score(values), 1)
        if number % 3 == 2:
            study.tell(trial, state=TrialState.PRUNED)
        else:
            study.tell(trial, score(values))
    return [trial.params for trial in study.trials]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", NAMES)
def test_each_sampler_stays_within_a_mixed_space_and_only_another_seed_gives_other_values(name):
    found = searched(name, startup_trials=5)
    assert len(found) == 10
    for values in found:
        assert ("network.hidden" in values) == (values["network"] == "mlp")
        for one in Space.dimensions:
            if one.key in values:
                assert one.distribution._contains(one.distribution.to_internal_repr(values[one.key]))
    assert len({tuple(values.items()) for values in found}) == 10
    assert searched(name, trials=7, startup_trials=5) == found[:7]
    assert searched(name, trials=1, startup_trials=5, seed=6)[0] != found[0]


@pytest.mark.parametrize("name", NAMES)
def test_workers_that_begin_together_try_different_values_and_the_same_at_each_start(name):
    def begun() -> list[dict]:
        study = optuna.create_study()
        found = []
        for _ in range(4):  # each asks while those before it run
            study.sampler = build_sampler(settings(name), Space())
            found.append(Space().suggest(study.ask()))
        return found

    found = begun()
    assert len({values["algorithm.lr"] for values in found}) == 4
    assert begun() == found


@pytest.mark.parametrize("name", ["tpe", "random"])
def test_a_trial_draws_by_its_number_whatever_became_of_those_before(name):
    def drawn(earlier: TrialState) -> dict:
        study = optuna.create_study(sampler=build_sampler(settings(name), Space()))
        for _ in range(3):
            study.add_trial(create_trial(state=earlier))
        study.add_trial(create_trial(state=TrialState.RUNNING))
        return Space().suggest(optuna.Trial(study, study.trials[-1]._trial_id))

    assert drawn(TrialState.FAIL) == drawn(TrialState.RUNNING)


def test_a_class_by_its_path_searches_with_a_seed_for_each_trial():
    allow({"sampler": "optuna.samplers:NSGAIISampler"})
    found = searched("optuna.samplers:NSGAIISampler", trials=7)
    assert len({values["algorithm.lr"] for values in found}) == 7
    assert searched("optuna.samplers:NSGAIISampler", trials=7) == found


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("optuna.samplers:Nothing", "package.module:Class, installed or in the working folder"),
        ("os:path", "is a module; accepted: a class"),
        ("json:JSONDecoder", "accepted: a subclass of optuna.samplers"),
        ("optuna.samplers:GridSampler", "missing a required argument: 'search_space'"),
    ],
)
def test_a_path_of_something_else_is_refused(path, words):
    allow({"sampler": path})
    with pytest.raises(BadInput) as refused:
        build_sampler(settings(path), Space())
    assert str(refused.value).startswith(f"sweep.sampler={path}")
    assert words in str(refused.value)


def test_a_class_that_only_a_study_names_is_not_imported():
    with pytest.raises(BadInput, match=r"^sweep\.sampler=nobodys\.module:Sampler: named by a stored"):
        build_sampler(settings("nobodys.module:Sampler"), Space())


@pytest.mark.filterwarnings("error")
def test_the_grid_visits_each_point_once_and_two_workers_share_it():
    study = optuna.create_study()
    workers = [build_sampler(settings("grid"), Choices()) for _ in range(2)]
    for number in range(6):
        study.sampler = workers[number % 2]
        trial = study.ask()
        Choices().suggest(trial)
        study.tell(trial, 1.0)
    assert len({tuple(trial.params.items()) for trial in study.trials}) == 6


def test_more_trials_than_a_grid_has_points_are_refused():
    with pytest.raises(BadInput, match=r"^sweep\.trials=7: the grid has 6 points.*accepted: 1 to 6$"):
        build_sampler(settings("grid", trials=7), Choices())
    with pytest.raises(BadInput, match=r"^sweep\.enqueue: the grid drives each of its points anyway"):
        build_sampler(settings("grid", enqueue=("best:other",)), Choices())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", [name for name in NAMES if name != "cmaes"])
def test_a_sampler_that_can_follows_several_objectives(name):
    objectives = ("lap_time", "completion")
    study = optuna.create_study(
        directions=["minimize", "maximize"],
        sampler=build_sampler(settings(name, objectives=objectives), Space()),
    )
    for _ in range(6):
        trial = study.ask()
        values = Space().suggest(trial)
        study.tell(trial, [score(values), 100 * values["algorithm.entropy_coeff"]])
    assert len({trial.params["algorithm.lr"] for trial in study.trials}) == 6


def test_cmaes_refuses_several_objectives_and_a_space_of_choices_only():
    with pytest.raises(BadInput, match=r"^sweep\.sampler=cmaes: follows one objective.*has 2; accepted"):
        build_sampler(settings("cmaes", objectives=("lap_time", "completion")), Space())
    with pytest.raises(BadInput, match=r"^sweep\.sampler=cmaes: searches ranges"):
        build_sampler(settings("cmaes"), Choices())


def test_gp_does_not_repeat_pruned_values():
    study = optuna.create_study(sampler=build_sampler(settings("gp", startup_trials=1), Space()))
    tried = []
    for number in range(6):
        study.sampler = build_sampler(settings("gp", startup_trials=1), Space())
        trial = study.ask()
        tried.append(tuple(Space().suggest(trial).values()))
        trial.report(100.0, 1)
        # The best guess of a model that ignores them would stay the same.
        if number:
            study.tell(trial, state=TrialState.PRUNED)
        else:
            study.tell(trial, 9.0)
    assert len(set(tried)) == 6
