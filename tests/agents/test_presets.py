from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from deepracer_exp.agents.actor_critic import Attention, SensorNet, build_actor_critic
from deepracer_exp.agents.build import build_agent, build_networks
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.agents.sac import SAC
from deepracer_exp.agents.schedules import PresetSchedule
from deepracer_exp.config.compose import compose_option
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import (
    CNNConfig,
    LRScheduleConfig,
    MLPConfig,
    NetworkConfig,
    OneAlgorithm,
    PPOConfig,
)
from deepracer_exp.config.options import options


@pytest.mark.parametrize(("action_count", "sensors"), [(7, "camera"), (None, "both")])
@pytest.mark.parametrize("name", options("network"))
def test_every_network_acts_and_judges(name, action_count, sensors):
    config = compose_option("network", name, NetworkConfig)
    pixels = torch.randint(0, 256, (3, 2, 84, 84), dtype=torch.uint8)
    sensed = {"observation": torch.randn(3, 11), "pixels": pixels, "lidar": torch.rand(3, 64)}
    if name == "lidar":
        observed = ObservationShape(11, None, 64)
    else:
        observed = ObservationShape(11, (2, 84, 84), 64 if sensors == "both" else None)
    networks = build_actor_critic(config, observed, action_count, torch.Generator())
    assert set(networks.policy.in_keys) == ({"observation"} if name.startswith("mlp") else set(observed.seen))
    steps = networks.value(networks.policy(TensorDict(sensed, [3])))
    assert steps["action"].shape == ((3,) if action_count else (3, 2))
    assert steps["state_value"].shape == (3, 1)


@pytest.mark.parametrize("name", options("lr_schedule"))
def test_every_schedule_keeps_a_positive_rate_over_a_run(name):
    schedule = PresetSchedule(compose_option("lr_schedule", name, LRScheduleConfig))
    assert all(0 < schedule.factor(i, i / 100) <= 1 for i in range(101))


@pytest.mark.parametrize("name", options("algorithm"))
def test_every_algorithm_builds_and_names_one_length_of_an_iteration(name):
    config = compose_option("algorithm", name, OneAlgorithm)
    network = compose_option("network", "mlp_small", MLPConfig)
    networks = build_networks(network, config, ObservationShape(11), 7, torch.Generator())
    agent = build_agent(networks, config, compose_option("lr_schedule", "constant", LRScheduleConfig), seed=0)
    assert isinstance(agent, PPO if isinstance(config, PPOConfig) else SAC)
    assert (config.frames_per_iteration is None) != (config.episodes_per_iteration is None)


def test_attention_sums_each_column_by_weights_that_sum_to_one():
    torch.manual_seed(0)
    layer, places = Attention(channels=6, units=5), torch.randn(2, 6, 4, 3)
    weights = layer.weights(places)
    assert weights.shape == (2, 1, 4, 3)
    assert torch.allclose(weights.sum(dim=2), torch.ones(2, 1, 3))
    hidden = torch.tanh(
        torch.einsum("bchw,uc->buhw", places, layer.score.weight) + layer.score.bias[:, None, None]
    )
    score = torch.einsum("buhw,u->bhw", hidden, layer.weight.weight[0])
    share = score.exp() / score.exp().sum(dim=1, keepdim=True)
    expected = torch.einsum("bchw,bhw->bcw", places, share)
    assert torch.allclose(layer(places)[:, :, 0], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "picture", "joined"),
    [("shallow", 11 * 16 * 64, 512), ("medium", 25 * 35 * 64, 512), ("deep", 3 * 6 * 512, 256)],
)
def test_lidar_joins_the_picture_before_the_services_middleware(name, picture, joined):
    net = SensorNet(compose_option("network", name, CNNConfig), ObservationShape(11, (1, 120, 160), 64), 7)
    first = next(layer for layer in net.perceptron if isinstance(layer, torch.nn.Linear))
    assert (first.in_features, first.out_features) == (picture + 256, joined)
    pixels, lidar = torch.zeros(2, 1, 120, 160, dtype=torch.uint8), torch.rand(2, 64)
    assert not torch.equal(*net(pixels, lidar))


def test_a_lidar_joins_after_layers_that_see_pictures_alone_where_that_is_asked_for():
    config = replace(compose_option("network", "deep", CNNConfig), hidden=(64, 32), lidar_joins_after=1)
    net = SensorNet(config, ObservationShape(11, (1, 120, 160), 64), 7)
    first = next(layer for layer in net.perceptron if isinstance(layer, torch.nn.Linear))
    assert (first.in_features, first.out_features) == (64 + 256, 32)
