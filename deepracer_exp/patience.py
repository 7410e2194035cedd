"""Timeouts that tell a hung process from one that a busy machine slows down.

A wall-clock limit alone kills healthy processes: with a dozen others competing for the cores, a start of 25 s takes
minutes. So a process that computes is charged CPU time, and wall-clock time only while it is idle.
"""

import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import psutil

LOOK_EVERY_S = 0.5
_IDLE_SHARE = 0.01
"""Share of a core up to which a process counts as idle: hanging threads wake up now and then."""


@dataclass(frozen=True)
class Use:
    """Use of the machine by processes, at one moment."""

    cpu_s: float
    """CPU time of all of them since their start."""
    is_ready: bool
    """Whether one of them computes now, or would if it had a core."""


def use_of(*pids: int) -> Use:
    """Return the use by these processes and their descendants; ended ones count nothing."""
    cpu_s, is_ready = 0.0, False
    for process in _with_children(pids):
        with suppress(psutil.NoSuchProcess, psutil.AccessDenied), process.oneshot():
            cpu_s += sum(process.cpu_times()[:4])  # with those of ended children
            is_ready |= process.status() == psutil.STATUS_RUNNING
    return Use(cpu_s, is_ready)


def use_of_this() -> Use:
    """Return the use by the other threads of this process and by its descendants."""
    use = use_of(*(process.pid for process in psutil.Process().children()))
    ended = os.times()
    own_s = time.process_time() - time.thread_time() + ended.children_user + ended.children_system
    return Use(use.cpu_s + own_s, use.is_ready)


def _with_children(pids: Iterable[int]) -> Iterable[psutil.Process]:
    for pid in pids:
        with suppress(psutil.NoSuchProcess):
            process = psutil.Process(pid)
            yield from (process, *process.children(recursive=True))


class Silence:
    """Counts the time that an awaited answer takes.

    Attributes:
        computed_s: seconds of CPU that the processes used meanwhile, at most those of the clock.
        idle_s: seconds of the clock in which they used none, and did not wait for a core either.
        clock_s: seconds of the clock, whatever they did.
    """

    def __init__(self) -> None:
        """Count from the first look."""
        self.restart()

    def restart(self) -> None:
        """Restart from the next look: the answer has arrived."""
        self.computed_s = self.idle_s = self.clock_s = 0.0
        self._seen: tuple[Use, float] | None = None

    def look(self, use: Use, now_s: float) -> float:
        """Return the seconds counted so far; `now_s` is by the monotonic clock."""
        if self._seen is not None:
            before, looked_s = self._seen
            self.clock_s += now_s - looked_s
            used_s = use.cpu_s - before.cpu_s  # below 0 if a child is gone
            if abs(used_s) > _IDLE_SHARE * (now_s - looked_s):
                self.computed_s += min(max(used_s, 0.0), now_s - looked_s)
            elif not use.is_ready:
                # A longer pause was ours: the whole run stopped with Ctrl-Z, or the machine asleep.
                self.idle_s += min(now_s - looked_s, 2 * LOOK_EVERY_S)
        self._seen = use, now_s
        return self.computed_s + self.idle_s

    def __str__(self) -> str:
        """Return the seconds in words, with the load of the machine, for the message of a timeout."""
        load, cores = os.getloadavg()[0], os.cpu_count()
        return (
            f"{self.computed_s:.0f} s of CPU and {self.idle_s:.0f} s in which it did nothing "
            f"(load average {load:.1f} on {cores} cores)"
        )


def ends(thread: threading.Thread) -> Callable[[float], bool]:
    """Return a function that waits for the end of a thread, for `wait_patiently`."""

    def arrives(seconds: float) -> bool:
        thread.join(seconds)
        return not thread.is_alive()

    return arrives


def wait_patiently(
    arrives: Callable[[float], bool], limit_s: float, use: Callable[[], Use] = use_of_this
) -> Silence | None:
    """Wait until something arrives, for at most `limit_s` as `Silence` counts them.

    Args:
        arrives: waits for it, at most the given seconds, and returns whether it has arrived.
        limit_s: patience with the processes.
        use: of the machine by the processes.

    Returns:
        None if it has arrived, else the silence that exceeded the limit.
    """
    silence = Silence()
    while not arrives(min(LOOK_EVERY_S, limit_s)):
        if silence.look(use(), time.monotonic()) >= limit_s:
            return silence
    return None


def communicate(
    process: subprocess.Popen[bytes], limit_s: float, stdin: bytes | None = None
) -> tuple[bytes, bytes]:
    """Return the output and errors of a program that reads `stdin`, once it has ended.

    Raises:
        TimeoutError: it has not ended within the limit, as `Silence` counts, and still runs.
    """
    written: list[tuple[bytes, bytes]] = []
    left = [stdin]

    def ended(seconds: float) -> bool:
        with suppress(subprocess.TimeoutExpired):
            written.append(process.communicate(left.pop() if left else None, seconds))
        return bool(written)

    silence = wait_patiently(ended, limit_s, partial(use_of, process.pid))
    if silence is not None:
        raise TimeoutError(str(silence))
    return written[0]
