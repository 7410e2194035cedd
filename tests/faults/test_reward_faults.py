"""A reward function that misbehaves while the cars drive: exit code 3, one line, the state on disk."""

import json
import multiprocessing

import numpy as np
import pytest

from deepracer_exp.runs.trace import read_trace
from tests.conftest import IN_WORKERS

DEAF = """
import itertools
def reward_function(params):
    if params["steps"] > 3:
        all(itertools.repeat(True))
    return 1.0
"""
"""Never returns to the interpreter, which alone could raise an error; a loop that catches all may be left some time."""


@pytest.mark.faults
@pytest.mark.parametrize("command", ["train", "sweep"])
def test_a_reward_that_ends_a_worker_never_ends_a_command_with_0(run_at, tmp_path, command):
    (tmp_path / "leaves.py").write_text("import os\ndef reward_function(params):\n    os._exit(0)\n")
    tiny = ["experiment=tiny", "tracking=off", "reward.file=leaves.py"]
    if command == "train":
        tiny += ["collector=sync", "collector.processes=null"]
    else:
        tiny += ["sweep.trials=1", "sweep.workers=1", "algorithm.lr=1e-3,1e-4"]
    ended = run_at(tmp_path, command, *tiny)
    assert ended.code == 3
    assert "exit code 0" in ended.complaint or command == "sweep"
    assert not list(tmp_path.glob("runs/*/*/summary.json")) or ended.summary["status"] == "failed"


@pytest.mark.faults
def test_workers_that_die_silently_are_reported_without_naming_an_empty_log(run_at, tmp_path):
    (tmp_path / "mine.py").write_text(
        "import multiprocessing, os\n"
        "if multiprocessing.parent_process() is not None: os._exit(0)\n"
        "def reward_function(params):\n    return 1.0\n"
    )
    tiny = ("experiment=tiny", "tracking=off", "sweep.trials=2", "sweep.workers=1")
    ended = run_at(tmp_path, "sweep", *tiny, "algorithm.lr=1e-3,1e-4", "reward.file=mine.py")
    assert ended.code == 3
    assert "the last one with exit code 0; a reward function can do that;" in ended.complaint


@pytest.fixture
def reward(tmp_path):
    """Write a reward function whose line 3 on is the given text; return the override that names it."""

    def write(*lines: str) -> str:
        path = tmp_path / "my_reward.py"
        path.write_text("\n".join(["import math, os, sys", "def reward_function(params):", *lines]) + "\n")
        return f"reward.file={path}"

    return write


@pytest.mark.processes
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("return 1 / 0", ["raised ZeroDivisionError", "line 3 of"]),
        ("sys.exit(0)", ["raised SystemExit: 0", "line 3 of"]),
        ("return math.nan", ["returned nan"]),
        ("while True: pass", ["took longer than the time limit of 0.2 s", "line 3 of"]),
    ],
)
def test_a_reward_that_is_none_ends_the_run_with_its_name_car_and_step(train_here, reward, line, words):
    """All that cannot be a reward is tested with the function itself."""
    ended = train_here(reward(f"    {line}"), "reward.time_limit_s=0.2")
    ended.assert_run_failed("reward my_reward: reward_function", "car 0, step 2", *words)
    fault = json.loads((ended.folder / "faults" / "training.json").read_text())
    assert fault["message"] == ended.summary["reason"]
    assert fault["params"]["steps"] == 2
    with np.load(ended.folder / "faults" / "training.npz") as state:
        assert len(state["physics_state"]) == 16
    assert "my_reward" in (ended.folder / "log.txt").read_text()


def test_the_traceback_of_a_failed_reward_is_shown_with_debug_only(train_here, reward):
    ended = train_here(reward("    return 1 / 0"), "debug=true")
    assert ended.code == 3
    assert "Traceback" in ended.stderr
    assert "deepracer-exp: run failed: " in ended.stderr


def test_a_reward_that_fails_later_leaves_what_was_learned_before(train_here, reward):
    override = reward("    if params['steps'] > 20: raise ValueError('tired')", "    return 1.0")
    ended = train_here(override, "algorithm.frames_per_iteration=256")
    ended.assert_run_failed("tired", "step 21")
    assert ended.summary["iteration"] == len(ended.metrics) > 0
    assert set(read_trace(ended.folder / "trace")["iteration"]) == set(range(1, len(ended.metrics) + 1))


@pytest.mark.usefixtures("workers_start_early")
def test_a_reward_that_raises_in_a_worker_ends_the_run_with_the_workers_own_words(call, reward):
    ended = call("train", *IN_WORKERS, reward("    return 1 / 0"))
    ended.assert_run_failed("raised ZeroDivisionError", "line 3 of")
    assert list((ended.folder / "faults").glob("worker-*.json"))
    assert list((ended.folder / "faults").glob("worker-*.npz"))
    assert not multiprocessing.active_children()


@pytest.mark.faults
def test_a_reward_that_is_deaf_to_its_time_limit_is_ended_by_the_watchdog(start_training, tmp_path):
    path = tmp_path / "deaf.py"
    path.write_text(DEAF)
    training = start_training(f"reward.file={path}", "reward.time_limit_s=1", "collector.hang_timeout_s=10")
    ended = training.end()
    ended.assert_run_failed("collector worker", "took no step for", "after 3 steps, and was ended")
    training.assert_nothing_left()


@pytest.mark.processes
def test_a_million_printed_lines_neither_end_the_run_nor_fill_the_disk(train_here, reward):
    override = reward("    for i in range(250): print('step', i, params['steps'])", "    return 1.0")
    ended = train_here(override)
    assert ended.code == 0, ended.stderr
    assert 250 * ended.summary["env_steps"] >= 1_000_000
    log = ended.folder / "reward_prints.log"
    assert 0 < log.stat().st_size < 1_000_000
    assert "car 0: step 0 2" in log.read_text()
    assert "step 0" not in ended.stdout + ended.stderr
