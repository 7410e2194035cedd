"""Protocols of the physical car: with each of its parts alone, and with all of them."""

from dataclasses import replace

import pytest
import torch

from deepracer_exp.commands.export.car_check import SIMULATOR, car_protocols
from deepracer_exp.config.compose import compose_evaluation, compose_experiment
from deepracer_exp.config.evaluation import RealCarConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.evaluator import Evaluator


class BrightSide(torch.nn.Module):
    """Steers to the brighter side of the picture."""

    def forward(self, seen):
        left, right = seen["pixels"].float().chunk(2, dim=-1)
        steering = ((left.mean((1, 2, 3)) - right.mean((1, 2, 3))) / 20).clamp(-1, 1)
        return seen.set("action", torch.stack([steering, torch.zeros_like(steering)], -1))


@pytest.fixture(scope="module")
def config():
    lines = ["evaluation=real_car", "evaluation.trials=1", "evaluation.time_s=1"]
    return compose_evaluation(lines)[0].evaluation


@pytest.fixture(scope="module")
def sees():
    return compose_experiment(["observation=camera", "action_space=continuous"])[0]


def test_each_part_is_driven_alone_and_no_part_is_the_simulator_bit_for_bit(sees, config):
    policy = BrightSide()
    protocols = car_protocols(config)
    assert list(protocols) == [SIMULATOR, "picture", "timing", "controls"]
    attempts = {
        name: Evaluator(sees, protocol, threads=1)(policy).groups[0].attempts
        for name, protocol in {**protocols, "all": config}.items()
    }
    assert len(set(attempts.values())) == len(attempts)  # each part makes a difference
    nothing = replace(config, real_car=RealCarConfig(picture=None, timing=None, controls=None))
    assert Evaluator(sees, nothing, threads=1)(policy).groups[0].attempts == attempts[SIMULATOR]


def test_parts_that_are_off_are_not_driven(config):
    timing = replace(config, real_car=replace(config.real_car, picture=None, controls=None))
    assert list(car_protocols(timing)) == [SIMULATOR]
    two = replace(config, real_car=replace(config.real_car, picture=None))
    assert list(car_protocols(two)) == [SIMULATOR, "timing", "controls"]


def test_a_policy_of_features_is_refused(config):
    with pytest.raises(BadInput, match="the car has no features"):
        Evaluator(compose_experiment([])[0], config)


@pytest.mark.parametrize("condition", ["usual", "held_out"])
def test_conditions_of_the_car_are_refused_for_a_policy_of_features(condition):
    lines = ["evaluation=three_trials", f"evaluation.{condition}=real_car"]
    with pytest.raises(BadInput, match=rf"evaluation\.{condition}: the car cannot run .* no features"):
        Evaluator(compose_experiment([])[0], compose_evaluation(lines)[0].evaluation)
