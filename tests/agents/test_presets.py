from pathlib import Path

import pytest
import torch
import yaml
from pydantic import TypeAdapter
from tensordict import TensorDict

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.agents.schedules import PresetSchedule
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import AlgorithmConfig, LRScheduleConfig, MLPConfig, NetworkConfig

CONF = Path(__file__).parents[2] / "conf"


def options(group):
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def load(group, name, type_):
    values = yaml.safe_load((CONF / group / f"{name}.yaml").read_text())
    for base in values.pop("defaults", []):
        values = (
            yaml.safe_load((CONF / group / f"{base}.yaml").read_text()) if base != "_self_" else {}
        ) | values
    return TypeAdapter(type_).validate_python(values)


@pytest.mark.parametrize("action_count", [7, None])
@pytest.mark.parametrize("name", options("network"))
def test_every_network_acts_and_judges(name, action_count):
    config = load("network", name, NetworkConfig)
    networks = build_actor_critic(
        config, ObservationShape(11, (2, 120, 160)), action_count, torch.Generator()
    )
    pixels = torch.randint(0, 256, (3, 2, 120, 160), dtype=torch.uint8)
    steps = networks.value(
        networks.policy(TensorDict({"observation": torch.randn(3, 11), "pixels": pixels}, [3]))
    )
    assert steps["action"].shape == ((3,) if action_count else (3, 2))
    assert steps["state_value"].shape == (3, 1)


@pytest.mark.parametrize("name", options("lr_schedule"))
def test_every_schedule_keeps_a_positive_rate_over_a_run(name):
    schedule = PresetSchedule(load("lr_schedule", name, LRScheduleConfig))
    assert all(0 < schedule.factor(i, i / 100) <= 1 for i in range(101))


@pytest.mark.parametrize("name", options("algorithm"))
def test_every_algorithm_builds_and_names_one_length_of_an_iteration(name):
    config = load("algorithm", name, AlgorithmConfig)
    network = load("network", "mlp_small", MLPConfig)
    networks = build_actor_critic(network, ObservationShape(11), 7, torch.Generator())
    PPO(networks, config, PresetSchedule(load("lr_schedule", "constant", LRScheduleConfig)), seed=0)
    assert (config.frames_per_iteration is None) != (config.episodes_per_iteration is None)


@pytest.mark.parametrize(
    ("group", "name"), [(g, n) for g in ("network", "lr_schedule", "algorithm") for n in options(g)]
)
def test_every_key_is_explained_on_the_line_above_it(group, name):
    lines = (CONF / group / f"{name}.yaml").read_text().splitlines()
    for above, line in zip(["", *lines], lines, strict=False):
        assert not line or line.startswith(("#", "  - ")) or above.startswith("# ")
