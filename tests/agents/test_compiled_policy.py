"""The compiled pass of a policy drives as the policy's modules do."""

import itertools

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.compiled_policy import CompiledPolicy
from deepracer_exp.collectors.car_worker import NOISE, SamplingPolicy
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import MLPConfig

from .test_inner_loop import ACTIVATIONS

CARS, FEATURES = 256, 23


def policy_of(activation: str, actions: int | None, shared: bool = False):
    network = MLPConfig(hidden=(64, 48), activation=activation, shared_trunk=shared, initial_std=0.5)
    networks = build_actor_critic(
        network, ObservationShape(FEATURES), actions, torch.Generator().manual_seed(3)
    )
    # Far from the almost uniform policy that a training begins with.
    with torch.no_grad():
        for parameter in networks.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(4)))
    return networks.policy


def cars(actions: int | None) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(5)
    return (
        generator.standard_normal((CARS, FEATURES)).astype(np.float32),
        generator.standard_normal((CARS, 2 if actions is None else 1)),
    )


@pytest.mark.parametrize(("activation", "actions"), list(itertools.product(ACTIVATIONS, (12, None))))
def test_its_actions_and_probabilities_are_those_of_the_modules(activation, actions):
    policy = policy_of(activation, actions)
    observation, noise = cars(actions)
    compiled = CompiledPolicy.of(policy)
    action, log_prob = compiled.sample(observation, noise)
    by_modules = SamplingPolicy(policy)
    by_modules._compiled = None
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = by_modules(
            TensorDict({"observation": torch.from_numpy(observation), NOISE: torch.from_numpy(noise)}, [CARS])
        )
        likeliest = policy(TensorDict({"observation": torch.from_numpy(observation)}, [CARS]))["action"]
    np.testing.assert_allclose(action, acted["action"].numpy(), atol=2e-6)
    np.testing.assert_allclose(log_prob, acted["action_log_prob"].numpy(), atol=2e-6)
    np.testing.assert_allclose(compiled.likeliest(observation), likeliest.numpy(), atol=2e-6)


@pytest.mark.parametrize("actions", [12, None])
def test_a_car_acts_the_same_bit_for_bit_beside_any_number_of_others(actions):
    observation, noise = cars(actions)
    compiled = CompiledPolicy.of(policy_of("tanh", actions))
    together = compiled.sample(observation, noise)
    for size in (1, 3, 16, 100):
        for begin in range(0, CARS, size):
            rows = slice(begin, begin + size)
            for alone, among in zip(compiled.sample(observation[rows], noise[rows]), together, strict=True):
                assert alone.tobytes() == among[rows].tobytes()


def test_it_drives_with_the_present_weights():
    policy = policy_of("relu", None)
    observation, _ = cars(None)
    compiled = CompiledPolicy.of(policy)
    before = compiled.likeliest(observation)
    with torch.no_grad():
        policy[0].module[0][-1].bias += 0.25
    np.testing.assert_allclose(compiled.likeliest(observation), before + 0.25, atol=1e-6)


def test_another_network_is_left_to_its_modules():
    assert CompiledPolicy.of(policy_of("relu", None, shared=True)) is None
