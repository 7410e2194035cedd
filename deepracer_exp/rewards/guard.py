"""The guard around untrusted code: a time limit, Ctrl-C, and protection of shared objects."""

import builtins
import signal
import sys
import threading
import time
from types import FrameType, TracebackType
from typing import Any, Self

_WALL_FACTOR = 10
"""Wall-clock limit over CPU limit: the machine may be that busy, and `sleep` uses no CPU."""
_STREAMS = ("stdin", "stdout", "stderr")


class Misconduct(BaseException):
    """A violation found by the guard; not an `Exception`, so that guarded code does not catch it by accident."""


class DeadlinePassed(Misconduct):
    """The time limit was exceeded."""


class CtrlC(KeyboardInterrupt):
    """The user's Ctrl-C; any other KeyboardInterrupt is one that the guarded code raised."""


class Guard:
    """Runs a block of untrusted code; a context manager.

    The limit is CPU time of this thread: however busy the machine is, only the code itself can use it up. Code that
    waits without computing is stopped after `_WALL_FACTOR` times the limit; time in which the whole process was
    stopped does not count. The error is raised repeatedly, to get out of a loop whose bare `except:` swallowed it.
    There is no limit outside the main thread, to which Python delivers signals, and on platforms without interval
    timers; C code that never returns to the interpreter cannot be stopped.

    Shared objects are restored at the end: built-ins, standard streams, the handlers of the two signals used.

    Raises:
        DeadlinePassed: inside the block: it exceeded its time limit.
        Misconduct: at the end: the block replaced a built-in, or replaced or closed a standard stream.
        CtrlC: the user's, even where the block swallowed it.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._interrupted = False
        self._has_signals = (
            hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
        )

    def __enter__(self) -> Self:
        self._builtins = builtins.__dict__.copy()
        self._streams = {name: getattr(sys, name) for name in _STREAMS}
        self._closed = {name: _is_closed(stream) for name, stream in self._streams.items()}
        self._entered_s = time.monotonic()
        self.restart()
        if self._has_signals:
            # Only a handler in Python can raise an exception.
            self._sigint = signal.getsignal(signal.SIGINT)
            if callable(self._sigint):
                signal.signal(signal.SIGINT, self._on_ctrl_c)
            self._sigalrm = signal.signal(signal.SIGALRM, self._on_alarm)
            self._timer = self._arm(self._limit_s)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        violation = self._restore()
        if self._has_signals:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._sigalrm)
            if callable(self._sigint):
                signal.signal(signal.SIGINT, self._sigint)
            left, interval = self._timer
            if left:
                # A timer that has expired meanwhile fires at once; 0 would switch it off.
                left = max(left - (time.monotonic() - self._entered_s), 1e-3)
                signal.setitimer(signal.ITIMER_REAL, left, interval)
        if self._interrupted and not isinstance(error, CtrlC):
            raise CtrlC
        if violation and not isinstance(error, Misconduct | CtrlC):  # it may be the cause of any other error
            raise Misconduct(violation)

    def restart(self) -> None:
        """Restart the time limit, which is far cheaper than a new guard."""
        self._cpu_began_s = time.thread_time()
        self._waited_s = 0.0

    def _arm(self, after_s: float) -> tuple[float, float]:
        """Set the timer to so many seconds, and from then on to intervals of the limit; return the previous timer."""
        self._armed_s = after_s
        return signal.setitimer(signal.ITIMER_REAL, after_s, self._limit_s)

    def _on_alarm(self, signum: int, frame: FrameType | None) -> None:
        # Not the clock: a pause of the whole process counts as one interval at most.
        self._waited_s += self._armed_s
        used_s = time.thread_time() - self._cpu_began_s
        wait_s = self._limit_s * _WALL_FACTOR
        left_s = min(self._limit_s - used_s, wait_s - self._waited_s)
        if left_s > 0:
            self._arm(max(left_s, 1e-3))
            return
        self._armed_s = self._limit_s
        limit = f"the time limit of {self._limit_s:g} s of CPU for one step"
        waits = f"{wait_s:g} s without computing: {_WALL_FACTOR} times {limit}"
        raise DeadlinePassed(f"took longer than {limit if used_s >= self._limit_s else waits}")

    def _on_ctrl_c(self, signum: int, frame: FrameType | None) -> None:
        assert callable(self._sigint)
        try:
            self._sigint(signum, frame)
        except KeyboardInterrupt:
            self._interrupted = True
            raise CtrlC from None

    def _restore(self) -> str:
        """Restore what was replaced; return a message about it, or an empty string."""
        # Until built-ins are restored, none may be used: it may be a replaced one.
        names, before = builtins.__dict__, self._builtins
        replaced = [
            f"builtins.{name}" for name in before if name not in names or names[name] is not before[name]
        ]
        names.update(before)
        for name, stream in self._streams.items():
            if getattr(sys, name, None) is not stream:
                replaced.append(f"sys.{name}")
                setattr(sys, name, stream)
        closed = [
            f"sys.{name}"
            for name, stream in self._streams.items()
            if not self._closed[name] and _is_closed(stream)
        ]
        if closed:  # further output goes to the stream that is left
            out, err = sys.stdout, sys.stderr
            sys.stdout = err if _is_closed(out) else out
            sys.stderr = out if _is_closed(err) else err
        for done, names_of in ("replaced", replaced), ("closed", closed):
            if names_of:
                return f"{done} {names_of[0]}, which everything else here uses too"
        return ""


def _is_closed(stream: Any) -> bool:
    return bool(getattr(stream, "closed", False))
