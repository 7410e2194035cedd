"""`deepracer-exp clone`: a new run with another run's policy, and what it records of its parent."""

import json
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from torchrl.checkpoint import Checkpoint

from deepracer_exp.runs.checkpoint_files import checkpoint_sha256, pinned
from deepracer_exp.runs.checkpoints import State
from deepracer_exp.runs.run_files import read_config, read_object
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.training.clone import plan_clone
from tests.conftest import OFTEN, THREE


def config(folder) -> dict:
    return yaml.safe_load((folder / "config.yaml").read_text())


def lineage(folder) -> dict:
    return json.loads((folder / "lineage.json").read_text())


def agent_of(folder, name: str) -> dict:
    """Return networks, optimizer and schedule of a checkpoint."""
    state = State({})
    Checkpoint(agent=state).load(folder / "checkpoints" / name)
    return state.values


@pytest.fixture
def parent(copied):
    return copied(*OFTEN, *THREE)


def child_of(parent, ended):
    assert ended.code == 0, ended.stderr
    (child,) = (folder for folder in ended.folders if folder != parent)
    return child


def test_a_clone_begins_with_the_parents_best_policy_and_learns_at_a_tenth_of_its_rate(parent, call):
    # Steps of no size: what it ends with is what it began with.
    still = "algorithm.max_grad_norm=1e-9"
    child = child_of(parent, call("clone", parent.name, "budget.iterations=1", still))
    ours, theirs = agent_of(child, "last"), agent_of(parent, "best")
    for name, value in theirs["networks"].items():
        assert torch.allclose(ours["networks"][name], value, atol=2e-3)
    steps = [[one["step"].item() for one in agent["optimizer"]["state"].values()] for agent in (ours, theirs)]
    assert max(steps[0]) < min(steps[1])  # a fresh optimizer
    before, after = config(parent), config(child)
    assert after["algorithm"].pop("lr") == pytest.approx(before["algorithm"].pop("lr") / 10)
    for group, key in (("budget", "iterations"), ("algorithm", "max_grad_norm")):
        before[group].pop(key), after[group].pop(key)
    assert before == after


def test_the_schedules_of_a_clone_follow_its_own_budget(parent):
    stored = config(parent)
    stored["budget"]["schedule_until"] = 0.5
    (parent / "config.yaml").write_text(yaml.safe_dump(stored))
    for changes, until in (([], 1.0), (["budget.schedule_until=0.3"], 0.3)):
        clone = plan_clone(StoredRun(parent).with_checkpoint(), changes).experiment
        assert clone.budget.schedule_until == until


def test_a_clone_of_a_sweeps_trial_runs_as_a_training_does(parent):
    def clone(*changes):
        return plan_clone(StoredRun(parent).with_checkpoint(), changes).experiment

    stored = read_config(parent)
    assert (stored["report"], stored["collector"]["mode"]) == (False, "in_process")
    assert (clone().report, clone().collector.mode) == (False, "in_process")
    summary = read_object(parent / "summary.json")
    (parent / "summary.json").write_text(json.dumps({**summary, "study": "s", "trial": 3}))
    assert clone().report
    assert (clone().collector.mode, clone().collector.processes) == ("sync", None)
    assert clone().collector.cars == stored["collector"]["cars"]
    assert clone("collector=in_process").collector.mode == "in_process"


def test_a_clone_knows_where_it_comes_from_and_the_parent_keeps_the_checkpoint(parent, call):
    child = child_of(parent, call("clone", parent.name, "budget.iterations=1"))
    best = (parent / "checkpoints" / "best").resolve()
    recorded = lineage(child)
    assert (recorded["parent"], recorded["checkpoint"]) == (parent.name, best.name)
    assert (recorded["sha256"], recorded["generation"]) == (checkpoint_sha256(best), 1)
    assert list(pinned(parent / "checkpoints")) == [best.name]
    ended = call("clone", child.name, "checkpoint=last", "budget.iterations=1")
    assert ended.code == 0, ended.stderr
    (grandchild,) = (folder for folder in ended.folders if folder not in (parent, child))
    assert (lineage(grandchild)["parent"], lineage(grandchild)["generation"]) == (child.name, 2)
    assert config(grandchild)["algorithm"]["lr"] == pytest.approx(config(parent)["algorithm"]["lr"] / 100)


def test_a_copy_without_links_is_cloned_and_evaluated_from_the_same_checkpoint(parent, call):
    best = (parent / "checkpoints" / "best").resolve().name
    copied = Path(shutil.copytree(parent, parent.with_name("copied")))
    shutil.rmtree(parent)
    ended = call("evaluate", str(copied), "evaluation.trials=1", "evaluation.laps=1", "evaluation.time_s=3")
    assert ended.code == 0, ended.stderr
    assert f"checkpoint {int(best)}" in ended.stderr
    child = child_of(copied, call("clone", str(copied), "budget.iterations=1"))
    assert lineage(child)["checkpoint"] == best
    assert list(pinned(copied / "checkpoints")) == [best]
    assert call("runs", "lineage", str(child)).code == 0


@pytest.mark.parametrize(("override", "lr"), [("algorithm.lr=3e-4", 3e-4), ("algorithm=ppo", 1.3e-3)])
def test_a_rate_that_is_given_is_taken(parent, override, lr):
    plan = plan_clone(StoredRun(parent).with_checkpoint(), ["budget.iterations=1", override])
    assert plan.experiment.algorithm.lr == pytest.approx(lr)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["action_space=deepracer"], ["action_space", "->", "5 actions", "networks were made for it"]),
        (["action_space=discrete"], ["action_space", "continuous"]),
        (["network=mlp_deep"], ["network", "hidden"]),
        (["observation.lookahead_m=[1.0]"], ["observation", "features"]),
        (["experiment=tiny"], ["experiment=tiny", "give the groups"]),
        (["checkpoint=77"], ["checkpoint=77", "not there"]),
        (["checkpoint=../../x"], ["a checkpoint is best, last, fastest or the number"]),
        (["algorithm.rate=1"], ["algorithm.rate: no such key"]),
    ],
)
def test_what_the_parents_networks_do_not_fit_is_refused(parent, call, overrides, words):
    ended = call("clone", parent.name, "budget.iterations=1", *overrides)
    ended.assert_refused(*words)
    assert ended.folders == [parent]


def test_another_track_or_reward_is_allowed_and_warned_of(parent, call):
    changes = ("track=Oval_track", "reward=speed_on_track", "lr_schedule=linear")
    ended = call("clone", parent.name, "budget.iterations=1", *changes)
    child = child_of(parent, ended)
    assert "warning: track is not the parent's" in ended.stderr
    assert "warning: reward is not the parent's" in ended.stderr
    assert "Oval_track-speed_on_track" in child.name
    provenance = json.loads((child / "provenance.json").read_text())
    assert provenance["names"]["track"] == "Oval_track"
    assert provenance["names"]["action_space"] == "continuous"
    assert config(child)["algorithm"]["lr"] == pytest.approx(1.3e-4)


@pytest.mark.processes
def test_in_mlflow_a_clone_stands_under_its_parent(call, mlflow_here):
    quick = ("experiment=tiny", "collector=in_process", "collector.threads=1", *OFTEN, *THREE)
    ended = call("train", *quick)
    assert ended.code == 0, ended.stderr
    parent = ended.folder
    child = child_of(parent, call("clone", parent.name, "budget.iterations=1"))
    ids = [json.loads((folder / "mlflow.json").read_text())["run_id"] for folder in (parent, child)]
    tags = mlflow_here.get_run(ids[1]).data.tags
    assert tags["mlflow.parentRunId"] == ids[0]
    assert tags["lineage.parent"] == parent.name
    assert tags["lineage.generation"] == "1"
    assert "mlflow.parentRunId" not in mlflow_here.get_run(ids[0]).data.tags
