"""When the thread that writes to MLflow begins."""

import threading

import pytest

from deepracer_exp.tracking import store_thread
from deepracer_exp.tracking.store_thread import StoreThread
from tests.waiting import PATIENCE_S, wait_until


class Counted:
    """An update that counts its calls."""

    def __init__(self) -> None:
        self.calls = 0
        self.called = threading.Event()

    def __call__(self) -> dict[str, str]:
        self.calls += 1
        self.called.set()
        return {}


@pytest.fixture
def pauses_of_a_minute(monkeypatch) -> None:
    monkeypatch.setattr(store_thread, "UPDATE_S", 60.0)


def test_the_first_update_waits_until_the_training_has_begun(pauses_of_a_minute):
    update = Counted()
    thread = StoreThread(update, "store", "the training continues")
    assert not update.called.wait(0.1)
    thread.begin()
    assert update.called.wait(PATIENCE_S)
    assert thread.finish(PATIENCE_S)
    assert update.calls == 2


def test_a_training_that_ends_before_it_has_begun_is_recorded(pauses_of_a_minute):
    update = Counted()
    assert StoreThread(update, "store", "the training continues").finish(PATIENCE_S)
    assert update.calls == 1


def test_a_training_that_takes_long_to_begin_is_recorded_meanwhile():
    update = Counted()
    thread = StoreThread(update, "store", "the training continues")
    assert update.called.wait(PATIENCE_S)
    thread.finish(PATIENCE_S)


def test_the_first_row_of_a_run_lets_its_record_begin(pauses_of_a_minute, tracker, tmp_path):
    assert tracker.run_id is None
    tracker.log({"return": 1.0}, 1)
    wait_until(lambda: tracker.run_id is not None, "a run in MLflow")
    tracker.finish("FINISHED")
