"""`deepracer-exp resume`: the rest of a run is what it would have been."""

import json
import os
import shutil
import signal

import pytest
import torch
import yaml

from deepracer_exp.agents.ppo import PPO
from deepracer_exp.collectors import collector
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.setup import build_setup
from deepracer_exp.errors import RunFailed
from deepracer_exp.runs.checkpoints import check, checkpoint_name, read_checkpoint, read_training
from deepracer_exp.runs.folder import RunFolder
from deepracer_exp.runs.run_files import read_metrics, read_object
from deepracer_exp.runs.run_result import FINISHED, Ending
from deepracer_exp.tracking.resolve import resolve
from deepracer_exp.training import signals
from deepracer_exp.training.plan import plan_training
from deepracer_exp.training.run import run_training
from deepracer_exp.training.train_result import TakenOver
from deepracer_exp.training.trainer import Trainer
from tests.conftest import IN_PROCESS, IN_WORKERS, OFTEN, POOL, THREE
from tests.waiting import wait_until

from .conftest import assert_same_run

# Ends a run after three iterations.
SOON = ("stopping=plateau", *(f"stopping.{one}" for one in ("window=1", "warmup=2", "patience=2", "gain=1")))
RELIABLE = ("stopping=reliable", "stopping.episodes=20", "stopping.lap_share=0")


def rows(folder) -> list[dict]:
    return read_metrics(folder / "metrics.jsonl")


def summary(folder) -> dict:
    return read_object(folder / "summary.json")


@pytest.fixture
def cut(copied):
    """Return a function that gives a copy of the run that ended after three of six iterations."""
    return lambda *overrides: copied(*OFTEN, *overrides, *THREE)


def whole(trained, *overrides):
    ended = trained(*OFTEN, *overrides, "budget.env_steps=null", "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    return ended.folder


@pytest.mark.parametrize(
    "overrides",
    [
        ("action_space=continuous", "randomization=sim2real", "network=mlp_small_shared"),
        (
            *("track=[reinvent_base,Oval_track]", "track.Oval_track.direction=alternate"),
            *("lr_schedule=adaptive_kl", "reward=speed_on_track"),
        ),
        (
            *("observation=camera_lidar", "network.filters=[4,4,4]"),
            *("randomization=real_car", "action_space.steering_angle.high=20", "collector.cars=2"),
            *("algorithm.frames_per_iteration=32", "algorithm.batch_size=16", "checkpoints.every=null"),
        ),
        POOL,
    ],
    ids=" ".join,
)
def test_a_run_that_continues_is_the_run_that_was_never_interrupted(trained, cut, call, overrides):
    run = cut(*overrides)
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert_same_run(run, whole(trained, *overrides))
    assert summary(run)["iteration"] == 6
    assert "will not be that of an uninterrupted run" not in ended.stderr


@pytest.mark.usefixtures("workers_start_early")
def test_a_run_continues_on_a_machine_with_fewer_cores(call, tmp_path, monkeypatch):
    def trained(name: str, *words: str):
        ended = call(*words, *OFTEN, "budget.env_steps=null", f"name={name}")
        assert ended.code == 0, ended.stderr
        (folder,) = (tmp_path / "runs" / name).iterdir()
        return folder

    new = ("train", *IN_WORKERS, "collector.processes=null", "collector.cars=16")
    monkeypatch.setattr(collector, "cores", lambda: 2)
    whole, run = trained("whole", *new, "budget.iterations=4"), trained("cut", *new, "budget.iterations=2")
    monkeypatch.setattr(collector, "cores", lambda: 1)
    ended = call("resume", str(run), "budget.iterations=4")
    assert ended.code == 0, ended.stderr
    assert_same_run(run, whole)


SCHEDULED = ("lr_schedule=linear", "algorithm.entropy_end_factor=0.1")


def test_a_larger_budget_that_moves_the_schedules_says_so_and_how_they_are_held(cut, call):
    run = cut(*SCHEDULED)
    last = rows(run)[-1]["lr"]
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    (line,) = (line for line in ended.stderr.splitlines() if "budget.schedule_until" in line)
    assert line == (
        "warning: budget.iterations=6: with this budget the learning rate goes from 0.00013 to 0.00072 and the "
        "entropy bonus goes from 0.001 to 0.0055; add budget.schedule_until=0.5 to hold the schedule of the run"
    )
    assert last < rows(run)[3]["lr"] == pytest.approx(0.55 * 1.3e-3)


def test_a_run_whose_schedules_are_held_is_one_that_was_never_interrupted(trained, cut, call):
    held = "budget.schedule_until=0.5"
    run = cut(*SCHEDULED)
    ended = call("resume", run.name, "budget.iterations=6", held)
    assert ended.code == 0, ended.stderr
    assert "the learning rate goes" not in ended.stderr
    assert_same_run(run, whole(trained, *SCHEDULED, held))
    assert [row["lr"] for row in rows(run)[3:]] == pytest.approx([1.3e-4] * 3)


@pytest.mark.processes
def test_the_clock_begins_with_the_first_step_and_goes_on_where_it_stopped(cut, call, monkeypatch):
    seen = []

    class Watched(Trainer):
        def _start(self):
            before = self.wall_clock_s
            collector = super()._start()
            seen.append((before, self.wall_clock_s))
            return collector

    run = cut()
    stored = read_training(check(run / "checkpoints" / "last"))["wall_clock_s"]
    monkeypatch.setattr("deepracer_exp.training.reopened_run.Trainer", Watched)
    ended = call("resume", run.name, "budget.iterations=4")
    assert ended.code == 0, ended.stderr
    assert seen == [(stored, stored)]
    assert rows(run)[-1]["wall_clock_s"] > stored


def test_a_resumed_run_reports_the_first_lap_that_it_drove_before(tmp_path):
    experiment, composition = compose_experiment(["experiment=tiny"])
    folder = RunFolder(tmp_path)
    trainer = Trainer(experiment, build_setup(experiment), folder, composition.mapping, ())
    trainer.save()
    checkpoint = check(trainer.checkpoints.folder / "last")
    lap = {"env_steps": 512, "since_process_start_s": 2.5}
    trainer.load(checkpoint, read_training(checkpoint) | {"first_lap": lap})
    trainer.end(Ending(FINISHED, "the budget is used up"), 0)
    assert summary(tmp_path)["first_lap"] == lap


def test_a_copy_without_links_continues_as_the_run_itself(trained, cut, call):
    run = cut()
    original = run.rename(run.with_name(f"{run.name}-original"))
    shutil.copytree(original, run)  # follows the links, as `cp -rL` does
    shutil.rmtree(original)
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert "will not be that of an uninterrupted run" not in ended.stderr
    assert_same_run(run, whole(trained))
    for label in ("best", "last"):
        assert (run / "checkpoints" / label).is_symlink()


@pytest.mark.parametrize("is_there", [True, False], ids=["beside its original", "alone"])
def test_a_copied_run_gets_a_record_of_its_own_and_a_moved_one_keeps_it(cut, call, is_there):
    original = cut()
    tracked = {
        "run_name": "1",
        "experiment": "tiny",
        "start_ms": 0,
        "tags": {"run_dir": str(original.resolve())},
    }
    (original / "tracking.json").write_text(json.dumps(tracked))
    (original / "mlflow.json").write_text(json.dumps({"run_id": "0" * 32}))
    run = shutil.copytree(original, original.with_name("copy"), symlinks=True)
    if not is_there:
        shutil.rmtree(original)
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert (run / "mlflow.json").exists() is not is_there
    wanted = run if is_there else original
    assert read_object(run / "tracking.json")["tags"]["run_dir"] == str(wanted.resolve())
    assert not is_there or read_object(original / "mlflow.json")["run_id"] == "0" * 32


def test_after_a_corrupt_checkpoint_the_run_is_written_again_from_the_newest_intact_one(trained, cut, call):
    run = cut()
    with (run / "metrics.jsonl").open("a") as metrics:
        metrics.write(json.dumps({"iteration": 4, "env_steps": 1}) + '\n{"iteration": 5, "en')
    (run / "trace" / "00004-iteration.parquet").write_bytes(b"half")
    (run / "checkpoints" / ".000004").mkdir()
    (run / "summary.json").unlink()
    archives = (run / "checkpoints" / "000003").rglob("state.tdz")
    (archive,) = (path for path in archives if "training" in path.parent.name)
    archive.write_bytes(archive.read_bytes()[:-20])
    ended = call("resume", run.name, "budget.iterations=6")
    assert ended.code == 0, ended.stderr
    assert "000003: corrupt" in ended.stderr
    assert "using checkpoint 2, the newest intact one" in ended.stderr
    assert_same_run(run, whole(trained))


def test_past_a_damaged_best_checkpoint_a_later_one_becomes_the_best(cut, call):
    run = cut()
    best, last = (run / "checkpoints" / name for name in ("best", "last"))
    iterations = 4
    while iterations == 4 or best.resolve() == last.resolve():  # until the newest policy is not the best one
        iterations += 2
        assert iterations < 100, "each policy was better than all before it"
        ended = call("resume", run.name, f"budget.iterations={iterations}")
        assert ended.code == 0, ended.stderr
    best = best.resolve()
    for archive in best.rglob("state.tdz"):
        archive.write_bytes(archive.read_bytes()[:-20])
    ended = call("resume", run.name, f"budget.iterations={iterations + 1}")
    assert ended.code == 0, ended.stderr
    assert f"the best checkpoint so far, {best.name}, is lost" in ended.stderr
    named = checkpoint_name(summary(run)["best"]["iteration"])
    assert check(run / "checkpoints" / "best").name == named != best.name


def test_a_resumed_run_that_fails_says_so_in_one_line(cut, call, monkeypatch):
    def lose_a_wheel(trainer, interruption):
        raise RunFailed("a wheel is off")

    run = cut()
    monkeypatch.setattr(Trainer, "fit", lose_a_wheel)
    ended = call("resume", run.name, "budget.iterations=6")
    ended.assert_run_failed("run failed: a wheel is off")
    assert ended.stderr.count("a wheel is off") == 1
    assert "Traceback" not in ended.stderr
    assert "Traceback" in (run / "log.txt").read_text()


@pytest.mark.processes
def test_a_run_killed_as_soon_as_it_is_one_begins_again_and_is_recorded_once(
    trained, call, mlflow_here, tmp_path, monkeypatch
):
    def killed(self, interruption):
        raise TakenOver  # from here on nothing is written, as after a kill

    composed = compose_experiment([*IN_PROCESS, *OFTEN, *THREE, f"runs_dir={tmp_path / 'runs'}"])
    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "fit", killed)
        with pytest.raises(TakenOver):
            run_training(plan_training(*composed))
    (config,) = tmp_path.glob("runs/*/*/config.yaml")
    run = config.parent
    assert not (run / "tracking.json").exists()
    assert not (run / "summary.json").exists()
    ended = call("resume", run.name, "tracking=mlflow")
    assert ended.code == 0, ended.stderr
    assert f"{run.name}: had no checkpoint yet: begins again" in ended.stderr
    assert_same_run(run, trained(*OFTEN, *THREE).folder)
    (experiment,) = [one for one in mlflow_here.search_experiments() if one.name == "tiny"]
    (recorded,) = mlflow_here.search_runs([experiment.experiment_id])
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
    ended = call("resume", run.name, "budget.iterations=1")
    assert (ended.code, len(rows(run))) == (0, 1), ended.stderr


@pytest.mark.parametrize("own", [(*OFTEN, *THREE), RELIABLE], ids=["budget", "rule"])
def test_a_run_killed_while_it_was_ending_is_ended_and_not_driven_on(copied, call, own):
    run = copied(*own)
    before, wanted = rows(run), summary(run)
    (run / "summary.json").unlink()
    assert call("resume", run.name).code == 0
    assert rows(run) == before
    for key in ("status", "reason", "iteration", "env_steps", "best", "last", "stopping", "reliable"):
        assert summary(run)[key] == wanted[key]


def test_a_run_that_drives_reliably_may_be_cloned_but_not_measured_by_other_episodes(copied, call):
    run = copied(*RELIABLE)
    call("resume", run.name, "budget.env_steps=99999").assert_refused("deepracer-exp clone ")
    other = call("resume", run.name, "stopping=reliable", "stopping.episodes=10")
    other.assert_refused("stopping.episodes: 20 -> 10")


@pytest.fixture
def stopped(copied):
    """Return a copy of a run that its stopping rule ended after three of six iterations."""
    run = copied(*OFTEN, *SOON, "budget.env_steps=null", "budget.iterations=6")
    assert (summary(run)["stopping"]["rule"], summary(run)["iteration"]) == ("plateau", 3)
    return run


@pytest.mark.parametrize("by", ["its rule", "others"])
def test_a_run_that_was_stopped_uses_its_budget_up_if_no_rule_is_asked_for(trained, stopped, call, by):
    if by == "others":
        pruned = {"status": "stopped early", "reason": "median: 9.1 is worse", "stopping": None}
        (stopped / "summary.json").write_text(json.dumps(summary(stopped) | pruned))
        config = yaml.safe_load((stopped / "config.yaml").read_text())
        (stopped / "config.yaml").write_text(yaml.safe_dump(config | {"stopping": {"kind": "none"}}))
    call("resume", stopped.name).assert_refused("stopping=none resumes it anyway")
    ended = call("resume", stopped.name, "stopping=none")
    assert ended.code == 0, ended.stderr
    assert_same_run(stopped, whole(trained))
    found = summary(stopped)
    assert (found["reason"], found["stopping"]) == ("budget reached: iterations", None)


@pytest.mark.processes
def test_mlflow_does_not_name_a_rule_that_no_longer_ends_the_run(call, mlflow_here):
    quick = ("experiment=tiny", "collector=in_process", "collector.threads=1", *OFTEN)
    ended = call("train", *quick, *SOON, "budget.env_steps=null", "budget.iterations=4")
    run_id = json.loads((ended.folder / "mlflow.json").read_text())["run_id"]
    assert mlflow_here.get_run(run_id).data.tags["stopping.rule"] == "plateau"
    assert call("resume", ended.folder.name, "stopping=none").code == 0
    tags = mlflow_here.get_run(run_id).data.tags
    assert (tags["stopping.rule"], tags["end"]) == ("none", "finished: budget reached: iterations")


def test_a_rule_that_has_seen_enough_ends_the_run_again(stopped, call):
    before = rows(stopped)
    assert call("resume", stopped.name, "stopping.warmup=1").code == 0
    assert rows(stopped) == before
    assert summary(stopped)["stopping"]["rule"] == "plateau"


def change_config(run) -> None:
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["algorithm"]["entropy_coeff"] = 0.5
    (run / "config.yaml").write_text(yaml.safe_dump(config))


def lose_a_row(run) -> None:
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows(run)[:2]))


def spoil_checkpoints(run) -> None:
    for hashes in (run / "checkpoints").glob("0*/hashes.json"):
        hashes.write_text("{}")


MORE = "budget.iterations=6"


@pytest.mark.parametrize(
    ("before", "overrides", "words"),
    [
        (None, [], ["budget reached: iterations", "budget.iterations="]),
        (None, [MORE, *RELIABLE[:2]], ["stopping.episodes: \N{EN DASH} -> 20"]),
        (None, [MORE, "algorithm.lr=1e-5"], ["algorithm.lr: 0.0013 -> 1e-05", "deepracer-exp clone"]),
        (None, [MORE, "track=Oval_track"], ["track.name", "Oval_track"]),
        (None, [MORE, "algorithm.learning_rate=1"], ["algorithm.learning_rate: no such key"]),
        (None, [MORE, "experiment=fast_lap"], ["experiment=fast_lap", "give the groups and values"]),
        (None, ["budget.iterations=many"], ["budget.iterations"]),
        (change_config, [MORE], ["algorithm.entropy_coeff: 0.01 -> 0.5"]),
        (lose_a_row, [MORE], ["has 2 of the 3 rows"]),
        (spoil_checkpoints, [MORE], ["is intact"]),
        (RunFolder, [MORE], ["a process is training in it"]),
    ],
)
def test_what_cannot_be_resumed_is_refused_and_left_as_it_is(cut, call, before, overrides, words):
    def files() -> dict:
        return {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.name != "log.txt"}

    run = cut()
    held = before and before(run)
    there = files()
    ended = call("resume", run.name, *overrides)
    assert files() == there
    if held:
        held.release()
    ended.assert_refused(*words)


def test_a_reward_function_with_a_memory_is_reported_and_one_that_was_changed_refused(copied, call, tmp_path):
    file = tmp_path / "memory.py"
    reward = "seen = 0\ndef reward_function(params):\n    global seen\n    seen += 1\n    return 1.0\n"
    file.write_text(reward)
    run = copied(*OFTEN, f"reward.file={file}", "budget.iterations=2")
    ended = call("resume", run.name, "budget.iterations=3")
    assert ended.code == 0
    assert "will not be that of an uninterrupted run: the reward function memory remembers" in ended.stderr
    file.write_text(reward.replace("1.0", "2.0"))
    call("resume", run.name, "budget.iterations=4").assert_refused("reward memory has other contents")


def test_an_iteration_that_an_interruption_left_out_is_driven_by_resume(
    trained, train_here, call, monkeypatch
):
    often = (*OFTEN, "checkpoints.every=1", "budget.env_steps=null", "budget.iterations=3", "stopping=none")
    uninterrupted = trained(*often)
    update = PPO.update

    def interrupted(agent, batch, iteration, fraction):
        if iteration == 1:
            os.kill(os.getpid(), signal.SIGINT)
            wait_until(lambda: False, "end of this iteration")
        return update(agent, batch, iteration, fraction)

    with monkeypatch.context() as patched:
        patched.setattr(signals, "PATIENCE_S", 0.0)
        patched.setattr(PPO, "update", interrupted)
        ended = train_here(*often)
    assert ended.code == 130
    assert ended.summary["status"] == "interrupted"
    assert ended.summary["reason"] == "ended at once without the iteration in progress"
    assert [row["iteration"] for row in rows(ended.folder)] == [1]
    resumed = call("resume", ended.folder.name)
    assert resumed.code == 0, resumed.stderr
    assert_same_run(ended.folder, uninterrupted.folder)
