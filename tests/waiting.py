"""Waiting for what must happen, however busy the machine is; and for processes to end."""

import time
from collections.abc import Callable
from typing import TypeVar

import psutil

Value = TypeVar("Value")

PATIENCE_S = 1500.0
"""For what comes within seconds on a quiet machine; below the time that pytest gives a test."""


def wait_until(condition: Callable[[], Value], what: str = "it") -> Value:
    """Wait until a condition holds and return it."""
    give_up_at = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < give_up_at, f"no {what} within {PATIENCE_S:g} s"
        time.sleep(0.02)
    return value


def is_alive(process: psutil.Process) -> bool:
    """Return whether it runs; where nothing reads the ends of lost processes, it stays as a zombie."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:  # it ended between the two questions
        return False
