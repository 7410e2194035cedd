"""Processes that end with their owner, the process that started them, however that one dies.

The owner alone holds the writing end of a pipe, and what it started holds the reading end. When the owner is gone, its
end is closed, and the kernel kills the process at the other end at once, even one that hangs or is stopped (fcntl(2),
F_SETSIG and F_SETOWN: Linux only; elsewhere a thread waits for the owner). PR_SET_PDEATHSIG alone would not do: it
watches the process that forked, which for a worker is a fork server that its workers keep alive.
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
from multiprocessing.connection import wait
from typing import Any

_IS_LINUX = sys.platform == "linux"
_SAFE_PATH = "PYTHONSAFEPATH"
_GIVEN_SAFE_PATH = os.environ.get(_SAFE_PATH)


def guard_imports() -> None:
    """Have no Python that is started from now on import from the working folder.

    With `-c` and `-m` Python looks there first: a fork server would import the user's `queue.py` in place of its own.
    """
    os.environ[_SAFE_PATH] = "1"


def given_environment() -> dict[str, str]:
    """Return the environment without what `guard_imports` has set, for a program of the user's own."""
    variables = {} if _GIVEN_SAFE_PATH is None else {_SAFE_PATH: _GIVEN_SAFE_PATH}
    return {name: value for name, value in os.environ.items() if name != _SAFE_PATH} | variables


def kill_when_closed(pipe: int, target: int) -> None:
    """Have a process killed once the writing end of a pipe is closed.

    Args:
        pipe: reading end, with nothing left to read; the target must keep it open.
        target: id of the process; negative: of a process group, all of which is killed.
    """
    fcntl.fcntl(pipe, fcntl.F_SETOWN, target)
    fcntl.fcntl(pipe, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)
    if wait([pipe], timeout=0):  # closed before the kernel was asked to look
        os.kill(target, signal.SIGKILL)


def die_with_parent() -> None:
    """Have this process killed once the thread that forked it is gone: for a parent that forks from its main thread."""
    if _IS_LINUX:
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def end_with_owner() -> None:
    """End this process, which `multiprocessing` started, with the one that started it.

    One that was forked from a fork server ends with that server, too: only the server could report its end to the
    owner.
    """
    owner = multiprocessing.parent_process()
    assert owner is not None
    if not _IS_LINUX:

        def follow() -> None:
            owner.join()
            os.kill(os.getpid(), signal.SIGKILL)

        threading.Thread(target=follow, name="owner", daemon=True).start()
        return
    if os.getppid() != owner.pid:
        die_with_parent()
    kill_when_closed(owner.sentinel, os.getpid())


@contextmanager
def running(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program, in a session of its own, that ends with the block or with this process, whichever is first.

    The program runs in a session of its own; `options` are those of `subprocess.Popen`.

    All that the program has started in its process group ends with it.

    Raises:
        OSError: it cannot be run.
    """
    reading, writing = os.pipe()
    try:
        with subprocess.Popen(command, start_new_session=True, pass_fds=[reading], **options) as process:
            try:
                if _IS_LINUX:
                    kill_when_closed(reading, -process.pid)
                yield process
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
    finally:
        os.close(reading)
        os.close(writing)
