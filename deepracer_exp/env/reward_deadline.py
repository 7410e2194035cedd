"""A wall-clock limit on code that may hang."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class DeadlinePassed(BaseException):
    """The time was up; no `Exception`, so that `except Exception` in a reward function lets it through."""


def _raise_deadline_passed(signum: int, frame: FrameType | None) -> None:
    raise DeadlinePassed


@contextmanager
def deadline(seconds: float) -> Iterator[Callable[[], object]]:
    """Raise DeadlinePassed inside the block once `seconds` have passed, and again every `seconds`.

    The repetition gets out of a loop whose bare `except:` swallowed the first one. Handler and timer found
    are put back. There is no limit outside the main thread and on platforms without interval timers, because
    Python delivers signals nowhere else; nor can C code that never returns to the interpreter be stopped.

    The value of the `with` statement is a function that starts the time anew, which costs far less than a new block.
    """
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    before = time.monotonic()
    handler = signal.signal(signal.SIGALRM, _raise_deadline_passed)
    left, interval = signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
    try:
        yield lambda: signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler)
        if left:
            # A timer that ran out meanwhile fires at once; 0 would switch it off.
            signal.setitimer(signal.ITIMER_REAL, max(left - (time.monotonic() - before), 1e-3), interval)
