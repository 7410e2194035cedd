"""Faults at a moment of a command that is called in the process of the test."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tests.training.conftest import workers_start_early

__all__ = ["workers_start_early"]


@contextmanager
def meanwhile(is_time: Callable[[], object], act: Callable[[], None]) -> Iterator[None]:
    """Act once it is time, in a thread, unless the block ends before; it must not."""
    over, has_acted = threading.Event(), threading.Event()

    def watch() -> None:
        while not over.wait(0.02):
            if is_time():
                act()
                has_acted.set()
                return

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
    assert has_acted.is_set(), "it ended before"
