import functools
import pickle

import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import FixedTrial

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import options
from deepracer_exp.config.stored import with_overrides
from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.errors import BadInput
from deepracer_exp.sweeps.search.space import SearchSpace
from tests.conftest import refused

GRIDS = ("action_space=discrete,grid", "action_space.speed_levels=2,3", "algorithm.lr=interval(0.001,0.01)")


@functools.cache
def space(*overrides: str) -> SearchSpace:
    return SearchSpace.from_request(compose_sweep(overrides))


refusal = functools.partial(refused, space)


def drawn(searched: SearchSpace) -> list[str]:
    return searched.suggest(optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)).ask())


READY = [
    pytest.param(name, marks=[pytest.mark.slow] if name == "everything" else [])
    for name in options("sweep")
    if name != "own"
]


@pytest.mark.parametrize("name", READY)
def test_every_ready_made_sweep_gives_trials_that_can_be_trained(name):
    searched = space(f"sweep={name}")
    assert searched.as_text() == dict(compose_sweep([f"sweep={name}"]).space)
    compose_experiment(drawn(searched))


def test_numbers_and_choices_are_distributions():
    found = space(
        *("algorithm.lr=tag(log,interval(1e-5,1e-3))", "algorithm.epochs=range(3,9,2)"),
        *("algorithm.batch_size=64,128", "reward.constants.STEP_COST=range(0,1,0.25)"),
    )
    assert {one.key: one.distribution for one in found.dimensions} == {
        "algorithm.lr": FloatDistribution(1e-5, 1e-3, log=True),
        "algorithm.epochs": IntDistribution(3, 7, step=2),
        "algorithm.batch_size": CategoricalDistribution((64, 128)),
        "reward.constants.STEP_COST": FloatDistribution(0.0, 0.75, step=0.25),
    }


def test_a_trial_trains_with_the_drawn_values_to_the_last_digit():
    searched = space("algorithm.lr=interval(0.1,1)", "reward.constants.STEP_COST=interval(0,1)", "seed=7")
    lr, cost = 0.1 + 0.2, 1 / 3
    overrides = searched.suggest(FixedTrial({"algorithm.lr": lr, "reward.constants.STEP_COST": cost}))
    experiment, _ = compose_experiment(overrides)
    assert (experiment.algorithm.lr, experiment.reward.constants["STEP_COST"]) == (lr, cost)
    assert experiment.seed == 7


def test_a_space_can_be_sent_to_another_process():
    assert pickle.loads(pickle.dumps(space(*GRIDS))) == space(*GRIDS)  # noqa: S301


def test_a_key_of_a_searched_group_counts_only_for_the_options_that_have_it():
    searched = space(*GRIDS)
    values = {"action_space.speed_levels": 3, "algorithm.lr": 0.002}
    without = searched.suggest(FixedTrial({"action_space": "discrete", **values}))
    having = searched.suggest(FixedTrial({"action_space": "grid", **values}))
    assert without == ["action_space=discrete", "algorithm.lr=0.002"]
    assert set(having) - set(without) == {"action_space=grid", "action_space.speed_levels=3"}


def test_a_constant_counts_only_for_the_reward_functions_that_have_it():
    constants = ("reward.constants.PROGRESS_WEIGHT=interval(1,2)", "reward.constants.STEP_COST=interval(0,1)")
    searched = space(*constants, "reward=self_motivator,progress_delta")
    assert {one.key: one.options for one in searched.dimensions} == {
        "reward": None,
        "reward.constants.PROGRESS_WEIGHT": None,
        "reward.constants.STEP_COST": ("progress_delta",),
    }


def test_ready_made_keys_that_the_chosen_option_lacks_are_left_out():
    searched = space("sweep=reward_weights", "reward=racing_line", "algorithm.lr=0.1,0.2")
    assert list(searched.as_text()) == ["algorithm.lr"]
    assert "steering_levels" in refusal("action_space=discrete", "action_space.steering_levels=3,5")


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        ((), ["nothing to search", "sweep=lr_entropy"]),
        (("sweep=lr_entropy", "~algorithm.lr", "algorithm.entropy_coeff=0"), ["nothing to search"]),
        (("algorithm.entropy=0.1,0.2",), ["algorithm.entropy: no such key", "did you mean entropy_coeff?"]),
        (("netwrk=mlp,mlp_small",), ["netwrk: no such key (did you mean network?)"]),
        (("network=mlp,mlp_smal",), ["network=mlp_smal: no such network (did you mean mlp_small?)"]),
        (
            ("action_space=grid,discrete", "action_space.steering_level=3,5"),
            ["action_space.steering_level: no such key", "did you mean steering_levels?"],
        ),
        (("reward.constants.STEPCOST=1,2",), ["no such constant (did you mean STEP_COST?)"]),
        (("algorithm.lr=interval(-1,1)",), ["interval(-1,1): algorithm.lr=-1.0", "greater than 0"]),
        (("algorithm.discount=interval(0.9,1.1)",), ["algorithm.discount=1.1", "less than or equal to 1"]),
        (("algorithm.epochs=5,0",), ["algorithm.epochs=5,0: algorithm.epochs=0", "greater than or equal"]),
        (("algorithm.epochs=interval(1,10)",), ["valid integer", "epochs='int(interval(1,10))'"]),
        (("algorithm.batch_size=1024,16384",), ["16384", "algorithm.frames_per_iteration=8192"]),
        (("action_space=grid", "action_space.speed_levels=range(1,4)"), ["range(1,4): ", "1 level"]),
        (("algorithm.lr=0.1,0.2", "algorithm.lrr=3"), ["algorithm.lrr: no such key"]),
        (("algorithm.lr=0.1,0.2", "reward.file=nowhere.py"), ["nowhere.py"]),
    ],
)
def test_what_no_run_accepts_is_refused(overrides, parts):
    message = refusal(*overrides)
    for part in parts:
        assert part in message


def test_a_base_may_be_complete_only_with_what_is_searched():
    by_episodes = "algorithm.frames_per_iteration=null"
    searched = space(by_episodes, "algorithm.episodes_per_iteration=10,20", "algorithm.lr=0.1,0.2")
    assert compose_experiment(searched.example())[0].algorithm.episodes_per_iteration == 10
    message = refusal(by_episodes, "algorithm.episodes_per_iteration=0,20")
    assert "algorithm.episodes_per_iteration=0: " in message


def test_values_are_checked_by_the_given_function():
    _, composition = compose_experiment(["action_space=grid"])
    tried = []

    def check(overrides):
        tried.append(overrides)
        changed = with_overrides(composition.mapping, composition.choices, overrides).mapping
        if changed["network"] != composition.mapping["network"]:
            raise BadInput("network: cannot be changed in a clone")
        return changed

    lines = ["action_space.steering_levels=3,5", "algorithm.lr=interval(1e-5,1e-4)", "parent=x"]
    SearchSpace.from_request(compose_sweep(lines), check)
    assert ["algorithm.lr=1e-05"] in tried
    with pytest.raises(BadInput, match=r"\[8,8\].*cannot be changed in a clone"):
        SearchSpace.from_request(compose_sweep(["network.hidden=choice([8,8],[9,9])"]), check)
    with pytest.raises(BadInput, match="no such key"):
        SearchSpace.from_request(compose_sweep(["algorithm.lrate=1,2"]), check)


def test_equal_spaces_written_differently_do_not_differ():
    one = space("algorithm.lr=interval(0.1, 1)", "network=glob(mlp_sm*)", "algorithm.epochs=range(3,9,2)")
    same = ("algorithm.epochs=range(3,8,2)", "algorithm.lr=interval(1e-1,1.0)")
    other = space(*same, "network=mlp_small,mlp_small_shared")
    assert one.difference(one.as_text()) == one.difference(other.as_text()) == []


def test_a_difference_names_each_key_before_and_now():
    now = space("algorithm.lr=interval(0.1,1)", "algorithm.epochs=3,5")
    before = {"algorithm.lr": "tag(log,interval(0.1,1))", "network": "mlp,mlp_small"}
    assert now.difference(before) == [
        "algorithm.lr: tag(log,interval(0.1,1)) -> interval(0.1,1)",
        "network: mlp,mlp_small -> not searched",
        "algorithm.epochs: not searched -> 3,5",
    ]


def test_a_grid_is_all_values_and_has_neither_infinite_ones_nor_conditions():
    ranges = ("algorithm.epochs=range(3,9,2)", "algorithm.lr=range(0.1,0.4,0.1)")
    grid = space(*ranges, "network=mlp,mlp_deep").grid()
    values = {"algorithm.epochs": [3, 5, 7], "algorithm.lr": [0.1, 0.2, 0.3]}
    assert grid == {"network": ["mlp", "mlp_deep"], **values}
    with pytest.raises(BadInput, match=r"grid: algorithm\.lr=interval\(0\.1,1\) has infinitely many values"):
        space("algorithm.lr=interval(0.1,1)", "algorithm.epochs=3,5").grid()
    with pytest.raises(BadInput, match=r"speed_levels counts only for action_space=grid"):
        space(*GRIDS).grid()
