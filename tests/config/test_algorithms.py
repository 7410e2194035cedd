from dataclasses import dataclass, fields

import pytest

from deepracer_exp.config import learning
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.learning import (
    AlgorithmConfig,
    PPOConfig,
    SACConfig,
    algorithm_kind,
    keys_of_others,
)


@dataclass(frozen=True, kw_only=True)
class SmallConfig(AlgorithmConfig):
    """A third algorithm, all of whose keys PPO has, too."""

    gae_lambda: float


@pytest.mark.parametrize(("option", "kind"), [("ppo", PPOConfig), ("sac", SACConfig)])
def test_an_algorithm_is_known_by_its_keys_even_if_an_experiment_brings_some_of_another(option, kind):
    _, composition = compose_experiment([f"algorithm={option}", "experiment=tiny"])
    values = composition.mapping["algorithm"]
    assert algorithm_kind(values) is kind
    assert algorithm_kind({**values, "replay_steps": 1, "epochs": 1}) is kind


def test_an_algorithm_whose_keys_are_a_part_of_anothers_is_known(monkeypatch):
    monkeypatch.setattr(learning, "ALGORITHMS", (*learning.ALGORITHMS, SmallConfig))
    assert algorithm_kind({key.name: 0 for key in fields(SmallConfig)}) is SmallConfig
    assert {"epochs", "replay_steps"} <= set(keys_of_others(SmallConfig))
    assert "gae_lambda" not in keys_of_others(SmallConfig)
