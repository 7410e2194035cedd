"""A reward function that misbehaves while the cars drive: exit code 3, one line, the state on disk."""

import json

import numpy as np
import pytest

SWALLOWS_EVERYTHING = """
def reward_function(params):
    while params["steps"] > 3:
        try:
            while True:
                pass
        except:
            pass
    return 1.0
"""


@pytest.fixture
def reward(tmp_path):
    """Write a reward function whose line 3 on is the given text; return the override that names it."""

    def write(*lines: str) -> str:
        path = tmp_path / "my_reward.py"
        path.write_text("\n".join(["import math, os, sys", "def reward_function(params):", *lines]) + "\n")
        return f"reward.file={path}"

    return write


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('raise ValueError("no " + "idea")', ["raised ValueError: no idea", "line 3 of"]),
        ("return params['stepz']", ["raised KeyError: 'stepz'", "line 3 of"]),
        ("return 1 / 0", ["raised ZeroDivisionError", "line 3 of"]),
        ("sys.exit(0)", ["raised SystemExit: 0", "line 3 of"]),
        ('raise ValueError("two\\nlines")', ["raised ValueError: two lines"]),
        ("return None", ["returned None"]),
        ("return 'good'", ["returned 'good'"]),
        ("return math.nan", ["returned nan"]),
        ("return -math.inf", ["returned -inf"]),
        ("return 1e9", ["returned 1000000000.0", "from -100000 to 100000"]),
        ("return [1.0]", ["returned [1.0]"]),
        ("return 1j", ["returned 1j"]),
        ("return reward_function(params)", ["RecursionError"]),
        ("while True: pass", ["took longer than the time limit of 1 s", "line 3 of"]),
    ],
)
def test_a_reward_that_is_none_ends_the_run_with_its_name_car_and_step(train_here, reward, line, words):
    ended = train_here(reward(f"    {line}"), "reward.time_limit_s=1")
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
    assert len(list((ended.folder / "trace").glob("*.parquet"))) == len(ended.metrics)


@pytest.mark.parametrize("mode", ["sync", pytest.param("async", marks=pytest.mark.slow)])
def test_a_reward_that_raises_in_a_worker_ends_the_run_with_the_workers_own_words(
    start_training, reward, mode
):
    training = start_training(reward("    return 1 / 0"), f"collector={mode}")
    ended = training.end()
    ended.assert_run_failed("raised ZeroDivisionError", "line 3 of")
    assert list((ended.folder / "faults").glob("worker-*.json"))
    assert list((ended.folder / "faults").glob("worker-*.npz"))
    training.assert_nothing_left()


def test_a_reward_that_swallows_its_time_limit_is_ended_by_the_watchdog(start_training, tmp_path):
    path = tmp_path / "deaf.py"
    path.write_text(SWALLOWS_EVERYTHING)
    training = start_training(f"reward.file={path}", "reward.time_limit_s=1", "collector.hang_timeout_s=3")
    ended = training.end()
    ended.assert_run_failed("collector worker", "took no step for", "(after 3 steps)")
    training.assert_nothing_left()


@pytest.mark.slow
def test_a_reward_that_leaves_the_process_never_ends_in_a_finished_run(start_training, reward):
    training = start_training(reward("    if params['steps'] > 3: os._exit(0)", "    return 1.0"))
    training.end().assert_run_failed("collector worker", "died with exit code 0")
    training.assert_nothing_left()


def test_a_million_printed_lines_neither_end_the_run_nor_fill_the_disk(train_here, reward):
    override = reward("    for i in range(250): print('step', i, params['steps'])", "    return 1.0")
    ended = train_here(override)
    assert ended.code == 0, ended.stderr
    assert 250 * ended.summary["env_steps"] >= 1_000_000
    log = ended.folder / "reward_prints.log"
    assert 0 < log.stat().st_size < 1_000_000
    assert "car 0: step 0 2" in log.read_text()
    assert "step 0" not in ended.stdout + ended.stderr
