import json
import math
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest

from benchmarks.same import different_rows, different_tensors, different_traces
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.observation import Features
from deepracer_exp.runs.run_files import read_metrics
from deepracer_exp.runs.run_result import Ending
from deepracer_exp.runs.trace import read_trace
from deepracer_exp.training.plan import plan_training
from deepracer_exp.training.run import run_training
from tests.conftest import OFTEN, THREE

from .conftest import assert_same_run

# Reached sooner than a lap: episodes end often.
OVERRIDES = ("reward=speed_on_track", "episode.max_steps=60")
HERE = "collector=in_process"


def assert_trace_gives_the_metrics(ended) -> None:
    """Recompute every iteration's row from the trace."""
    trace = read_trace(ended.folder / "trace")
    metrics = pd.DataFrame(ended.metrics, index=range(1, len(ended.metrics) + 1))
    by_episode = trace.groupby("episode")
    assert np.array_equal(np.sort(trace.episode.unique()), np.arange(trace.episode.nunique()))
    assert (by_episode.car.nunique() == 1).all()
    ordered = trace.sort_values(["episode", "steps"])
    assert (ordered.steps == ordered.groupby("episode").cumcount() + 1).all()
    assert (by_episode.iteration.apply(lambda part: part.is_monotonic_increasing)).all()
    # An episode is over with its last step, and only then.
    assert (by_episode.done.sum() <= 1).all()
    assert not ordered.groupby("episode").done.shift(fill_value=False).any()

    def so_far(rows: pd.DataFrame) -> pd.Series:
        return rows.groupby("iteration").size().reindex(metrics.index, fill_value=0).cumsum()

    ends = trace.assign(episode_return=ordered.groupby("episode").reward.cumsum())[trace.done]
    assert (metrics.iteration == metrics.index).all()
    assert (metrics.env_steps == so_far(trace)).all()
    assert (metrics.episodes == so_far(ends)).all()
    assert (metrics.laps == so_far(ends[ends.episode_status == "lap_complete"])).all()
    means = ends.groupby("iteration")[["episode_return", "progress"]].mean().reindex(metrics.index)
    np.testing.assert_allclose(
        metrics[["mean_return", "completion"]].astype(float), means, rtol=1e-6, atol=5e-5
    )
    assert ended.summary["last"] == ended.metrics[-1]
    for key in ("iteration", "env_steps", "episodes", "laps"):
        assert ended.summary[key] == ended.metrics[-1][key]


def test_a_finished_run_says_so_and_names_its_folder(trained):
    ended = trained(*OVERRIDES)
    assert ended.code == 0, ended.stderr
    assert ended.summary["status"] == "finished"
    assert ended.summary["reason"] == "budget reached: env_steps"
    assert ended.stdout.startswith("\nfinished: budget reached: env_steps\n")
    assert str(ended.folder.relative_to(ended.cwd)) in ended.stdout
    assert "\niteration 4  4,096 steps  " in ended.stderr
    assert "\x1b" not in ended.stderr + ended.stdout


def test_metrics_and_trace_agree(trained):
    ended = trained(*OVERRIDES)
    assert ended.summary["episodes"] > 50
    assert_trace_gives_the_metrics(ended)


def differences(one, other) -> tuple[str | None, ...]:
    """Return where rows, agents and traces of two runs differ, None where they do not."""
    lasts = (ended.folder / "checkpoints" / "last" for ended in (one, other))
    rows = different_rows(one.metrics, other.metrics)
    return rows, different_tensors(*lasts), different_traces(one.folder, other.folder)


def test_the_same_seed_gives_the_same_run_whatever_the_number_of_physics_threads(trained):
    short = (*OFTEN, *THREE)
    assert differences(trained(*short), trained(*short, "collector.threads=2")) == (None,) * 3


def test_another_seed_gives_another_run(trained):
    short = (*OFTEN, *THREE)
    assert all(differences(trained(*short), trained(*short, "seed=1")))


@pytest.mark.usefixtures("workers_start_early")
def test_the_same_seed_gives_the_same_run_in_one_process_and_in_several(call, tmp_path):
    command = ("train", "experiment=tiny", "tracking=off", *OFTEN, "collector.cars=16")
    folders = []
    for name, where in (("alone", "mode=in_process"), ("four", "processes=4")):
        ended = call(*command, "budget.env_steps=1024", f"name={name}", f"collector.{where}")
        assert ended.code == 0, ended.stderr
        folders += (tmp_path / "runs" / name).iterdir()
    assert_same_run(*folders)
    assert len(read_metrics(folders[0] / "metrics.jsonl")) == 4
    assert len(read_trace(folders[0] / "trace", ["steps"])) == 1024


@pytest.mark.processes
@pytest.mark.parametrize(
    ("limits", "reason", "iterations"),
    [
        (["budget.env_steps=2000", "stopping=entropy"], "env_steps", 2),
        (["budget.iterations=1"], "iterations", 1),
        (["budget.env_steps=null", "budget.minutes=0.008"], "minutes", None),
    ],
)
def test_each_limit_of_the_budget_ends_the_run_with_its_name(trained, limits, reason, iterations):
    ended = trained(*limits)
    assert ended.code == 0
    assert Ending.stored(ended.summary) == Ending.by_budget(reason)
    assert (ended.summary["reason"], ended.summary["stopping"]) == (f"budget reached: {reason}", None)
    if iterations is not None:
        assert (ended.summary["iteration"], ended.summary["env_steps"]) == (iterations, 1024 * iterations)


def test_the_stopping_rule_ends_the_run_once_enough_episodes_have_ended(trained):
    ended = trained("stopping=reliable", "stopping.episodes=20", "stopping.lap_share=0")
    assert ended.code == 0
    assert ended.summary["reason"] == "reliable: 0% of the last 20 episodes completed the lap"
    assert ended.summary["reliable"]["env_steps"] == ended.summary["env_steps"]
    assert all(row["lap_share"] is None for row in ended.metrics[:-1])


TRACKS = ("reinvent_base", "Oval_track", "Straight_track")
SEVERAL = (*OVERRIDES, f"track=[{','.join(TRACKS)}]", "track.Oval_track.direction=alternate")


def test_several_tracks_train_together_and_each_has_its_metrics(trained):
    ended = trained(*SEVERAL)
    assert ended.code == 0, ended.stderr
    assert_trace_gives_the_metrics(ended)
    trace = read_trace(ended.folder / "trace")
    ends = trace[trace.done]
    assert set(trace.track) == set(TRACKS)
    for iteration, row in enumerate(ended.metrics, start=1):
        assert row["best_lap_time_s"] is row["mean_lap_time_s"] is None
        for name in TRACKS:
            here = ends[(ends.iteration == iteration) & (ends.track == name)]
            assert row[f"completion/{name}"] == (pytest.approx(here.progress.mean()) if len(here) else None)
    counted = ends.groupby("track", observed=True).size()
    assert {name: of["episodes"] for name, of in ended.summary["tracks"].items()} == dict(counted)
    label = "reinvent_base_Oval_track_Straight_track-speed_on_track-seed0"
    assert ended.folder.name.split("-", 2)[2] == label
    with_laps = ends[ends.episode_status == "lap_complete"].track.nunique()
    assert f"laps on {with_laps} of 3 tracks" in ended.stdout


@pytest.mark.parametrize(
    "overrides",
    [
        ("action_space=continuous", "network=mlp_deep_shared", "randomization=aws"),
        ("track=Straight_track", "lr_schedule=adaptive_kl"),
        ("track=Oval_track", "track.direction=reversed", "reward=racing_line", "network=mlp_small_shared"),
    ],
    ids=" ".join,
)
def test_every_kind_of_choice_trains(trained, overrides):
    ended = trained("budget.iterations=2", *overrides)
    assert ended.code == 0, ended.stderr
    assert all(math.isfinite(row["policy_loss"]) for row in ended.metrics)
    assert_trace_gives_the_metrics(ended)


def test_iterations_of_episodes_have_at_least_that_many(trained):
    episodes = ("algorithm.frames_per_iteration=null", "algorithm.episodes_per_iteration=20")
    ended = trained(*episodes, "algorithm.batch_size=64")
    assert ended.code == 0, ended.stderr
    assert_trace_gives_the_metrics(ended)
    episodes = [0] + [row["episodes"] for row in ended.metrics]
    assert len(episodes) > 2
    assert (np.diff(episodes) >= 20).all()


def test_an_observation_that_is_not_finite_ends_the_run_and_names_the_car(train_here, monkeypatch):
    compute: Callable = Features.compute
    calls = []

    def break_one(self, *arguments):
        features = compute(self, *arguments)
        if len(features) == 16:  # new episodes are observed by themselves
            calls.append(None)
        if len(calls) == 40:
            features[3, 1] = np.nan
        return features

    monkeypatch.setattr(Features, "compute", break_one)
    ended = train_here()
    ended.assert_run_failed("observation", "of car 3", "became nan")
    with np.load(ended.folder / "faults" / "training.npz") as state:
        assert np.argwhere(np.isnan(state["observation"])).tolist() == [[3, 1]]
        assert len(state["physics_state"]) == 16


def test_a_loss_that_is_not_finite_ends_the_run_and_keeps_the_batch(train_here):
    """Steps of this size leave the range of float32 at once."""
    ended = train_here("algorithm.lr=1e38", "algorithm.max_grad_norm=0")
    ended.assert_run_failed("policy loss is nan")
    assert json.loads((ended.folder / "faults" / "training.json").read_text())["error"] == "RunFailed"
    with np.load(ended.folder / "faults" / "training.npz") as state:
        assert state["observation"].shape[:2] == (16, 64)
        assert state["reward"].shape == (16, 64, 1)


def test_a_bug_of_ours_shows_its_traceback_and_the_run_counts_as_failed(tmp_path, monkeypatch):
    def broken(self, *arguments):
        raise ZeroDivisionError("of ours")

    monkeypatch.setattr(PPO, "update", broken)
    plan = plan_training(
        *compose_experiment(["experiment=tiny", "tracking=off", f"runs_dir='{tmp_path}'", HERE])
    )
    with pytest.raises(ZeroDivisionError, match="of ours"):
        run_training(plan)
    (summary,) = tmp_path.glob("tiny/*/summary.json")
    assert json.loads(summary.read_text())["status"] == "failed"
    assert "Traceback" in summary.with_name("log.txt").read_text()


@pytest.mark.slow
def test_a_failed_run_of_a_grid_does_not_stop_the_others_and_gives_the_exit_code(call, tmp_path):
    (tmp_path / "sometimes.py").write_text(
        "FAIL = 0\ndef reward_function(params):\n    return 1.0 / (1 - FAIL)\n"
    )
    grid = ("budget.iterations=1", "reward.file=sometimes.py", "reward.constants.FAIL=0,1,0.5")
    ended = call("train", "-m", "experiment=tiny", "tracking=off", HERE, *grid)
    assert ended.code == 3
    assert len(ended.folders) == 3
    statuses = [json.loads((folder / "summary.json").read_text())["status"] for folder in ended.folders]
    assert sorted(statuses) == ["failed", "finished", "finished"]
    table = ended.stdout.split("3 runs:\n")[1].splitlines()
    assert len(table) == 3
    assert "ZeroDivisionError" in table[1]
    assert "finished" in table[0]
    assert "finished" in table[2]
