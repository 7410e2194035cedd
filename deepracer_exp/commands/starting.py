"""What is begun before the imports that take seconds."""

import os
import signal
import sys
from pathlib import Path

from deepracer_exp.formats.run_files import read_config


def start_workers_early(wanted: bool, module: str = "deepracer_exp.training.worker") -> None:
    """Let a server process import torch while this one does, so that workers fork from it at once.

    Args:
        wanted: whether there will be workers.
        module: what workers need, imported once by the server.
    """
    if not wanted or not sys.platform.startswith("linux"):
        return
    import multiprocessing
    from multiprocessing import forkserver

    multiprocessing.set_start_method("forkserver", force=True)
    multiprocessing.set_forkserver_preload(["deepracer_exp.training.fork_server", module])
    # Workers share the cores among themselves already; a linear-algebra thread pool in each would only compete.
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    # Signals to the process group are for the training process alone; what is ignored now stays so in the server.
    handlers = {signum: signal.signal(signum, signal.SIG_IGN) for signum in (signal.SIGINT, signal.SIGTERM)}
    forkserver.ensure_running()
    for signum, handler in handlers.items():
        signal.signal(signum, handler)
    if before is None:
        del os.environ["OMP_NUM_THREADS"]
    else:
        os.environ["OMP_NUM_THREADS"] = before


def has_workers(run_dir: Path) -> bool:
    """Return whether the cars of a run are driven in processes that this machine starts for it."""
    collector = read_config(run_dir).get("collector")
    return isinstance(collector, dict) and collector.get("mode") in ("sync", "async")
