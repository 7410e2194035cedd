"""Execution of reward code: its module, a time limit for blocks of it, and its errors in words."""

import signal
import threading
import time
import traceback
from types import CodeType, FrameType
from typing import Any, Self

_LOOKS = 4
"""Number of checks within the time limit."""
_WAIT_FACTOR = 10
"""Wall-clock limit of code that waits, as in `sleep`, as a multiple of the CPU limit."""
_WAITS = 0.01
"""Share of the time between two looks: code that computes less than this waits."""


def run_module(code: CodeType, namespace: dict[str, Any]) -> None:
    """Run the compiled module of a reward function in a namespace; only here a text is executed as a program."""
    exec(code, namespace)


def what_was_raised(error: BaseException, path: str) -> str:
    """Describe an error of the code of the file `path` in one line with its place."""
    lines = [
        line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == path
    ]
    place = f" in line {lines[-1]} of {path}" if lines else ""
    try:
        message = " ".join(str(error).split())
    except BaseException:  # noqa: BLE001 - of the error's own code
        return f"raised an error that cannot be printed{place}"
    return f"raised {type(error).__name__}{': ' * bool(message)}{message[:300]}{place}"


class TimeLimitPassed(BaseException):
    """A reward function took too long; no `Exception`, so that its own `except Exception` does not catch it."""


class TimeLimit:
    """Ends a block of a reward function's code that computes or waits for too long; a context manager.

    The limit is CPU time of this thread: however busy the machine is, only the code itself can use it up. Code that
    waits without computing is ended after `_WAIT_FACTOR` times the limit, of which a pause of the whole process uses
    up one look, and the time in which the code computes on a busy machine none.

    Python passes signals on to the main thread, between two of its instructions. In other threads, on platforms without
    interval timers and within code in C there is no limit; a worker that hangs there is ended by the watchdog.

    Raises:
        TimeLimitPassed: inside the block, at each look until it is left.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._waits = 0
        """Looks since whose last one the code has not computed."""
        self._is_over = False
        self._holds = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()

    def __enter__(self) -> Self:
        if self._holds:
            self._cpu_began_s = self._cpu_s = time.thread_time()
            self._handler = signal.signal(signal.SIGALRM, self._check)
            every_s = self._limit_s / _LOOKS
            self._timer = signal.setitimer(signal.ITIMER_REAL, every_s, every_s)
            self._began_s = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        if self._holds:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._handler)
            left_s, interval_s = self._timer
            if left_s:
                # A timer that has expired meanwhile fires at once; 0 would switch it off.
                left_s = max(left_s - (time.monotonic() - self._began_s), 1e-3)
                signal.setitimer(signal.ITIMER_REAL, left_s, interval_s)

    def _check(self, signum: int, frame: FrameType | None) -> None:
        if self._is_over or frame is None or frame.f_code.co_filename == __file__:
            return
        before_s, self._cpu_s = self._cpu_s, time.thread_time()
        self._waits += self._cpu_s - before_s < _WAITS * self._limit_s / _LOOKS
        limit = f"the time limit of {self._limit_s:g} s of CPU for one step"
        if self._cpu_s - self._cpu_began_s >= self._limit_s:
            raise TimeLimitPassed(f"took longer than {limit}")
        if self._waits >= _WAIT_FACTOR * _LOOKS:
            waits = f"{self._limit_s * _WAIT_FACTOR:g} s without computing: {_WAIT_FACTOR} times {limit}"
            raise TimeLimitPassed(f"took longer than {waits}")
