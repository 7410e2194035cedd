"""Warnings of the project, shown to whom has typed the command."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def warnings_on_stderr() -> Iterator[None]:
    """Write the project's warnings to standard error meanwhile, a line each."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.WARNING)
    handler.setFormatter(logging.Formatter("warning: %(message)s"))
    logger = logging.getLogger("deepracer_exp")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
