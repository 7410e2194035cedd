"""`algorithm=sac` as an ordinary run: resumed bit for bit, cloned, and refused in one line."""

import json
import shutil

import numpy as np
import pytest

from deepracer_exp.runs.run_files import read_config, read_metrics, read_object
from tests.conftest import IN_PROCESS

from .conftest import assert_same_run

SAC = (
    *("action_space=continuous", "algorithm=sac", "algorithm.batch_size=32", "algorithm.warmup_steps=256"),
    *("algorithm.frames_per_iteration=256", "checkpoints.every=2", "episode.max_steps=40"),
    *("evaluation.time_s=4", "evaluation.trials=1"),
)
SMALL = "algorithm.replay_steps=700"
"""Fewer steps than are driven before and after the interruption: the oldest are replaced."""
PICTURES = (
    *("observation=camera_small", "observation.camera.frames=2", "randomization=sim2real"),
    *("network.filters=[4,4,4]", "network.hidden=[16]", "evaluation.time_s=1"),
)


def budget(iterations: int) -> tuple[str, str]:
    return "budget.env_steps=null", f"budget.iterations={iterations}"


def replays(run) -> list[str]:
    return sorted(path.name for path in (run / "replay").iterdir())


@pytest.mark.parametrize(
    "overrides",
    [
        (*SAC, "action_space=discrete"),
        (*SAC, SMALL, *PICTURES),
    ],
    ids=["list", "full, of pictures"],
)
def test_a_run_that_continues_is_the_run_that_was_never_interrupted(trained, copied, call, overrides):
    whole = trained(*overrides, *budget(6))
    assert whole.code == 0, whole.stderr
    run = copied(*overrides, *budget(3))
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert_same_run(run, whole.folder)
    assert "will not be that of an uninterrupted run" not in ended.stderr
    for one in (run, whole.folder):
        assert replays(one)[-1] == "000006"
        assert len(replays(one)) <= 2
        rows = read_metrics(one / "metrics.jsonl")
        assert rows[-1]["gradient_steps"] > 0
        assert all(np.isfinite(rows[-1][name]) for name in ("policy_loss", "value_loss", "alpha", "q_value"))


def test_the_replay_of_a_kill_before_its_checkpoint_is_written_again(trained, copied, call):
    run = copied(*SAC, *budget(3))
    (run / "summary.json").unlink()
    shutil.copytree(run / "replay" / "000003", run / "replay" / "000005")
    shutil.copytree(run / "replay" / "000003", run / "replay" / ".000004")
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert replays(run)[-1] == "000006"
    assert all((run / "checkpoints" / name).is_dir() for name in replays(run))
    assert_same_run(run, trained(*SAC, *budget(6)).folder)


def test_after_a_corrupt_checkpoint_a_run_with_a_replay_is_written_again(trained, copied, call):
    run = copied(*SAC, *budget(3))
    (archive,) = (
        path for path in (run / "checkpoints" / "000003").rglob("state.tdz") if "agent" in str(path)
    )
    archive.write_bytes(archive.read_bytes()[:-20])
    (run / "summary.json").unlink()
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert "using checkpoint 2, the newest intact one" in ended.stderr
    assert_same_run(run, trained(*SAC, *budget(6)).folder)


@pytest.mark.parametrize("damage", ["missing", "corrupt", "a pickle"])
def test_a_replay_that_is_not_whole_is_refused_in_one_line(copied, call, damage):
    run = copied(*SAC, *budget(3))
    (run / "summary.json").unlink()
    replay = run / "replay" / replays(run)[-1]
    if damage == "missing":
        shutil.rmtree(replay)
    elif damage == "corrupt":
        (archive,) = replay.rglob("state.tdz")
        archive.write_bytes(b"PK" + bytes(100))
    else:
        (replay / "rows.pkl").write_bytes(b"cos\nsystem\n")
    before = json.dumps(read_metrics(run / "metrics.jsonl"))
    ended = call("resume", run.name, "budget.iterations=6")
    ended.assert_refused("replay")
    assert json.dumps(read_metrics(run / "metrics.jsonl")) == before


def test_a_clone_begins_with_policy_and_critics_and_an_empty_replay(copied, call, tmp_path):
    run = copied(*SAC, *budget(3))
    ended = call("clone", run.name, "name=clone", *budget(2), "tracking=off")
    assert ended.code == 0, ended.stderr
    (clone,) = (tmp_path / "runs").glob("clone/*")
    first, second = read_metrics(clone / "metrics.jsonl")
    assert read_config(clone)["algorithm"]["lr"] == pytest.approx(read_config(run)["algorithm"]["lr"] / 10)
    # The temperature that the parent had learned by its best checkpoint, not that it had begun with.
    best = int((run / "checkpoints" / "best").resolve().name)
    learned = {row["iteration"]: row["alpha"] for row in read_metrics(run / "metrics.jsonl")}
    assert read_config(clone)["algorithm"]["alpha"] == learned[best] != read_config(run)["algorithm"]["alpha"]
    assert (first["gradient_steps"], second["gradient_steps"]) == (4, 4)
    assert (first["replay_steps"], second["replay_steps"]) == (256, 512)
    start, last = (
        read_object(clone / "checkpoints" / name / "manifest.json")["metadata"]["iteration"]
        for name in ("best", "last")
    )
    assert (start, last) != (0, 0)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("algorithm.epochs=3",), ("algorithm.epochs", "no such key")),
        (("lr_schedule=adaptive_kl",), ("lr_schedule=adaptive_kl", "linear")),
        (("network=mlp_small_shared",), ("network.shared_trunk=true", "accepted: false")),
        (("algorithm.tau=0",), ("algorithm.tau=0",)),
        (("algorithm.replay_steps=10",), ("replay_steps=10", "accepted")),
        (
            ("observation=camera_small", "algorithm.replay_mb=1", "collector.cars=256"),
            ("replay_mb=1", "accepted"),
        ),
    ],
)
def test_what_sac_cannot_do_is_refused_in_one_line(call, overrides, words):
    call("train", *IN_PROCESS, "action_space=continuous", "algorithm=sac", *overrides).assert_bad_input(
        *words
    )


def test_a_clone_keeps_the_algorithm_whose_networks_it_begins_with(copied, call):
    run = copied(*SAC, *budget(3))
    ended = call("clone", run.name, "algorithm=ppo", "name=clone")
    ended.assert_refused("algorithm: cannot be changed in a clone: SAC -> PPO")


def test_keys_of_sac_are_refused_with_ppo(call):
    call("train", *IN_PROCESS, "algorithm.alpha=0.1").assert_bad_input("algorithm.alpha", "no such key")
