"""Processes that are killed or stopped: the run ends as failed, says whom it lost, and leaves nothing behind."""

import multiprocessing
import signal
import time

import psutil
import pytest

from tests.conftest import IN_WORKERS, iterations

from .conftest import meanwhile

DEATHS_ALONE = ("collector.hang_timeout_s=600",)
"""The watchdog would end a worker later than the tests wait: what ends the run is that the death is noticed."""
HANG_S = 10
HANGS_SOON = (f"collector.hang_timeout_s={HANG_S}", "reward.time_limit_s=0.5")
LEARNS_LONG = ("algorithm.epochs=100", "algorithm.batch_size=32")
"""Little driving and much learning, so that a signal interrupts the update or the sending of weights."""


def _lost(training, *words):
    ended = training.end()
    ended.assert_run_failed(*words)
    training.assert_nothing_left()
    return ended


@pytest.mark.usefixtures("workers_start_early")
def test_a_killed_worker_never_ends_in_a_finished_run(call, tmp_path):
    killed = []

    def kill() -> None:
        workers = [psutil.Process(one.pid) for one in multiprocessing.active_children()]
        killed.append(sorted(workers, key=lambda one: (one.create_time(), one.pid))[1])
        killed[0].kill()

    with meanwhile(lambda: iterations(tmp_path) >= 2, kill):
        ended = call("train", *IN_WORKERS, *DEATHS_ALONE, "budget.env_steps=100000000")
    ended.assert_run_failed("collector worker 1", f"(process {killed[0].pid})", "died by signal SIGKILL")
    assert ended.summary["iteration"] == len(ended.metrics) >= 2
    assert not multiprocessing.active_children()


@pytest.mark.faults
def test_a_worker_that_stops_is_ended_and_named(start_training):
    training = start_training("collector=sync", *HANGS_SOON)
    training.wait_for_iterations(2)
    training.workers()[0].send_signal(signal.SIGSTOP)
    _lost(training, "collector worker 0", "took no ")


@pytest.mark.faults
def test_a_worker_killed_while_it_starts_ends_the_run(start_training):
    training = start_training("collector=sync", *DEATHS_ALONE)
    training.wait_for_worker().send_signal(signal.SIGKILL)
    _lost(training, "orker 0")


@pytest.mark.faults
def test_a_worker_stopped_while_it_starts_ends_the_run(start_training):
    training = start_training(*HANGS_SOON)
    training.wait_for_worker().send_signal(signal.SIGSTOP)
    ended = training.end()
    ended.assert_run_failed("worker", "was ended")
    training.assert_nothing_left()


@pytest.mark.faults
@pytest.mark.parametrize(
    ("signum", "options", "words"),
    [(signal.SIGKILL, DEATHS_ALONE, "died by signal SIGKILL"), (signal.SIGSTOP, HANGS_SOON, "took no ")],
    ids=["killed", "stopped"],
)
def test_a_worker_lost_while_the_learner_learns_ends_the_run(start_training, signum, options, words):
    training = start_training(*LEARNS_LONG, *options)
    training.wait_for_iterations(1)
    training.workers()[0].send_signal(signum)
    _lost(training, "collector worker 0", words)


@pytest.mark.faults
@pytest.mark.parametrize("moment", ["start", "driving"])
def test_workers_do_not_outlive_a_killed_training(start_training, moment):
    training = start_training("collector=sync")
    if moment == "start":
        training.wait_for_worker()
    else:
        training.wait_for_iterations(1)
        assert len(training.workers()) == 2
    training.popen.send_signal(signal.SIGKILL)
    ended = training.end()
    assert ended.code == -signal.SIGKILL
    training.assert_nothing_left()
    assert not (ended.folder / "summary.json").exists()


@pytest.mark.faults
def test_workers_that_hang_do_not_outlive_a_killed_training(start_training, tmp_path):
    (tmp_path / "deaf.py").write_text(
        "import itertools\ndef reward_function(params):\n    return all(itertools.repeat(True))\n"
    )
    training = start_training("reward.file=deaf.py", "collector.hang_timeout_s=600", "reward.time_limit_s=1")
    training.wait_for(lambda: len(training.workers()) == 2, "workers")
    time.sleep(5)
    training.workers()
    training.popen.send_signal(signal.SIGKILL)
    training.end()
    training.assert_nothing_left()


@pytest.mark.faults
def test_a_fork_server_that_is_killed_ends_the_run(start_training):
    training = start_training(*DEATHS_ALONE)
    training.wait_for_iterations(1)
    training.workers()[0].parent().send_signal(signal.SIGKILL)
    _lost(training, "collector worker")


@pytest.mark.faults
def test_a_run_stopped_as_a_whole_continues_afterwards(start_training):
    """Ctrl-Z and fg: no worker is to blame for the pause."""
    training = start_training(*HANGS_SOON, "budget.env_steps=null", "budget.iterations=40")
    training.wait_for_iterations(1)
    training.signal_group(signal.SIGSTOP)
    time.sleep(1.5 * HANG_S)
    training.signal_group(signal.SIGCONT)
    ended = training.end()
    assert ended.code == 0, ended.stderr
    assert ended.summary["iteration"] == 40
    training.assert_nothing_left()
