"""Worker processes: their program, and how the driver starts and ends them on this machine."""

import logging
import multiprocessing
import os
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path

from deepracer_exp.addresses import take_over
from deepracer_exp.config.acting import take_over_named
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.lifeline import end_with_owner
from deepracer_exp.sim.batch import cores
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.training.signals import Interruption

from .worker_config import WorkerConfig, owner_name

_log = logging.getLogger("deepracer_exp")


class LocalLauncher:
    """Starts workers as processes of this machine, one per core by default."""

    def __init__(self, workers: int | None):
        self.workers = workers or cores()
        self.cores = max(1, cores() // self.workers)
        """Per worker."""
        # A fork server has imported the workers' modules once; see `start_workers_early`.
        forks = sys.platform.startswith("linux")
        self._context = (
            multiprocessing.get_context("forkserver") if forks else multiprocessing.get_context("spawn")
        )

    def folder(self, runs_dir: Path) -> Path:
        """Return the folder of runs as the workers see it: they have the working folder of the sweep."""
        return runs_dir

    def start(self, config: WorkerConfig, token: str) -> "LocalWorker":
        """Start a worker; `token` makes its name unique."""
        log = str(config.folder / "workers.log")
        started = self._context.Process(target=run_worker, args=(config, token, log))
        started.start()
        return LocalWorker(started, token)

    def close(self) -> None:
        """Do nothing: its processes are joined."""


class LocalWorker:
    """A worker process as the driver sees it."""

    is_seen = True
    """Whether a worker that ended is certainly gone; on a lost machine it may still run."""

    def __init__(self, started: BaseProcess, token: str):
        assert started.pid is not None
        self._process = started
        self.owner: str | None = owner_name(started.pid, token)
        """Name of the worker in the trial claims; None while it waits for room on a cluster."""

    @property
    def exitcode(self) -> int | None:
        """Exit code; None while it lives."""
        return self._process.exitcode

    def terminate(self) -> None:
        """Ask it to end, with a checkpoint of its trial."""
        self._process.terminate()

    def join(self, timeout_s: float) -> None:
        """Wait for its end, at most this long."""
        self._process.join(timeout_s)

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.join()


def run_worker(config: WorkerConfig, token: str, log: str) -> None:
    """Run a worker; the target of its process, whose output goes to the file `log`.

    Exits with 0 when the study has all its trials, 130 or 143 when asked to end, 2 if the database cannot be used, 3
    if it does not answer.
    """
    take_over(config.addresses)
    take_over_named(config.named)
    # A session of its own: Ctrl-C in the terminal goes to the driver, which asks its workers to end.
    os.setsid()
    with open(log, "a", buffering=1, encoding="utf-8") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    logging.basicConfig(format="%(asctime)s %(process)d %(message)s", level=logging.WARNING)
    end_with_owner()
    # Cars with processes of their own have another server, which is to end with this process.
    multiprocessing.set_forkserver_preload(["deepracer_exp.collectors.fork_server"])
    with Interruption() as interruption:
        import optuna
        import torch

        from .storage import open_storage
        from .worker import Worker

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        torch.set_num_threads(1)
        try:
            storage = open_storage(config.config.storage, config.runs_dir, config.config.patience_s)
            with Projector() as projector:
                Worker(config, storage, owner_name(os.getpid(), token), projector).work(interruption)
        except (BadInput, RunFailed) as error:
            _log.error("%s", error)
            sys.exit(error.exit_code)
        except KeyboardInterrupt:  # the second one
            sys.exit(interruption.exit_code or 130)
    sys.exit(interruption.exit_code or 0)
