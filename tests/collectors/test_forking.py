import multiprocessing
import signal

import pytest

from deepracer_exp.collectors.forking import start_workers_early


def test_ctrl_c_while_the_workers_server_starts_is_not_lost(monkeypatch):
    before = multiprocessing.get_start_method(allow_none=True)
    monkeypatch.setattr(
        "multiprocessing.forkserver.ensure_running", lambda: signal.raise_signal(signal.SIGINT)
    )
    try:
        with pytest.raises(KeyboardInterrupt):
            start_workers_early(True)
    finally:
        multiprocessing.set_start_method(before, force=True)
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())
