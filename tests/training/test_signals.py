import os
import signal
import time

import pytest

from deepracer_exp.training import signals
from deepracer_exp.training.signals import Interruption
from tests.waiting import wait_until


@pytest.mark.processes
@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_is_noted_and_nothing_else_happens(signum, code):
    with Interruption() as interruption:
        assert interruption.exit_code is None
        os.kill(os.getpid(), signum)
        assert interruption.signum == signum
        assert interruption.exit_code == code


def test_a_second_signal_ends_at_once_and_the_first_one_names_the_exit_code():
    with Interruption() as interruption:
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        assert interruption.exit_code == 143


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(signals, "PATIENCE_S", 0.0)


def wait_for_the_end(interruption: Interruption, signum: int | None) -> None:
    if signum is not None:
        os.kill(os.getpid(), signum)
    interruption.may_leave_out = True
    wait_until(lambda: False, "end")


def test_an_iteration_that_takes_long_is_left_out_if_all_before_it_is_stored(impatient):
    with Interruption() as interruption:
        with pytest.raises(KeyboardInterrupt):
            wait_for_the_end(interruption, signal.SIGTERM)
        assert interruption.left_out
        assert interruption.exit_code == 143


def test_patience_begins_with_the_signal_and_lasts_while_something_would_be_lost(impatient):
    with Interruption() as interruption:
        interruption.may_leave_out = True
        time.sleep(3 * signals._LOOK_EVERY_S)
        interruption.may_leave_out = False
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(3 * signals._LOOK_EVERY_S)
        assert not interruption.left_out
        with pytest.raises(KeyboardInterrupt):
            wait_for_the_end(interruption, None)


def test_nothing_comes_after_its_end(impatient):
    with Interruption() as interruption:
        os.kill(os.getpid(), signal.SIGINT)
        interruption._over.set()
        interruption.may_leave_out = True
    time.sleep(3 * signals._LOOK_EVERY_S)
    assert not interruption.left_out


def test_the_handlers_found_are_put_back():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with Interruption():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
