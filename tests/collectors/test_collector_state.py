import os
import signal
from concurrent.futures import wait

import numpy as np
import pytest
import torch
from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.checkpoints import State

pytestmark = pytest.mark.usefixtures("workers_start_early")

IN_PROCESS = ("collector=in_process", "collector.cars=8")
SYNC = ("collector=sync", "collector.processes=2", "collector.cars=8")
ONE = ("collector=sync", "collector.processes=1", "collector.cars=8")
EVERYTHING = (
    *("track=[reinvent_carpet,Oval_track]", "track.direction=alternate", "randomization=sim2real"),
    # Cars are in the middle of a later episode when the state is taken.
    "episode.max_steps=11",
)


def stored(state, folder):
    """Return the state as it comes back from a checkpoint."""
    archive, holder = StateDictCheckpointAdapter("archive"), State(state)
    Checkpoint().register("cars", holder, adapter=archive).save(folder / "checkpoint")
    Checkpoint().register("cars", holder, adapter=archive).load(folder / "checkpoint")
    return holder.values


def assert_same(batches, expected, tolerance=0.0) -> None:
    for batch, wanted in zip(batches, expected, strict=True):
        assert set(batch.keys(True, True)) == set(wanted.keys(True, True))
        for key, values in wanted.items(True, True):
            # NaN stands for a missing value in columns of the trace.
            torch.testing.assert_close(
                batch[key], values, rtol=tolerance, atol=tolerance, equal_nan=True, msg=str(key)
            )


@pytest.mark.parametrize(
    ("overrides", "tolerance", "processes"),
    [
        # The policy of a LIDAR is Torch's, whose product of 4 rows may be rounded otherwise than that of 16.
        (("action_space=continuous", "observation=lidar"), 1e-4, 2),
        (EVERYTHING, 0.0, 4),
    ],
    ids=["continuous", "everything"],
)
def test_batches_do_not_depend_on_how_the_cars_are_spread_over_processes(
    driver_of, overrides, tolerance, processes
):
    def batches(*where):
        driver = driver_of("collector.cars=16", *where, *overrides, frames=16 * 20)
        collection = driver.open()
        try:
            return driver.collect(collection, range(3))
        finally:
            collection.close()

    alone = batches("collector.mode=in_process")
    assert alone[0].batch_size == (16, 20)
    assert_same(batches("collector.mode=sync", f"collector.processes={processes}"), alone, tolerance)


@pytest.mark.parametrize(
    ("collector", "space"), [(IN_PROCESS, "discrete"), (SYNC, "continuous")], ids=["in_process", "sync"]
)
def test_a_collection_continues_bit_for_bit_from_a_stored_state(driver_of, tmp_path, collector, space):
    driver = driver_of(*collector, *EVERYTHING, f"action_space={space}")
    uninterrupted = driver.open()
    before = driver.collect(uninterrupted, range(3))
    state = stored(uninterrupted.state_dict(), tmp_path)
    expected = driver.collect(uninterrupted, range(3, 5))
    assert {"observation", "action", "action_log_prob"} < set(expected[0].keys())
    assert not torch.equal(before[2]["observation"], expected[0]["observation"])
    done = expected[0]["next", "done"][:, 0]
    assert not done.all()
    uninterrupted.close()
    resumed = driver.open(state)
    assert_same(driver.collect(resumed, range(3, 5)), expected)
    if collector is SYNC:  # what a batch asks of a worker, and the watchdog expects
        assert np.fromfile(tmp_path / ".heartbeat", np.int64).tolist() == [40, 40]


@pytest.mark.parametrize("collector", [IN_PROCESS, SYNC], ids=["in_process", "sync"])
def test_a_batch_driven_ahead_is_the_same_and_so_is_the_state_before_it(driver_of, collector):
    driver = driver_of(*collector)
    expected = driver.collect(driver.open(), range(3))
    ahead = driver.open()
    batches = []
    for turn in range(3):
        if turn:
            driver.learn(ahead, turn)
        ahead.begin_next()
        before = ahead.state_dict()
        batches.append(ahead.next_batch().exclude("collector").clone())
        if turn == 1:
            state = before
    assert_same(batches, expected)
    again = driver.open(state)
    driver.learn(again, 1)
    assert_same([again.next_batch().exclude("collector")], expected[1:2])


def test_the_seconds_of_a_batch_driven_ahead_count_as_collection(driver_of):
    driver = driver_of(*SYNC)
    collection = driver.open()
    collection.next_batch()
    assert collection.ahead_s == 0
    collection.begin_next()
    wait([collection._next])
    collection.next_batch()
    assert collection.ahead_s > 0


def test_a_worker_lost_while_it_drives_ahead_is_named_when_a_batch_is_asked_for(driver_of, nothing_left):
    with driver_of(*SYNC).open() as collection:
        collection.next_batch()
        collection.begin_next()
        collection._collector.procs[1].kill()
        with pytest.raises(RunFailed, match=r"collector worker 1 .* died by signal SIGKILL"):  # noqa: PT012
            collection.next_batch()
            collection.next_batch()  # the first may have been delivered before the kill


def test_a_batch_that_nobody_reads_is_given_up_at_the_end(driver_of, nothing_left, monkeypatch):
    monkeypatch.setattr("deepracer_exp.collectors.collector._LAST_BATCH_S", 0.1)
    collection = driver_of(*SYNC).open()
    collection.next_batch()
    for process in collection._collector.procs:
        os.kill(process.pid, signal.SIGSTOP)
    monkeypatch.setattr(collection, "_worker_states", list)  # stopped, they do not answer
    collection.begin_next()
    collection.close()


def test_what_else_the_training_process_draws_does_not_change_what_its_cars_do(driver_of):
    driver = driver_of(*IN_PROCESS)
    expected = driver.collect(driver.open(), range(2))
    collection = driver.open()
    batches = driver.collect(collection, range(1))
    drawn = torch.manual_seed(5).get_state()
    state = collection.state_dict()
    batches += driver.collect(collection, range(1, 2))
    assert torch.equal(torch.get_rng_state(), drawn)
    assert_same(batches, expected)
    assert_same(driver.collect(driver.open(state), range(1, 2)), expected[1:])


def test_closing_leaves_the_threads_of_this_process_as_they_were(driver_of):
    before = torch.get_num_threads()
    driver_of(*ONE).open().close()
    assert torch.get_num_threads() == before


def test_a_state_of_another_number_of_processes_is_refused(driver_of, nothing_left):
    here = driver_of(*IN_PROCESS)
    collection = here.open()
    here.collect(collection, range(1))
    words = "the checkpoint does not fit: .*1 worker; accepted by this collector: 2"
    with pytest.raises(BadInput, match=words):
        driver_of(*SYNC).open(collection.state_dict())


@pytest.mark.parametrize(
    ("signum", "words"),
    [
        (signal.SIGKILL, r"collector worker 1 .* died by signal SIGKILL"),
        (signal.SIGSTOP, "collector worker 1 did not report the state of its cars for 0 s of CPU and "),
    ],
)
def test_a_worker_that_does_not_answer_when_asked_for_its_cars_is_a_failure(
    driver_of, nothing_left, signum, words
):
    driver = driver_of(*SYNC, "collector.hang_timeout_s=2", "reward.time_limit_s=1")
    collection = driver.open()
    driver.collect(collection, range(1))
    os.kill(collection._collector.procs[1].pid, signum)
    with pytest.raises(RunFailed, match=words):
        collection.state_dict()
