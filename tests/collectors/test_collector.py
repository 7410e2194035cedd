import multiprocessing
import time

import numpy as np
import psutil
import pytest
import torch

from deepracer_exp.collectors import watchdog
from deepracer_exp.collectors.car_worker import EnvFactory
from deepracer_exp.collectors.collector import worker_count
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.trace_columns import PACKED
from deepracer_exp.errors import RunFailed
from deepracer_exp.sim.batch import cores

pytestmark = pytest.mark.usefixtures("workers_start_early")

FEW = "collector.cars=8"


@pytest.fixture
def collect(driver_of):
    return lambda *overrides: driver_of(FEW, *overrides, frames=61).open()


def test_processes_are_as_many_as_asked_for_or_as_there_are_cores():
    def count(*overrides: str) -> int:
        return worker_count(compose_experiment(overrides)[0].collector)

    assert count("collector=in_process") == 0
    assert 1 <= count("collector=sync") <= cores()
    assert count("collector=sync", "collector.processes=4") == 4
    for cars in range(1, 60):
        processes = count("collector=sync", f"collector.cars={cars}")
        assert cars % processes == 0
        assert processes == 1 or cars // processes >= 4


@pytest.mark.parametrize(
    "overrides",
    [
        ("collector=in_process",),
        ("collector=sync", "collector.processes=2"),
    ],
    ids=["in_process", "sync"],
)
def test_a_batch_has_cars_first_and_time_last_in_whole_steps_of_all_cars(collect, overrides):
    collection = collect(*overrides)
    for _ in range(3):
        batch = collection.next_batch()
        assert batch.batch_size == (8, 8)
        assert "trace" not in batch.keys()  # noqa: SIM118 - once a step is enough
        trace = batch["next", "trace"].numpy()
        cars = trace[:, :, PACKED["car"]]
        assert (cars == cars[:, :1]).all()
        assert cars[:, 0].tolist() == list(range(8))
        steps = trace[:, :, PACKED["steps"]]
        goes_on = np.diff(steps, axis=1) == 1
        assert (goes_on | (trace[:, :-1, PACKED["done"]] == 1)).all()


def test_the_cars_of_the_workers_drive_with_the_weights_published_last(driver_of):
    driver = driver_of(FEW, "action_space=discrete", "collector=sync", "collector.processes=2", frames=61)
    collection = driver.open()
    collection.next_batch()
    chosen = 3
    with torch.no_grad():
        for parameter in driver.policy.parameters():
            parameter.zero_()
        last_bias = [p for p in driver.policy.parameters() if p.ndim == 1][-1]
        last_bias[chosen] = 100.0
    collection.publish_policy()
    assert (collection.next_batch()["action"] == chosen).all()


def test_nothing_is_left_when_it_is_closed(collect, tmp_path):
    before = set(multiprocessing.active_children())
    with collect("collector=sync", "collector.processes=2") as collection:
        collection.next_batch()
        assert len(set(multiprocessing.active_children()) - before) == 2
        assert (tmp_path / ".heartbeat").exists()
    assert set(multiprocessing.active_children()) == before
    assert not (tmp_path / ".heartbeat").exists()


def test_no_worker_is_waited_for_when_an_error_leaves_the_block(collect, nothing_left):
    collection = collect("collector=sync", "collector.processes=2")
    collection.next_batch()
    workers = [psutil.Process(process.pid) for process in multiprocessing.active_children()]
    # A stopped process cannot end when it is asked to.
    for worker in workers:
        worker.suspend()
    with pytest.raises(ZeroDivisionError), collection:
        raise ZeroDivisionError
    assert not any(worker.is_running() for worker in workers)


class _Broken(EnvFactory):
    def __call__(self):
        raise ValueError("no engine\nin this car")


def test_workers_that_do_not_start_are_reported_in_one_line_and_gone(collect, nothing_left, monkeypatch):
    monkeypatch.setattr("deepracer_exp.collectors.collector.EnvFactory", _Broken)
    with pytest.raises(RunFailed, match="collector workers did not start: no engine") as error:
        collect("collector=sync", "collector.processes=2")
    assert "\n" not in str(error.value)


class _Sleeping(EnvFactory):
    def __call__(self):
        time.sleep(3600)


def test_workers_that_hang_while_they_start_are_ended(collect, nothing_left, monkeypatch):
    monkeypatch.setattr(watchdog, "_START_TIMEOUT_S", 1.0)
    monkeypatch.setattr("deepracer_exp.collectors.collector.EnvFactory", _Sleeping)
    limits = ("collector.hang_timeout_s=1", "reward.time_limit_s=0.5")
    with pytest.raises(RunFailed, match="collector workers did not start: worker 0 took no step"):
        collect("collector=sync", "collector.processes=2", *limits)
