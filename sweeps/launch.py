"""Workers of a sweep as whoever starts them sees them, and those on this machine."""

import multiprocessing
import os
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Protocol

from . import process
from .plan import Plan


class Launched(Protocol):
    """A worker that was started, or waits for its place."""

    @property
    def owner(self) -> str | None:
        """Its name in the ledger; None before it has begun."""

    @property
    def exitcode(self) -> int | None:
        """How it ended; None while it lives."""

    @property
    def is_seen(self) -> bool:
        """Whether it is certain that a worker which ended is gone: of a lost machine it is not."""

    def terminate(self) -> None:
        """Tell it to end, with a checkpoint of its trial."""

    def join(self, timeout_s: float) -> None:
        """Wait for its end, so long at most."""

    def kill(self) -> None:
        """End it, whatever it does."""


class Launcher(Protocol):
    """Starts workers somewhere."""

    workers: int
    """How many there shall be at a time."""
    cores: int
    """Of each worker."""

    def folder(self, runs_dir: Path) -> Path:
        """Return the folder of runs as the workers know it."""

    def start(self, plan: Plan, token: str) -> Launched:
        """Start a worker.

        Args:
            plan: of the sweep.
            token: of the worker's name.

        Raises:
            BadInput, RunFailed: no worker will ever begin here.
        """

    def close(self) -> None:
        """Leave nothing behind."""


class LocalLauncher:
    """Starts processes on this machine."""

    def __init__(self, workers: int | None):
        """Start nothing yet.

        Args:
            workers: null: one a core.
        """
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.workers = workers or cores
        self.cores = max(1, cores // self.workers)
        # From a server that has imported what workers need, once; see `start_workers_early`.
        forks = sys.platform.startswith("linux")
        self._context = (
            multiprocessing.get_context("forkserver") if forks else multiprocessing.get_context("spawn")
        )

    def folder(self, runs_dir: Path) -> Path:
        """Return it as it is: their working folder is that of the sweep."""
        return runs_dir

    def start(self, plan: Plan, token: str) -> "LocalWorker":
        """Start a process."""
        started = self._context.Process(
            target=process.main, args=(plan, token, str(plan.folder / "workers.log"))
        )
        started.start()
        return LocalWorker(started, token)

    def close(self) -> None:
        """Do nothing: its processes are all joined."""


class LocalWorker:
    """A process on this machine."""

    is_seen = True

    def __init__(self, started: BaseProcess, token: str):
        assert started.pid is not None
        self._process, self.owner = started, process.owner_name(started.pid, token)

    @property
    def exitcode(self) -> int | None:
        """How it ended; None while it lives."""
        return self._process.exitcode

    def terminate(self) -> None:
        """Tell it to end."""
        self._process.terminate()

    def join(self, timeout_s: float) -> None:
        """Wait for its end."""
        self._process.join(timeout_s)

    def kill(self) -> None:
        """End it."""
        self._process.kill()
        self._process.join()
