import os
import signal

import pytest

from deepracer_exp.training.signals import Interruption


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


def test_the_handlers_found_are_put_back():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with Interruption():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
