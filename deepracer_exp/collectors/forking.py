"""The server that workers are forked from, started before the imports that take seconds."""

import os
import signal
import sys

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""What is sent to the process group for the training process alone, which ends its workers."""
_PROGRAM = "deepracer_exp.cli"
"""What every worker imports first: the program of the process that started it."""


def start_workers_early(wanted: bool, *modules: str) -> None:
    """Start the server that workers are forked from, if wanted, which imports what they need in the meantime.

    It must be called in the main thread, with whose end the server ends. `modules` are imported for workers of a sweep;
    without them, what workers of a collector need.
    """
    if not wanted or not sys.platform.startswith("linux"):
        return
    import multiprocessing
    from multiprocessing import forkserver

    multiprocessing.set_start_method("forkserver", force=True)
    package = "deepracer_exp.collectors"
    needed = modules or (f"{package}.worker",)
    multiprocessing.set_forkserver_preload(
        [f"{package}.fork_server", *needed, _PROGRAM, f"{package}.fork_ready"]
    )
    # Workers share the cores among themselves already; a linear-algebra thread pool in each would only compete.
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    # The server inherits this until it ignores them; here they are acted on afterwards.
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before
