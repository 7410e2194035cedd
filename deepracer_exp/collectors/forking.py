"""The server that workers are forked from, started before the imports that take seconds."""

import os
import signal
import sys

_PROGRAM = "deepracer_exp.cli"
"""What every worker imports first: the program of the process that started it."""


def start_workers_early(wanted: bool, *modules: str) -> None:
    """Start the server that workers are forked from, which imports what they need while this process does its part.

    One that runs already stays, or is ended if no workers are wanted. `modules` are imported for workers of a sweep;
    without them, what workers of a collector need.
    """
    # By the clock, a worker waits so long for its first weights before it dies. Who hangs, the watchdog judges.
    os.environ.setdefault("WEIGHT_SYNC_TIMEOUT", "86400")
    if not sys.platform.startswith("linux"):
        return
    import multiprocessing
    from multiprocessing import forkserver

    if not wanted:
        forkserver._forkserver._stop()  # type: ignore[attr-defined]
        return

    multiprocessing.set_start_method("forkserver", force=True)
    package = "deepracer_exp.collectors"
    needed = modules or (f"{package}.worker",)
    multiprocessing.set_forkserver_preload(
        [f"{package}.fork_server", *needed, _PROGRAM, f"{package}.fork_ready"]
    )
    # Workers share the cores among themselves already; a linear-algebra thread pool in each would only compete.
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    # Signals to the process group are for the training process alone. The server inherits what is ignored now.
    handlers = {signum: signal.signal(signum, signal.SIG_IGN) for signum in (signal.SIGINT, signal.SIGTERM)}
    forkserver.ensure_running()
    for signum, handler in handlers.items():
        signal.signal(signum, handler)
    if before is None:
        del os.environ["OMP_NUM_THREADS"]
    else:
        os.environ["OMP_NUM_THREADS"] = before
