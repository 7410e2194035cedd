"""Training against rivals: the pool of snapshots, another run as the rival, and what is refused."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from deepracer_exp.env.setup import build_setup
from deepracer_exp.runs.checkpoints import check, read_checkpoint, read_training
from deepracer_exp.runs.run_files import read_metrics
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.training.rival_pool import RivalPool
from tests.conftest import IN_WORKERS, OFTEN, POOL, RACE, THREE

from .conftest import assert_same_run

SIX, FOUR, TWO = (("budget.env_steps=null", f"budget.iterations={count}") for count in (6, 4, 2))


def snapshots(run) -> list[int]:
    return sorted(map(int, read_training(check(run / "checkpoints" / "last"))["rivals"]))


def test_snapshots_are_taken_at_intervals_and_the_oldest_go(trained):
    assert snapshots(trained(*OFTEN, *POOL, *SIX).folder) == [4, 5, 6]
    run = trained(*OFTEN, *RACE, *SIX, "race.rivals.snapshot_every=4").folder
    assert snapshots(run) == [0, 4]
    won = [row.get("eval_won") for row in read_metrics(run / "metrics.jsonl")]
    assert [value is None for value in won] == [True, False] * 3


def test_a_policy_is_judged_against_an_older_one_than_itself(trained):
    run = StoredRun(trained(*OFTEN, *POOL, *SIX).folder)
    experiment = run.experiment
    first, last = (read_checkpoint(experiment, run.checkpoints, name).networks for name in ("000002", "last"))
    policies = first.policy, last.policy
    often = replace(experiment.race.rivals, snapshot_every=1)
    pool = RivalPool(often, build_setup(experiment), policies[0], None)
    pool.take(4)
    pool._learner = policies[1]
    pool.take(5)
    for before, wanted in ((6, policies[1]), (5, policies[0]), (4, policies[1])):
        found, expected = pool.newest_policy(before).state_dict(), wanted.state_dict()
        assert all(torch.equal(found[name], value) for name, value in expected.items()), before


def test_the_rival_decides_what_is_learned(trained):
    newest = (*RACE, "race.rivals.policy=newest", "race.rivals.snapshot_every=1", "race.rivals.pool_size=3")
    losses = [
        [row["policy_loss"] for row in read_metrics(trained(*OFTEN, *rivals, *SIX).folder / "metrics.jsonl")]
        for rivals in (POOL, newest)
    ]
    # Up to the first iteration with two snapshots, and from then on.
    assert losses[0][:1] == losses[1][:1]
    assert losses[0][2:] != losses[1][2:]


@pytest.mark.usefixtures("workers_start_early")
def test_rivals_reach_the_workers_and_a_resumed_run_of_several_is_the_uninterrupted_one(call, tmp_path):
    def trained_by_two(name: str, *overrides: str):
        ended = call(
            *("train", *IN_WORKERS, "report=false", f"name={name}", *RACE, *OFTEN),
            *("race.rivals.snapshot_every=1", "race.rivals.policy=pool", "race.boxes.number=2", *overrides),
        )
        assert ended.code == 0, ended.stderr
        (config,) = (tmp_path / "runs" / name).glob("*/config.yaml")
        return config.parent

    whole, run = trained_by_two("whole", *THREE), trained_by_two("half", *TWO)
    ended = call("resume", run.name, "budget.iterations=3")
    assert ended.code == 0, ended.stderr
    rows = [
        [(row["policy_loss"], row["mean_return"]) for row in read_metrics(folder / "metrics.jsonl")]
        for folder in (whole, run)
    ]
    assert rows[0] == rows[1]
    assert snapshots(run) == [0, 1, 2, 3]


def test_against_another_run_a_resumed_training_needs_only_its_own_folder(trained, copied, call):
    other = copied("observation.lookahead_m=[0.5,1.0]", *OFTEN, *TWO)  # sees something else, and no other car
    against = (*RACE, *OFTEN, f"race.rivals.policy={other}")
    whole = trained(*against, *FOUR).folder
    run = copied(*against, *THREE)
    kept = run / "rival" / "checkpoints"
    assert [path.name for path in kept.iterdir()] == [(other / "checkpoints" / "best").resolve().name]
    shutil.rmtree(other)
    ended = call("resume", run.name, "budget.iterations=4")
    assert ended.code == 0, ended.stderr
    assert_same_run(run, whole)
    raced = call("evaluate", run.name, "evaluation.trials=2", "evaluation.time_s=2")
    assert raced.code == 0, raced.stderr
    assert "against rival, checkpoint" in raced.stderr.replace("\n", " ")


def test_a_clone_begins_its_pool_with_its_parent_s_policy(copied, call, tmp_path):
    parent = copied(*OFTEN, *POOL, *THREE)
    ended = call("clone", parent.name, "budget.iterations=1", "name=child")
    assert ended.code == 0, ended.stderr
    (child,) = (tmp_path / "runs" / "child").glob("*/config.yaml")
    pool = read_training(check(child.parent / "checkpoints" / "last"))["rivals"]
    from deepracer_exp.runs.stored_run import StoredRun

    policy = StoredRun(parent).with_policy().read_policy().networks.policy
    for name, tensor in policy.state_dict().items():
        np.testing.assert_array_equal(pool["0"][name], tensor.numpy())


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("race.rivals.policy=nobody",), ("race.rivals.policy=nobody: no such run",)),
        (
            ("race.rivals.policy=OTHER",),
            ("race.rivals.policy=", "has other actions: 15 actions", "a run with continuous"),
        ),
        (("race.rivals.policy=SAME", "race.rivals.checkpoint=77"), ("race.rivals.policy=", "77")),
        (("race.rivals.checkpoint=last",), ("race.rivals", "checkpoint=last", "policy=RUN")),
        (("race.rivals.pool_size=0",), ("race.rivals.pool_size",)),
        (("race.bots.number=2",), ("without bots",)),
        (("observation.next_objects=0",), ("would not see",)),
    ],
    ids=lambda value: " ".join(value),
)
def test_rivals_that_cannot_race_are_refused_before_anything_begins(trained, call, overrides, words):
    names = {"OTHER": trained("action_space=discrete").folder, "SAME": trained().folder}
    given = [
        line if (name := line.partition("=")[2]) not in names else line.replace(name, str(names[name]))
        for line in overrides
    ]
    call("train", "experiment=tiny", "tracking=off", *RACE, *given).assert_bad_input(*words)
