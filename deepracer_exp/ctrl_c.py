"""Ctrl-C while modules are imported, which takes a command its first seconds."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], Any] | int | None
_IMPORTING = "<frozen importlib._bootstrap>"
_INTERRUPTED = 130


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Have Ctrl-C end the process at once within the block: nothing has been done that could be cleaned up."""
    before = set_handler(_end)
    try:
        yield
    finally:
        set_handler(before)


def set_handler(handler: Handler) -> Handler:
    """Have Ctrl-C call a handler, and return the one before; of no effect in a thread, or where it is ignored."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is threading.main_thread() and before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, handler)
    return before


def interrupt(_: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or end the process within an import: there libraries report it, or abort the process."""
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTING:
            _end()
        frame = frame.f_back
    raise KeyboardInterrupt


def _end(*_: object) -> None:
    os._exit(_INTERRUPTED)
