"""Workers on a Ray cluster, and the actors that hold their cores."""

import contextlib
import multiprocessing
import os
import uuid
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from deepracer_exp.config.sweep import RayExecutor, SweepConfig
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.tracking.store import Store

from . import ray_cluster
from .launcher import run_worker
from .storage import resolve_database
from .worker_config import WorkerConfig, owner_name

_REQUESTED_BY = "sweep/executor=ray"
_LOST = -9
"""Exit code of a worker whose actor is gone."""


class RayLauncher:
    """Starts workers where the cluster has room; methods as in `LocalLauncher`.

    Each is a process below a `WorkerActor` that reserves the cores. It is the same as in a sweep on one machine: it
    takes signals, ends with its parent, and loses its trial when its lease runs out.
    """

    def __init__(self, config: SweepConfig, executor: RayExecutor, runs_dir: Path, store: Store | None):
        """Join the cluster.

        Raises:
            BadInput: Ray is missing, no cluster answers, it has room for no worker, or its nodes cannot reach the
                study or MLflow.
        """
        self._executor, self.cores = executor, executor.cpus_per_worker
        ray_cluster.connect(executor.address, _REQUESTED_BY)
        try:
            room = ray_cluster.room({"CPU": float(executor.cpus_per_worker), "GPU": executor.gpus_per_worker})
            if not room:
                raise BadInput(
                    f"sweep.executor.cpus_per_worker={executor.cpus_per_worker}, "
                    f"gpus_per_worker={executor.gpus_per_worker:g}: no node of the Ray cluster has that many"
                )
            refuse_files(config.storage, runs_dir, store, ray_cluster.node_addresses())
        except BadInput:
            ray_cluster.leave()
            raise
        self.workers = config.workers or room
        self._marks: list[Path] = []

    def folder(self, runs_dir: Path) -> Path:
        """Return its absolute path, which all nodes share."""
        return runs_dir.absolute()

    def start(self, config: WorkerConfig, token: str) -> "RayWorker":
        """Request room for a worker; it starts when there is some."""
        import ray

        if not self._marks:
            mark = config.folder / f".seen-by-all-{uuid.uuid4().hex[:8]}"
            mark.touch()
            self._marks.append(mark)
        kind = ray.remote(
            num_cpus=self._executor.cpus_per_worker,
            num_gpus=self._executor.gpus_per_worker,
            scheduling_strategy="SPREAD",
            max_restarts=0,
            # While one thread waits for the process, another can end it.
            max_concurrency=2,
        )(WorkerActor)
        actor = kind.remote()
        return RayWorker(actor, actor.begin.remote(config, token, self._marks[0], str(Path.cwd())))

    def close(self) -> None:
        """Leave the cluster."""
        for mark in self._marks:
            mark.unlink(missing_ok=True)
        ray_cluster.leave()


class RayWorker:
    """A worker on some node, as the driver sees it; attributes and methods as in `LocalWorker`."""

    def __init__(self, actor: Any, begun: Any):
        self._actor, self._begun = actor, begun
        self._ended: Any = None
        self._exitcode: int | None = None
        self.owner: str | None = None
        self.is_seen = True

    @property
    def exitcode(self) -> int | None:
        """Exit code; None while it lives or waits for room.

        Raises:
            BadInput, RunFailed: it cannot start on its node, or on any.
        """
        if self._exitcode is None:
            self._look(0.0)
        return self._exitcode

    def terminate(self) -> None:
        """Ask it to end; one that still waits for room ends at once."""
        if self.exitcode is not None:
            return
        if self._ended is None:
            self.kill()
        else:
            self._actor.signal.remote("terminate")

    def join(self, timeout_s: float) -> None:
        """Wait for its end, at most this long."""
        if self._exitcode is None:
            self._look(timeout_s)

    def kill(self) -> None:
        """End it and its actor."""
        import ray

        with contextlib.suppress(ray.exceptions.RayError):
            if self._exitcode is None and self._ended is not None:
                ray.get(self._actor.signal.remote("kill"), timeout=10.0)
        ray.kill(self._actor)
        self._exitcode = _LOST if self._exitcode is None else self._exitcode

    def _look(self, timeout_s: float) -> None:
        import ray

        try:
            if self._ended is None:
                if not ray.wait([self._begun], timeout=timeout_s)[0]:
                    return
                self.owner = ray.get(self._begun)
                self._ended = self._actor.ended.remote()
            if ray.wait([self._ended], timeout=timeout_s)[0]:
                self._exitcode = ray.get(self._ended)
                ray.kill(self._actor)
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, BadInput | RunFailed):
                raise error.cause from None
            raise RunFailed(f"a worker did not start: {type(error.cause).__name__}: {error.cause}") from error
        except ray.exceptions.RayError:
            # Its process may still run, until it finds that its lease is lost.
            self._exitcode, self.is_seen = _LOST, False


class WorkerActor:
    """Reserves cores of a node and runs a worker's process there; a Ray actor with two threads."""

    _process: BaseProcess

    def begin(self, config: WorkerConfig, token: str, mark: Path, folder: str) -> str:
        """Start the process in the sweep's working folder and return the worker's name.

        Raises:
            BadInput: this node does not see `mark`, a file that the driver has made in the folder of the runs.
        """
        import ray

        if not mark.exists():
            raise BadInput(
                f"runs_dir={config.runs_dir}: node {ray.util.get_node_ip_address()} does not see that folder; "
                "sweep/executor=ray needs one that all nodes share, at the same path"
            )
        if Path(folder).is_dir():
            os.chdir(folder)
        log = str(config.folder / f"workers-{os.uname().nodename}.log")
        # Its parent is the actor's process, which it does not outlive.
        context = multiprocessing.get_context("spawn")
        self._process = context.Process(target=run_worker, args=(config, token, log))
        self._process.start()
        assert self._process.pid is not None
        return owner_name(self._process.pid, token)

    def ended(self) -> int | None:
        """Wait for the process and return its exit code."""
        self._process.join()
        return self._process.exitcode

    def signal(self, how: str) -> None:
        """Ask the process to end (`terminate`), or end it at once (`kill`)."""
        getattr(self._process, how)()


def refuse_files(storage: str | None, runs_dir: Path, store: Store | None, nodes: Sequence[str]) -> None:
    """Refuse databases that are files if the cluster has nodes on several machines.

    Raises:
        BadInput: the study's database, or MLflow's, is a file.
    """
    if len(nodes) < 2:
        return
    where = f"a file, and the Ray cluster has nodes on {len(nodes)} machines"
    if resolve_database(storage, runs_dir).file is not None:
        raise BadInput(f"sweep.storage={storage or 'null'}", where, "postgresql+psycopg://user@host/name")
    if store is not None and store.sqlite_file is not None:
        raise BadInput(f"tracking.uri={store.shown}", where, "http://host:port, or tracking=off")
