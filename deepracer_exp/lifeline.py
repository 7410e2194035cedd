"""Processes that end with their owner, the process that started them, however it dies.

A worker is killed by the kernel when its parent dies (prctl(2), PR_SET_PDEATHSIG), even one that hangs or is stopped.
Its parent is the fork server, which dies in the same way with the owner that started it. A thread of the worker waits
for the owner, too, for systems other than Linux.
"""

import ctypes
import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

_IS_LINUX = sys.platform == "linux"
_SAFE_PATH = "PYTHONSAFEPATH"
_GIVEN_SAFE_PATH = os.environ.get(_SAFE_PATH)


def guard_imports() -> None:
    """Keep every Python process started from now on from importing from the working folder.

    With `-c` and `-m` Python looks there first: a fork server would import the user's `queue.py` in place of its own.
    """
    os.environ[_SAFE_PATH] = "1"


def given_environment() -> dict[str, str]:
    """Return the environment without the changes of `guard_imports`, for a program of the user's own."""
    variables = {} if _GIVEN_SAFE_PATH is None else {_SAFE_PATH: _GIVEN_SAFE_PATH}
    return {name: value for name, value in os.environ.items() if name != _SAFE_PATH} | variables


def die_with_parent() -> None:
    """Have the kernel kill this process once the thread that started it is gone; on Linux only.

    Its parent must therefore start it from the main thread.
    """
    if _IS_LINUX:
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def end_with_owner() -> None:
    """End this process, which `multiprocessing` started, with the one that started it, and with its fork server."""
    owner = multiprocessing.parent_process()
    assert owner is not None

    def follow() -> None:
        owner.join()  # returns at once if the owner died before the kernel was asked
        os.kill(os.getpid(), signal.SIGKILL)

    die_with_parent()
    threading.Thread(target=follow, name="owner", daemon=True).start()


@contextmanager
def running(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program, in a session of its own, that ends with the block or with this process, whichever ends first.

    All that the program has started in its process group ends with it. `options` are those of `subprocess.Popen`.

    Raises:
        OSError: it cannot be run.
    """
    reading, writing = os.pipe()
    try:
        with subprocess.Popen(command, start_new_session=True, pass_fds=[reading], **options) as process:
            try:
                if _IS_LINUX:
                    # This process alone holds the writing end. Once it is closed, the kernel kills the group.
                    # PR_SET_PDEATHSIG would leave the program's own children, such as MLflow's server below its
                    # command, and would end the program with the thread that started it.
                    fcntl.fcntl(reading, fcntl.F_SETOWN, -process.pid)
                    fcntl.fcntl(reading, fcntl.F_SETSIG, signal.SIGKILL)
                    fcntl.fcntl(reading, fcntl.F_SETFL, fcntl.fcntl(reading, fcntl.F_GETFL) | os.O_ASYNC)
                yield process
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
    finally:
        os.close(reading)
        os.close(writing)
