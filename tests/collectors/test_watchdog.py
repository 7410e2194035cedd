import multiprocessing
import signal
import time

import numpy as np
import pytest

from deepracer_exp.collectors import watchdog
from deepracer_exp.collectors.watchdog import Watchdog
from tests.waiting import PATIENCE_S, wait_until


@pytest.fixture
def processes():
    # The watchdog's timing is not that of the machine: these do nothing but wait.
    context = multiprocessing.get_context("spawn")
    started = [context.Process(target=time.sleep, args=(600,), daemon=True) for _ in range(2)]
    for process in started:
        process.start()
    yield started
    for process in started:
        process.kill()
        process.join()


@pytest.fixture
def watch(tmp_path, monkeypatch, processes):
    """Watch two workers, which have begun, with a limit longer than this thread may have to wait for a core."""
    monkeypatch.setattr(watchdog, "LOOK_EVERY_S", 0.05)
    made = []

    def make(timeout_s: float = 2.0) -> Watchdog:
        made.append(Watchdog(tmp_path / "beats", 2, timeout_s))
        made[-1].workers_started(processes)
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.fixture
def beats(tmp_path):
    return lambda: np.memmap(tmp_path / "beats", np.int64, "r+")


def _keep_beating(counters, workers, dog) -> None:
    """Let workers make steps until another one is ended."""

    def is_over() -> bool:
        counters[workers] += 1
        return bool(dog.verdict)

    wait_until(is_over)


def test_a_worker_without_a_step_is_ended_and_the_other_lives(watch, beats, processes):
    dog = watch()
    counters = beats()
    counters[:] = 1
    dog.expect(10)
    _keep_beating(counters, [1], dog)
    dog.rest()  # the other worker makes no more steps
    assert list(dog.verdict) == [0]
    assert "after 1 steps" in dog.verdict[0]
    assert "collector.hang_timeout_s=2" in dog.verdict[0]
    assert "load average" in dog.verdict[0]
    processes[0].join(PATIENCE_S)
    assert processes[0].exitcode == -signal.SIGKILL
    assert processes[1].is_alive()


def test_a_worker_that_has_driven_its_part_may_rest(watch, beats):
    dog = watch()
    dog.rest()
    beats()[:] = 10, 9
    dog.expect(10)
    wait_until(lambda: dog.verdict)
    assert list(dog.verdict) == [1]


def test_a_worker_that_has_driven_one_part_must_step_for_the_next(watch, beats):
    dog = watch()
    counters = beats()
    counters[:] = 10
    dog.expect(10)
    dog.expect(10)
    _keep_beating(counters, [1], dog)
    assert list(dog.verdict) == [0]


def test_workers_that_hang_after_the_last_step_of_their_parts_are_ended(watch, beats):
    dog = watch()
    beats()[:] = 10
    dog.expect(10)
    wait_until(lambda: dog.verdict)


def test_a_worker_that_is_waited_for_is_named_now_and_then(watch, beats, monkeypatch, caplog):
    dog = watch(600.0)
    beats()[:] = 10, 1
    dog.expect(10)
    monkeypatch.setattr(watchdog, "_SAY_EVERY_S", 0.2)
    wait_until(lambda: len(caplog.records) > 2, "lines")
    assert {record.args[0] for record in caplog.records} == {1}
    assert "collector worker 1 has taken no step for " in caplog.text
    assert not dog.verdict


def test_no_worker_is_ended_while_none_is_waited_for(watch, beats, processes):
    dog = watch(0.1)
    dog.rest()
    beats()[:] = 1
    time.sleep(0.3)
    assert not dog.verdict
    assert all(process.is_alive() for process in processes)
