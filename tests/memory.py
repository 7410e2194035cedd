"""How much memory Python's own objects take at most while something is done."""

import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def traced() -> Iterator[Callable[[], int]]:
    """Trace the block; the call says how many bytes it took at most so far.

    What is imported meanwhile counts: read something of the kind before.
    """
    tracemalloc.start()
    try:
        yield lambda: tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
