"""The guard around untrusted code: a time limit, Ctrl-C, and protection of shared objects."""

import _signal  # type: ignore[import-not-found]
import builtins
import operator
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.process import BaseProcess
from types import CodeType, FrameType, TracebackType
from typing import Any, Self

_WAIT_FACTOR = 10
"""Limit of waiting, such as in `sleep`, which uses no CPU, over the limit of CPU time."""
_STREAMS = {"stdin": 0, "stdout": 1, "stderr": 2}
"""The standard streams and the numbers of their files."""
_REFUSED: tuple[tuple[Any, str], ...] = (
    *(
        (signal, name)
        for name in ("signal", "setitimer", "alarm", "pthread_sigmask")
        if hasattr(signal, name)
    ),
    *((owner, "start") for owner in (threading.Thread, BaseProcess)),
)
"""Functions that guarded code must not call, as owner and name."""


def run_module(code: CodeType, namespace: dict[str, Any]) -> None:
    """Run the compiled module of a reward function in a namespace; only here a text is executed as a program."""
    exec(code, namespace)


class Misconduct(BaseException):
    """A violation found by the guard; not an `Exception`, so that guarded code does not catch it by accident."""


class DeadlinePassed(Misconduct):
    """The time limit was exceeded."""


class CtrlC(KeyboardInterrupt):
    """The user's Ctrl-C; any other KeyboardInterrupt is one that the guarded code raised."""


# Those below `signal`, which looks up an enumeration's member each time: ten times as long as setting a handler.
_set_handler, _get_handler = _signal.signal, _signal.getsignal
_set_timer: Any = getattr(signal, "setitimer", None)
_open, _read, _close = os.open, os.read, os.close
_all, _map, _is, _len = all, map, operator.is_, len
"""Built-ins to compare built-ins with: by then they may be replaced."""
_inside: set[int] = set()
"""Threads that are in a guarded block."""


def _queued_s() -> float:
    """Return the seconds for which this thread has been ready and had no core (Linux; elsewhere 0)."""
    try:
        file = _open("/proc/thread-self/schedstat", os.O_RDONLY)
    except OSError:
        return 0.0
    text = _read(file, 100)
    _close(file)
    return int(text.split()[1]) * 1e-9


def _refusal(owner: Any, name: str) -> Callable[..., Any]:
    """Return what stands for a function that guarded code must not call; other threads may call it."""
    original = getattr(owner, name)

    def refused(*args: Any, **options: Any) -> Any:
        if threading.get_ident() in _inside:
            raise Misconduct(f"called {owner.__name__}.{name}, which a reward function must not")
        return original(*args, **options)

    return refused


_ORIGINALS = [(owner, name, getattr(owner, name)) for owner, name in _REFUSED]
_REFUSALS = [(owner, name, _refusal(owner, name)) for owner, name in _REFUSED]


class Guard:
    """Runs a block of untrusted code; a context manager.

    The limit is CPU time of this thread: however busy the machine is, only the code itself can use it up. Code that
    waits without computing is stopped after `_WAIT_FACTOR` times the limit; time in which it waits for a core, or in
    which the whole process was stopped, does not count. The error is raised again and again, to get out of a loop whose
    bare `except:` swallows it.
    There is no limit outside the main thread, to which Python delivers signals, and on platforms without interval
    timers; C code that never returns to the interpreter cannot be stopped.

    Shared objects are restored at the end: built-ins, standard streams, the handlers of the two signals used. What
    could switch the limit off, or outlive the block and keep the process from ending, is refused meanwhile: see
    `_REFUSED`.

    Raises:
        DeadlinePassed: inside the block: it exceeded its time limit.
        Misconduct: inside the block: it called what is refused. At the end: it replaced a built-in, or replaced or
            closed a standard stream.
        CtrlC: the user's, even where the block swallowed it.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._interrupted = False
        self._raised = 0
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
            self._sigint = _get_handler(signal.SIGINT)
            if callable(self._sigint):
                _set_handler(signal.SIGINT, self._on_ctrl_c)
            self._sigalrm = _set_handler(signal.SIGALRM, self._on_alarm)
            self._timer = self._arm(self._limit_s)
        for owner, name, refusal in _REFUSALS:
            setattr(owner, name, refusal)
        self._is_outermost = threading.get_ident() not in _inside
        _inside.add(threading.get_ident())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        violation = self._restore()
        if self._is_outermost:
            _inside.discard(threading.get_ident())
            for owner, name, original in _ORIGINALS:
                setattr(owner, name, original)
        if self._has_signals:
            _set_timer(signal.ITIMER_REAL, 0.0)
            _set_handler(signal.SIGALRM, self._sigalrm)
            if callable(self._sigint):
                _set_handler(signal.SIGINT, self._sigint)
            left, interval = self._timer
            if left:
                # A timer that has expired meanwhile fires at once; 0 would switch it off.
                left = max(left - (time.monotonic() - self._entered_s), 1e-3)
                _set_timer(signal.ITIMER_REAL, left, interval)
        if self._interrupted and not isinstance(error, CtrlC):
            raise CtrlC
        if violation and not isinstance(error, Misconduct | CtrlC):  # it may be the cause of any other error
            raise Misconduct(violation)

    def restart(self) -> None:
        """Restart the time limit, which is far cheaper than a new guard."""
        self._cpu_began_s = time.thread_time()
        self._waited_s = 0.0
        self._queued_s: float | None = None

    def _arm(self, after_s: float) -> tuple[float, float]:
        """Set the timer to so many seconds, and from then on to intervals of the limit; return the previous timer."""
        self._armed_s = after_s
        return _set_timer(signal.ITIMER_REAL, after_s, self._limit_s)

    def _on_alarm(self, signum: int, frame: FrameType | None) -> None:
        # Not the clock: a pause of the whole process counts as one interval at most.
        queued_s, before_s = _queued_s(), self._queued_s
        self._queued_s = queued_s
        if before_s is not None:  # at the first alarm it is not known what part was waiting for a core
            self._waited_s += max(self._armed_s - (queued_s - before_s), 0.0)
        if frame is not None and frame.f_code.co_filename == __file__:
            self._arm(1e-3)  # what was replaced is being restored, which must not be interrupted
            return
        used_s = time.thread_time() - self._cpu_began_s
        wait_s = self._limit_s * _WAIT_FACTOR
        left_s = min(self._limit_s - used_s, wait_s - self._waited_s)
        if left_s > 0:
            self._arm(max(left_s, 1e-3))
            return
        limit = f"the time limit of {self._limit_s:g} s of CPU for one step"
        waits = f"{wait_s:g} s without computing: {_WAIT_FACTOR} times {limit}"
        error = DeadlinePassed(f"took longer than {limit if used_s >= self._limit_s else waits}")
        # Again after a microsecond, two, four, ...: one of these meets a loop outside the `try` that catches the error.
        self._raised += 1
        self._arm(1e-6 * 2 ** (self._raised % 10))
        raise error

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
        replaced = []
        if _len(names) != _len(before) or not _all(_map(_is, names.values(), before.values())):
            replaced = [
                f"builtins.{name}" for name in before if name not in names or names[name] is not before[name]
            ]
            names.update(before)
        for name, stream in self._streams.items():
            if getattr(sys, name, None) is not stream:
                replaced.append(f"sys.{name}")
                setattr(sys, name, stream)
        closed = []
        for name, stream in self._streams.items():
            if not self._closed[name] and _is_closed(stream):
                closed.append(f"sys.{name}")
                _open_again(name, stream)
        for done, names_of in ("replaced", replaced), ("closed", closed):
            if names_of:
                return f"{done} {names_of[0]}, which everything else here uses too"
        return ""


def _is_closed(stream: Any) -> bool:
    try:
        return bool(getattr(stream, "closed", False))
    except ValueError:  # its buffer was detached
        return True


def _open_again(name: str, stream: Any) -> None:
    """Replace a closed standard stream: by one to the same file, which Python leaves open, or by a stream that is left.

    One that is not the interpreter's own, such as a notebook's, has no file to open.
    """
    if stream is getattr(sys, f"__{name}__"):
        with suppress(OSError):
            mode = "r" if name == "stdin" else "w"
            again = open(_STREAMS[name], mode, 1, "utf-8", "backslashreplace", closefd=False)  # noqa: SIM115
            setattr(sys, f"__{name}__", again)
            setattr(sys, name, again)
            return
    left = [other for other in (sys.stdout, sys.stderr) if not _is_closed(other)]
    if left and name != "stdin":
        setattr(sys, name, left[0])
