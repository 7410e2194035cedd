"""The server that workers are forked from, started before the imports that take seconds."""

import os
import signal
import sys

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that reach the whole process group but are meant for the training process, which ends its workers."""
_PROGRAM = "deepracer_exp.cli"
"""Module that every worker imports first: the program of the process that started it."""


def start_workers_early(wanted: bool, *modules: str) -> None:
    """Start the server that workers are forked from, if needed; it imports their modules in the background.

    It must be called in the main thread, with whose end the server ends. `modules` are imported for workers of a sweep;
    without them, those of a collector's workers.
    """
    if not wanted or not sys.platform.startswith("linux"):
        return
    import multiprocessing
    from multiprocessing import forkserver

    multiprocessing.set_start_method("forkserver", force=True)
    package = "deepracer_exp.collectors"
    needed = modules or (f"{package}.car_worker",)
    multiprocessing.set_forkserver_preload(
        [f"{package}.fork_server", *needed, _PROGRAM, f"{package}.fork_ready"]
    )
    # Workers share the cores among themselves already; a linear-algebra thread pool in each would only compete.
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    # Blocked until the server, which inherits this, ignores them; here they are handled afterwards.
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before
