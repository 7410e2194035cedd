import functools
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.agents.build import build_networks
from deepracer_exp.commands.export import onnx as exporting
from deepracer_exp.commands.export.onnx import TOLERANCE, DeployedPolicy, largest_difference, write_onnx
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.env.action_space import ActionSpace, build_action_space
from deepracer_exp.errors import BadInput, RunFailed

FEATURES = tuple(f"feature_{number}" for number in range(19))
OBSERVATIONS = torch.randn(50, len(FEATURES), generator=torch.Generator().manual_seed(2))
SHAPE, FACTS = ObservationShape(len(FEATURES)), {"run": "a", "features": FEATURES}


def policy(*overrides: str, seed: int = 0) -> tuple[PolicyNetworks, ActionSpace]:
    experiment, _ = compose_experiment(overrides)
    actions = build_action_space(experiment.action_space)
    generator = torch.Generator().manual_seed(seed)
    networks = build_networks(experiment.network, experiment.algorithm, SHAPE, actions.n, generator)
    with torch.no_grad():  # a fresh head's outputs hardly differ
        for parameter in networks.policy_head.parameters():
            parameter.mul_(3.0)
    return networks, actions


@dataclass(frozen=True)
class Written:
    """A file and what it was made of."""

    path: Path
    networks: PolicyNetworks
    actions: ActionSpace

    @functools.cached_property
    def session(self) -> onnxruntime.InferenceSession:
        return onnxruntime.InferenceSession(str(self.path), providers=["CPUExecutionProvider"])


def written(path: Path, *overrides: str) -> Written:
    networks, actions = policy(*overrides)
    assert 0 <= write_onnx(DeployedPolicy(networks, actions), SHAPE, FACTS, path) < 1e-5
    return Written(path, networks, actions)


@pytest.fixture(scope="module")
def default(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """The file of a policy that chooses among 15 actions."""
    return written(tmp_path_factory.mktemp("onnx") / "sub" / "policy.onnx", "action_space=discrete")


@pytest.fixture
def programmed(default: Written, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use the default's program again: making it takes seconds."""
    program = onnx.load(default.path)
    del program.metadata_props[:]
    monkeypatch.setattr(exporting, "_program", lambda *_: program)


@pytest.mark.parametrize(
    "overrides",
    [
        ("action_space=grid", "network=mlp_small_shared", "network.activation=silu"),
        ("action_space=continuous", "network=mlp_small", "network.activation=tanh"),
        ("action_space=continuous", "algorithm=sac", "network.activation=elu"),
        ("action_space=discrete", "algorithm=sac", "network=mlp_small"),
    ],
    ids=" ".join,
)
def test_the_file_gives_the_command_of_the_policys_likeliest_action(tmp_path, overrides):
    file = written(tmp_path / "policy.onnx", *overrides)
    observation = torch.randn(50, len(FEATURES), generator=torch.Generator().manual_seed(1))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        action = file.networks.policy(TensorDict({"observation": observation}, [50]))["action"].numpy()
    theirs = file.session.run(["command"], {"observation": observation.numpy()})[0]
    ours = np.stack(file.actions.commands(action), axis=1)
    assert np.allclose(theirs, ours, atol=1e-4)
    assert len(np.unique(theirs.round(3), axis=0)) > 3  # not one command for everything


def test_any_number_of_observations_will_do(default):
    for count in (1, 7):
        observation = np.zeros((count, len(FEATURES)), np.float32)
        probabilities, command = default.session.run(None, {"observation": observation})
        assert probabilities.shape == (count, default.actions.n)
        assert np.allclose(probabilities.sum(axis=1), 1, atol=1e-5)
        assert command.shape == (count, 2)


def test_the_file_names_its_features(default):
    path = default.path
    facts = {prop.key: json.loads(prop.value) for prop in onnx.load(path).metadata_props}
    assert tuple(facts["features"]) == FEATURES
    assert facts["run"] == "a"
    assert [file.name for file in path.parent.iterdir()] == ["policy.onnx"]


def test_a_file_of_another_network_is_detected(default):
    content = default.path.read_bytes()
    same = DeployedPolicy(default.networks, default.actions)
    assert largest_difference(same, content, [OBSERVATIONS]) < TOLERANCE
    other = DeployedPolicy(*policy("action_space=discrete", seed=1))
    assert largest_difference(other, content, [OBSERVATIONS]) > 100 * TOLERANCE


def test_a_file_that_computes_something_else_is_not_written(programmed, tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "TOLERANCE", -1.0)
    with pytest.raises(RunFailed, match="differs from the network by"):
        written(tmp_path / "policy.onnx", "action_space=discrete")
    assert list(tmp_path.iterdir()) == []


def test_without_its_packages_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(BadInput, match=r"needs the package onnxruntime.*deepracer-exp\[export\]"):
        written(tmp_path / "policy.onnx")


def test_a_place_that_cannot_be_written_is_named(programmed, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match=r"file/policy\.onnx: cannot be written"):
        written(tmp_path / "file" / "policy.onnx", "action_space=discrete")
