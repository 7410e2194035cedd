"""`deepracer-exp clone`: a new run with another run's policy, and what it records of its parent."""

import json
import shutil

import pytest
import torch
import yaml
from mlflow import MlflowClient
from torchrl.checkpoint import Checkpoint

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.agents.schedules import PresetSchedule
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.runs.checkpoint_files import checkpoint_sha256, pinned
from deepracer_exp.runs.resolve import resolve

OFTEN = ("episode.max_steps=60", "checkpoints.every=2", "budget.env_steps=null", "budget.iterations=3")


def config(folder) -> dict:
    return yaml.safe_load((folder / "config.yaml").read_text())


def lineage(folder) -> dict:
    return json.loads((folder / "lineage.json").read_text())


def agent_of(folder, name: str) -> PPO:
    experiment = resolve(str(folder), folder.parent.parent, None).experiment
    networks = build_actor_critic(
        experiment.network,
        observation_shape(experiment.observation),
        build_action_space(experiment.action_space).n,
        torch.Generator(),
    )
    agent = PPO(networks, experiment.algorithm, PresetSchedule(experiment.lr_schedule), 0)
    Checkpoint(agent=agent).load(folder / "checkpoints" / name)
    return agent


@pytest.fixture
def parent(trained, tmp_path):
    """Return a copy of a finished run."""
    ended = trained(*OFTEN)
    assert ended.code == 0, ended.stderr
    copy = tmp_path / "runs" / "tiny" / ended.folder.name
    shutil.copytree(ended.folder, copy, symlinks=True)
    return copy


def child_of(parent, ended):
    assert ended.code == 0, ended.stderr
    (child,) = (folder for folder in ended.folders if folder != parent)
    return child


def test_a_clone_begins_with_the_parents_best_policy_and_learns_at_a_tenth_of_its_rate(parent, call):
    child = child_of(
        parent, call("clone", parent.name, "budget.iterations=1", "algorithm.max_grad_norm=1e-9")
    )
    # Steps of no size: what it ends with is what it began with.
    ours, theirs = (
        agent_of(folder, name).state_dict() for folder, name in ((child, "last"), (parent, "best"))
    )
    for name, value in theirs["networks"].items():
        assert torch.allclose(ours["networks"][name], value, atol=2e-3)
    steps = {
        name: [state["step"].item() for state in one["optimizer"]["state"].values()]
        for name, one in {"ours": ours, "theirs": theirs}.items()
    }
    assert max(steps["ours"]) < min(steps["theirs"])  # a fresh optimizer
    before, after = config(parent), config(child)
    assert after["algorithm"].pop("lr") == pytest.approx(before["algorithm"].pop("lr") / 10)
    for key in ("iterations",):
        before["budget"].pop(key), after["budget"].pop(key)
    before["algorithm"].pop("max_grad_norm"), after["algorithm"].pop("max_grad_norm")
    assert before == after


def test_a_clone_knows_where_it_comes_from_and_the_parent_keeps_the_checkpoint(parent, call):
    child = child_of(parent, call("clone", parent.name, "budget.iterations=1"))
    best = (parent / "checkpoints" / "best").resolve()
    recorded = lineage(child)
    assert recorded["parent"] == parent.name
    assert recorded["checkpoint"] == best.name
    assert recorded["sha256"] == checkpoint_sha256(best)
    assert recorded["generation"] == 1
    assert list(pinned(parent / "checkpoints")) == [best.name]
    ended = call("clone", child.name, "checkpoint=last", "budget.iterations=1")
    assert ended.code == 0, ended.stderr
    (grandchild,) = (folder for folder in ended.folders if folder not in (parent, child))
    assert lineage(grandchild)["generation"] == 2
    assert lineage(grandchild)["parent"] == child.name
    assert config(grandchild)["algorithm"]["lr"] == pytest.approx(config(parent)["algorithm"]["lr"] / 100)


@pytest.mark.parametrize(
    ("overrides", "lr"),
    [(["algorithm.lr=3e-4"], 3e-4), (["lr_schedule=linear"], 1e-4), (["algorithm=ppo"], 1e-3)],
)
def test_a_rate_that_is_given_is_taken(parent, call, overrides, lr):
    child = child_of(parent, call("clone", parent.name, "budget.iterations=1", *overrides))
    assert config(child)["algorithm"]["lr"] == pytest.approx(lr)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (
            ["action_space=deepracer"],
            ["action_space", "actions", "->", "5 actions", "networks were made for it"],
        ),
        (["action_space=continuous"], ["action_space", "continuous"]),
        (["network=mlp_deep"], ["network", "hidden"]),
        (["observation.lookahead_m=[1.0]"], ["observation", "features"]),
        (["experiment=tiny"], ["experiment=tiny", "give the groups"]),
        (["checkpoint=77"], ["checkpoint=77", "not there"]),
        (["checkpoint=../../x"], ["a checkpoint is best, last or the number"]),
        (["algorithm.rate=1"], ["algorithm.rate: no such key"]),
    ],
)
def test_what_the_parents_networks_do_not_fit_is_refused(parent, call, overrides, words):
    ended = call("clone", parent.name, "budget.iterations=1", *overrides)
    assert ended.code == 2
    for word in words:
        assert word in ended.complaint
    assert ended.folders == [parent]


def test_another_track_or_reward_is_allowed_and_warned_of(parent, call):
    changes = ("track=Oval_track", "reward=speed_on_track")
    ended = call("clone", parent.name, "budget.iterations=1", *changes)
    child = child_of(parent, ended)
    assert "warning: track is not the parent's" in ended.stderr
    assert "warning: reward is not the parent's" in ended.stderr
    assert "Oval_track-speed_on_track" in child.name
    provenance = json.loads((child / "provenance.json").read_text())
    assert provenance["names"]["track"] == "Oval_track"
    assert provenance["names"]["action_space"] == "discrete"


def test_without_a_run_nothing_is_begun(call):
    ended = call("clone", "algorithm.lr=1")
    ended.assert_bad_input("RUN: missing")


def test_in_mlflow_a_clone_stands_under_its_parent(call, tmp_path):
    quick = ("experiment=tiny", "collector=in_process", "collector.threads=1", *OFTEN)
    ended = call("train", *quick)
    assert ended.code == 0, ended.stderr
    parent = ended.folder
    child = child_of(parent, call("clone", parent.name, "budget.iterations=1"))
    client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path / 'runs' / 'mlflow.db'}")
    ids = [json.loads((folder / "tracking.json").read_text())["run_id"] for folder in (parent, child)]
    tags = client.get_run(ids[1]).data.tags
    assert tags["mlflow.parentRunId"] == ids[0]
    assert tags["lineage.parent"] == parent.name
    assert tags["lineage.generation"] == "1"
    assert "mlflow.parentRunId" not in client.get_run(ids[0]).data.tags
