"""A command in a child process: whatever a reward function does to that process, the exit code is true."""

import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType

from deepracer_exp.errors import RunFailed
from deepracer_exp.lifeline import die_with_parent

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_ARRIVES_S = 0.1
"""By then a signal for the whole process group has reached the child or is pending, and another one changes nothing."""


def supervised(call: Callable[[], int]) -> int:
    """Call a function in a child process and return its result, an exit code.

    Reward functions run within a command's process. They can leave it (`os._exit(0)`), crash it or spoil what Python
    itself needs. Hence an exit code counts only if it comes through a pipe, after the call has returned. A process that
    ends in another way has failed; one line says so, from a process in which no reward has run.

    Args:
        call: returns 0 to 255; what it raises is the child's own end, with a traceback.
    """
    if not hasattr(os, "fork"):
        return call()
    results, result = os.pipe()
    heard, hears = os.pipe()
    supervisor = os.getpid()
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    child = os.fork()
    if child == 0:
        os.close(results)
        os.close(heard)
        die_with_parent()
        if os.getppid() != supervisor:
            os._exit(RunFailed.exit_code)
        # Python writes the number of each signal it gets there.
        os.set_blocking(hears, False)
        signal.set_wakeup_fd(hears, warn_on_full_buffer=False)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        code = call()
        os.write(result, bytes([code]))
        return code
    os.close(result)
    os.close(hears)

    def pass_on(signum: int, _: FrameType | None) -> None:
        """Give the child a signal that was sent to this process alone; Ctrl-C in a terminal reaches both."""
        if not _has_heard(heard, signum):
            os.kill(child, signum)

    for signum in _SIGNALS:
        signal.signal(signum, pass_on)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    # Not until its end: a process that the child has forked may still hold the pipe.
    os.set_blocking(results, False)
    with contextlib.suppress(BlockingIOError):
        received = os.read(results, 1)
        if received:
            return received[0]
    if -ended in _SIGNALS:
        return 128 - ended
    how = f"left it with exit code {ended}" if ended >= 0 else f"was ended by {signal.Signals(-ended).name}"
    print(
        f"deepracer-exp: the process {how} before the command was done; a reward function can do that",
        file=sys.stderr,
    )
    return RunFailed.exit_code


def _has_heard(heard: int, signum: int) -> bool:
    give_up_at = time.monotonic() + _ARRIVES_S
    while select.select([heard], [], [], max(give_up_at - time.monotonic(), 0.0))[0]:
        received = os.read(heard, 65536)
        if signum in received:
            return True
        if not received:  # the child is gone
            break
    return False
