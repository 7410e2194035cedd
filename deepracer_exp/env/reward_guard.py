"""The guard around code that is not ours: its time limit, its own Ctrl-C, and what it must leave alone."""

import builtins
import signal
import sys
import threading
import time
from types import FrameType, TracebackType
from typing import Any, Self

_WALL_FACTOR = 10
"""How often the limit of CPU time fits into the limit of waiting: a machine may be that busy, `sleep` uses no CPU."""
_STREAMS = ("stdin", "stdout", "stderr")


class Misconduct(BaseException):
    """What the guard found; no `Exception`, so that `except Exception` in guarded code lets it through."""


class DeadlinePassed(Misconduct):
    """The time was up."""


class CtrlC(KeyboardInterrupt):
    """The user's Ctrl-C; any other KeyboardInterrupt is one that the guarded code raised."""


class Guard:
    """Runs a block of code that nobody vouches for; a context manager.

    The limit is CPU time of this thread: however busy the machine is, only the code itself can use it up. Code that
    waits without computing is stopped after `_WALL_FACTOR` times the limit; time in which the whole process was
    stopped does not count. The limit is raised again and again, to get out of a loop whose bare `except:` swallowed it.
    There is no limit outside the main thread and on platforms without interval timers, because Python delivers signals
    nowhere else; nor can C code that never returns to the interpreter be stopped.

    What all code shares is put back at the end: built-ins, standard streams, the handlers of the two signals used.

    Raises:
        DeadlinePassed: inside the block: its time was up.
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
            # A Python function can tell who called it; a handler of another kind raises nothing.
            self._sigint = signal.getsignal(signal.SIGINT)
            if callable(self._sigint):
                signal.signal(signal.SIGINT, self._hear_ctrl_c)
            self._sigalrm = signal.signal(signal.SIGALRM, self._look)
            self._timer = self._arm(self._limit_s)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        spoiled = self._put_back()
        if self._has_signals:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._sigalrm)
            if callable(self._sigint):
                signal.signal(signal.SIGINT, self._sigint)
            left, interval = self._timer
            if left:
                # A timer that ran out meanwhile fires at once; 0 would switch it off.
                left = max(left - (time.monotonic() - self._entered_s), 1e-3)
                signal.setitimer(signal.ITIMER_REAL, left, interval)
        if self._interrupted and not isinstance(error, CtrlC):
            raise CtrlC
        if spoiled and not isinstance(error, Misconduct | CtrlC):  # whatever else went wrong may come of it
            raise Misconduct(spoiled)

    def restart(self) -> None:
        """Begin the time again, which costs far less than another guard."""
        self._cpu_began_s = time.thread_time()
        self._waited_s = 0.0

    def _arm(self, after_s: float) -> tuple[float, float]:
        """Look after so many seconds, and from then on in intervals of the limit; return the timer there was."""
        self._armed_s = after_s
        return signal.setitimer(signal.ITIMER_REAL, after_s, self._limit_s)

    def _look(self, signum: int, frame: FrameType | None) -> None:
        # Not the clock: of a pause of the whole process no more is counted than one interval.
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

    def _hear_ctrl_c(self, signum: int, frame: FrameType | None) -> None:
        assert callable(self._sigint)
        try:
            self._sigint(signum, frame)
        except KeyboardInterrupt:
            self._interrupted = True
            raise CtrlC from None

    def _put_back(self) -> str:
        """Put back what was replaced; return what was, an empty string for nothing."""
        # Before it has ended, no built-in may be used: it may be a replaced one.
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
        if closed:  # what is still to be said goes to the one that is left
            out, err = sys.stdout, sys.stderr
            sys.stdout = err if _is_closed(out) else out
            sys.stderr = out if _is_closed(err) else err
        for done, names_of in ("replaced", replaced), ("closed", closed):
            if names_of:
                return f"{done} {names_of[0]}, which everything else here uses too"
        return ""


def _is_closed(stream: Any) -> bool:
    return bool(getattr(stream, "closed", False))
