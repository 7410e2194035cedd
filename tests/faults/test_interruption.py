"""Ctrl-C and SIGTERM, sent to all processes of a run, as terminals and service managers do."""

import multiprocessing
import os
import signal
import time

import pytest

from deepracer_exp.runs.trace import read_trace
from deepracer_exp.training import signals
from tests.conftest import IN_WORKERS, iterations
from tests.waiting import PATIENCE_S

from .conftest import meanwhile


def _assert_whole(ended, code):
    assert ended.code == code, ended.stderr
    assert ended.summary["status"] == "interrupted"
    assert ended.summary["iteration"] == len(ended.metrics) > 0
    assert ended.summary["env_steps"] == len(read_trace(ended.folder / "trace", ["steps"]))
    assert (ended.folder / "checkpoints" / "last" / "manifest.json").is_file()
    assert (ended.folder / "best_lap.png").is_file()
    assert "Traceback" not in ended.stderr
    assert "deepracer-exp: " not in ended.stderr
    assert ended.stdout.startswith(f"\ninterrupted: by {'Ctrl-C' if code == 130 else 'SIGTERM'}")
    assert not (ended.folder / ".heartbeat").exists()


@pytest.mark.usefixtures("workers_start_early")
def test_ctrl_c_of_a_training_in_this_process_writes_everything(call, tmp_path, monkeypatch):
    monkeypatch.setattr(
        signals, "PATIENCE_S", PATIENCE_S
    )  # the present iteration may end, however long it takes

    def press() -> None:
        workers = [one.pid for one in multiprocessing.active_children()]
        assert len(workers) == 2
        for pid in (*workers, os.getpid()):
            os.kill(pid, signal.SIGINT)

    with meanwhile(lambda: iterations(tmp_path) >= 2, press):
        ended = call("train", *IN_WORKERS, "budget.env_steps=100000000")
    _assert_whole(ended, 130)
    assert not multiprocessing.active_children()


@pytest.mark.faults
@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_writes_everything(start_training, signum, code):
    training = start_training("collector=sync")
    training.wait_for_iterations(2)
    assert len(training.workers()) == 2
    training.signal_group(signum)
    _assert_whole(training.end(), code)
    training.assert_nothing_left()


@pytest.mark.faults
def test_an_interruption_while_the_workers_start_ends_after_one_iteration(start_training):
    training = start_training()
    training.wait_for_worker()
    training.signal_group(signal.SIGINT)
    ended = training.end()
    _assert_whole(ended, 130)
    assert ended.summary["iteration"] == 1
    training.assert_nothing_left()


@pytest.mark.faults
@pytest.mark.parametrize("after_s", [0.3, 1.0, 2.0])
def test_an_interruption_before_the_run_has_a_folder_is_reported_by_the_exit_code(start_training, after_s):
    training = start_training()
    training.wait_for(lambda: "starting" in (training.cwd / "stderr.txt").read_text(), "sign of life")
    time.sleep(after_s)
    training.signal_group(signal.SIGINT)
    ended = training.end()
    assert ended.code == 130
    assert "Traceback" not in ended.stderr
    assert all(folder.joinpath("summary.json").is_file() for folder in ended.folders)
    training.assert_nothing_left()


@pytest.mark.faults
def test_a_second_interruption_ends_at_once(start_training, tmp_path):
    """The iteration would take longer than the test waits for the end: cars that sleep."""
    (tmp_path / "slow.py").write_text(
        "import time\ndef reward_function(params):\n"
        "    open('driving', 'w')\n    time.sleep(1.0)\n    return 1.0\n"
    )
    training = start_training("reward.file=slow.py", "reward.time_limit_s=19", "collector.cars=8")
    training.wait_for((tmp_path / "driving").exists, "driving car")
    assert len(training.workers()) == 2
    training.signal_group(signal.SIGINT)
    training.wait_for(lambda: "stopping: this iteration" in (tmp_path / "stderr.txt").read_text(), "answer")
    training.signal_group(signal.SIGINT)
    ended = training.end()
    assert ended.code == 130
    assert "Traceback" not in ended.stderr
    assert ended.summary["status"] == "interrupted"
    assert ended.summary["reason"] == "ended at once by a second signal"
    training.assert_nothing_left()


@pytest.mark.faults
def test_an_interrupted_grid_runs_no_further_combination(start_training):
    training = start_training("-m", "seed=1,2")
    training.wait_for_iterations(1)
    training.signal_group(signal.SIGINT)
    ended = training.end()
    _assert_whole(ended, 130)
