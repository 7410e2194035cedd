"""`deepracer-exp resume`: the rest of a run is what it would have been."""

import json
import shutil

import pytest
import torch
import yaml
from mlflow import MlflowClient

from benchmarks.same import different_rows, different_tensors, different_traces
from deepracer_exp.runs.checkpoint_files import verify
from deepracer_exp.runs.checkpoints import read_checkpoint, read_training
from deepracer_exp.runs.files import read_metrics
from deepracer_exp.runs.folder import RunFolder
from deepracer_exp.runs.resolve import resolve
from deepracer_exp.training.metrics import TIMES
from deepracer_exp.training.trainer import Trainer
from tests.conftest import IN_PROCESS

# Reached sooner than a lap: episodes end often.
OFTEN = ("episode.max_steps=60", "checkpoints.every=2", "algorithm.frames_per_iteration=512")

# Ends a run after three iterations.
SOON = ("stopping=plateau", *(f"stopping.{one}" for one in ("window=1", "warmup=2", "patience=2", "gain=1")))


def rows(folder) -> list[dict]:
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [{key: value for key, value in json.loads(line).items() if key not in TIMES} for line in lines]


def assert_same_run(one, other) -> None:
    assert different_rows(read_metrics(one / "metrics.jsonl"), read_metrics(other / "metrics.jsonl")) is None
    assert different_tensors(*(folder / "checkpoints" / "last" for folder in (one, other))) is None
    assert different_traces(one, other) is None
    best = [json.loads((folder / "summary.json").read_text())["best"] for folder in (one, other)]
    assert best[0] == best[1]
    labels = [(folder / "checkpoints" / "best").readlink() for folder in (one, other)]
    assert labels[0] == labels[1]


@pytest.fixture
def cut(trained, tmp_path):
    """Return a function that gives a copy of the run that ended after three of six iterations."""

    def make(*overrides):
        ended = trained(*OFTEN, *overrides, "budget.env_steps=null", "budget.iterations=3")
        assert ended.code == 0, ended.stderr
        copy = tmp_path / "runs" / "tiny" / ended.folder.name
        shutil.copytree(ended.folder, copy, symlinks=True)
        return copy

    return make


def whole(trained, *overrides):
    ended = trained(*OFTEN, *overrides, "budget.env_steps=null", "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    return ended.folder


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("action_space=continuous", "randomization=sim2real", "network=mlp_small_shared"),
        (
            "track=[reinvent_base,Oval_track]",
            "track.Oval_track.direction=alternate",
            "lr_schedule=adaptive_kl",
        ),
        ("checkpoints.every=null", "reward=speed_on_track"),
        (
            *("observation=camera_small", "observation.camera.frames=2", "randomization=sim2real"),
            "algorithm.frames_per_iteration=256",
        ),
        ("observation=lidar", "randomization=sim2real"),
    ],
    ids=lambda overrides: " ".join(overrides) or "as it is",
)
def test_a_run_that_continues_is_the_run_that_was_never_interrupted(trained, cut, call, overrides):
    run = cut(*overrides)
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert_same_run(run, whole(trained, *overrides))
    assert json.loads((run / "summary.json").read_text())["iteration"] == 6
    assert "will not be that of an uninterrupted run" not in ended.stderr


def test_what_was_written_after_the_checkpoint_is_written_again(trained, cut, call):
    run = cut()
    with (run / "metrics.jsonl").open("a") as metrics:
        metrics.write(json.dumps({"iteration": 4, "env_steps": 1}) + '\n{"iteration": 5, "en')
    (run / "trace" / "00004-iteration.parquet").write_bytes(b"half")
    (run / "checkpoints" / ".000004").mkdir()
    (run / "summary.json").unlink()
    assert call("resume", run.name, "budget.iterations=6").code == 0
    assert_same_run(run, whole(trained))


def test_an_incomplete_last_checkpoint_is_replaced_by_the_newest_intact_one_loudly(trained, cut, call):
    run = cut()
    archives = (run / "checkpoints" / "000003").rglob("state.tdz")
    (archive,) = (path for path in archives if "training" in path.parent.name)
    archive.write_bytes(archive.read_bytes()[:-20])
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert "000003: corrupt" in ended.stderr
    assert "using 000002, the newest intact one" in ended.stderr
    assert_same_run(run, whole(trained))


def test_with_no_intact_checkpoint_nothing_is_begun(cut, call):
    run = cut()
    for hashes in (run / "checkpoints").glob("0*/hashes.json"):
        hashes.write_text("{}")
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 2
    assert "is intact" in ended.complaint
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_a_run_killed_as_soon_as_it_is_one_begins_again_and_is_recorded_once(trained, start, call, tmp_path):
    killed = start("train", *IN_PROCESS, *OFTEN, "budget.env_steps=null", "budget.iterations=6")
    (config,) = killed.wait_for(lambda: list(tmp_path.glob("runs/*/*/config.yaml")), "run")
    killed.popen.kill()
    killed.popen.wait()
    run = config.parent
    assert not (run / "tracking.json").exists()
    ended = call("resume", run.name, "tracking=mlflow")
    assert ended.code == 0, ended.stderr
    assert f"{run.name}: had no checkpoint yet: begins again" in ended.stderr
    assert_same_run(run, whole(trained))
    client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path / 'runs' / 'mlflow.db'}")
    (experiment,) = [one for one in client.search_experiments() if one.name == "tiny"]
    (recorded,) = client.search_runs([experiment.experiment_id])
    assert recorded.info.status == "FINISHED"


def test_a_clone_killed_as_soon_as_it_is_one_begins_again_with_its_parents_policy(cut, call, monkeypatch):
    parent = cut()

    def killed(self, interruption):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "fit", killed)
        call("clone", parent.name, "name=killed", "checkpoint=last")
    (run,) = (parent.parents[1] / "killed").iterdir()
    experiment = resolve(str(run), run.parents[1], None).experiment
    states = [
        read_checkpoint(experiment, folder / "checkpoints", "last").networks.state_dict()
        for folder in (run, parent)
    ]
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
    ended = call("resume", run.name)
    assert (ended.code, len(rows(run))) == (0, 3), ended.stderr


def test_a_run_killed_while_it_was_ending_is_ended_and_not_driven_on(cut, call):
    run = cut()
    before, summary = rows(run), json.loads((run / "summary.json").read_text())
    (run / "summary.json").unlink()
    assert call("resume", run.name).code == 0
    assert rows(run) == before
    again = json.loads((run / "summary.json").read_text())
    for key in ("status", "reason", "iteration", "env_steps", "best", "last"):
        assert again[key] == summary[key]


def test_a_run_killed_after_its_stopping_rule_had_decided_is_ended(trained, call, tmp_path):
    stopped = trained("stopping=reliable", "stopping.episodes=20", "stopping.lap_share=0")
    copy = tmp_path / "runs" / "tiny" / stopped.folder.name
    shutil.copytree(stopped.folder, copy, symlinks=True)
    (copy / "summary.json").unlink()
    assert call("resume", copy.name).code == 0
    again = json.loads((copy / "summary.json").read_text())
    assert {key: again[key] for key in ("reason", "stopping", "reliable")} == {
        key: stopped.summary[key] for key in ("reason", "stopping", "reliable")
    }
    assert rows(copy) == rows(stopped.folder)


@pytest.fixture
def stopped(trained, tmp_path):
    """Return a copy of a run that its stopping rule ended after three of six iterations."""
    ended = trained(*OFTEN, *SOON, "budget.env_steps=null", "budget.iterations=6")
    assert (ended.summary["stopping"]["rule"], ended.summary["iteration"]) == ("plateau", 3)
    copy = tmp_path / "runs" / "tiny" / ended.folder.name
    shutil.copytree(ended.folder, copy, symlinks=True)
    return copy


def test_a_run_ended_by_its_stopping_rule_uses_its_budget_up_without_it(trained, stopped, call):
    ended = call("resume", stopped.name, "stopping=none")
    assert ended.code == 0, ended.stderr
    assert_same_run(stopped, whole(trained))
    summary = json.loads((stopped / "summary.json").read_text())
    assert (summary["reason"], summary["stopping"]) == ("budget reached: iterations", None)


def test_a_run_that_drives_reliably_continues_without_its_rule(call):
    reliable = (
        "stopping=reliable",
        "stopping.lap_share=0.0",
        "budget.env_steps=null",
        "budget.iterations=30",
    )
    quick = ("experiment=tiny", "collector=in_process", "tracking=off", "evaluation.trials=1")
    ended = call("train", *quick, *reliable)
    assert ended.summary["stopping"]["rule"] == "reliable", ended.stderr
    more = f"budget.iterations={ended.summary['iteration'] + 1}"
    other = call("resume", ended.folder.name, "stopping=reliable", "stopping.episodes=10", more)
    assert "stopping.episodes: 50 -> 10" in other.complaint
    assert call("resume", ended.folder.name, "stopping=none", more).code == 0


def test_a_run_that_others_have_pruned_continues_if_asked_which_rule_counts(trained, stopped, call):
    summary = json.loads((stopped / "summary.json").read_text())
    pruned = {"status": "stopped early", "reason": "median: 9.1 is worse", "stopping": None}
    (stopped / "summary.json").write_text(json.dumps(summary | pruned))
    config = yaml.safe_load((stopped / "config.yaml").read_text())
    (stopped / "config.yaml").write_text(yaml.safe_dump(config | {"stopping": {"kind": "none"}}))
    ended = call("resume", stopped.name)
    assert ended.code == 2
    assert "stopping=none resumes it anyway" in ended.complaint
    ended = call("resume", stopped.name, "stopping=none")
    assert ended.code == 0, ended.stderr
    assert_same_run(stopped, whole(trained))


def test_mlflow_does_not_name_a_rule_that_no_longer_ends_the_run(call, tmp_path):
    quick = ("experiment=tiny", "collector=in_process", "collector.threads=1", *OFTEN)
    ended = call("train", *quick, *SOON, "budget.env_steps=null", "budget.iterations=4")
    client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path / 'runs' / 'mlflow.db'}")
    run_id = json.loads((ended.folder / "tracking.json").read_text())["run_id"]
    assert client.get_run(run_id).data.tags["stopping.rule"] == "plateau"
    assert call("resume", ended.folder.name, "stopping=none").code == 0
    tags = client.get_run(run_id).data.tags
    assert (tags["stopping.rule"], tags["end"]) == ("none", "finished: budget reached: iterations")


def test_a_rule_that_has_seen_enough_ends_the_run_again(stopped, call):
    before = rows(stopped)
    assert call("resume", stopped.name, "stopping.warmup=1").code == 0
    assert rows(stopped) == before
    assert json.loads((stopped / "summary.json").read_text())["stopping"]["rule"] == "plateau"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["stopping=reliable", "stopping.episodes=20"], ["stopping.episodes: \N{EN DASH} -> 20"]),
        (["algorithm.lr=1e-5"], ["algorithm.lr: 0.001 -> 1e-05", "deepracer-exp clone"]),
        (["track=Oval_track"], ["track.name", "Oval_track"]),
        (["algorithm.learning_rate=1"], ["algorithm.learning_rate: no such key"]),
        (["experiment=fast_lap"], ["experiment=fast_lap", "give the groups and values"]),
        (["budget.iterations=many"], ["budget.iterations"]),
    ],
)
def test_another_configuration_is_refused_with_what_differs(cut, call, overrides, words):
    run = cut()
    before = (run / "metrics.jsonl").read_bytes()
    ended = call("resume", run.name, "budget.iterations=6", *overrides)
    assert ended.code == 2, ended.stderr
    for word in words:
        assert word in ended.complaint
    assert (run / "metrics.jsonl").read_bytes() == before
    assert (run / "summary.json").exists()


def test_a_config_file_changed_by_hand_is_refused(cut, call):
    run = cut()
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["algorithm"]["entropy_coeff"] = 0.5
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 2
    assert "algorithm.entropy_coeff: 0.01 -> 0.5" in ended.complaint


def test_a_reward_function_changed_since_is_refused(trained, call, tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("def reward_function(params):\n    return params['speed']\n")
    ended = trained(*OFTEN, f"reward.file={file}", "budget.iterations=2")
    copy = tmp_path / "runs" / "tiny" / ended.folder.name
    shutil.copytree(ended.folder, copy, symlinks=True)
    file.write_text("def reward_function(params):\n    return 2 * params['speed']\n")
    ended = call("resume", copy.name, "budget.iterations=4")
    assert ended.code == 2
    assert "reward mine has other contents" in ended.complaint


def test_a_reward_function_with_a_memory_is_reported(trained, call, tmp_path):
    file = tmp_path / "memory.py"
    file.write_text(
        "seen = 0\ndef reward_function(params):\n    global seen\n    seen += 1\n    return 1.0\n"
    )
    ended = trained(*OFTEN, f"reward.file={file}", "budget.iterations=2")
    copy = tmp_path / "runs" / "tiny" / ended.folder.name
    shutil.copytree(ended.folder, copy, symlinks=True)
    ended = call("resume", copy.name, "budget.iterations=3")
    assert ended.code == 0
    assert "will not be that of an uninterrupted run: the reward function memory keeps" in ended.stderr


def test_a_run_at_its_end_is_refused_with_what_can_be_done(cut, trained, call, tmp_path):
    run = cut()
    ended = call("resume", run.name)
    assert ended.code == 2
    assert "budget reached: iterations" in ended.complaint
    assert "budget.iterations=" in ended.complaint
    stopped = trained("stopping=reliable", "stopping.episodes=20", "stopping.lap_share=0")
    copy = tmp_path / "runs" / "tiny" / stopped.folder.name
    shutil.copytree(stopped.folder, copy, symlinks=True)
    ended = call("resume", copy.name, "budget.env_steps=99999")
    assert ended.code == 2
    assert "deepracer-exp clone " in ended.complaint


def test_a_run_that_is_being_trained_is_left_alone(cut, call):
    run = cut()
    folder = RunFolder(run)
    ended = call("resume", run.name, "budget.iterations=6")
    folder.release()
    assert ended.code == 2
    assert "a process is training in it" in ended.complaint


def test_lost_lines_of_metrics_are_refused(cut, call):
    run = cut()
    lines = (run / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run / "metrics.jsonl").write_text("".join(lines[:2]))
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 2
    assert "has 2 of the 3 rows" in ended.complaint


def test_every_checkpoint_that_is_kept_is_whole_and_knows_the_best(cut):
    run = cut()
    kept = sorted((run / "checkpoints").glob("0*"))
    assert [path.name for path in kept] == ["000002", "000003"]
    for path in kept:
        verify(path)
        state = read_training(path)
        assert state["iteration"] == int(path.name)
        assert state["best"]["iteration"] == 2
