"""Workers of a sweep on a Ray cluster, as its driver sees them."""

import contextlib
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from deepracer_exp.config.sweep import RayExecutor, SweepConfig
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.tracking.store import Store
from deepracer_exp.training import ray_cluster

from .database import resolve_database
from .plan import Plan
from .ray_place import Place

_ASKED_BY = "sweep/executor=ray"
_LOST = -9
"""Exit code of a worker whose place is gone."""


class RayLauncher:
    """Starts workers where the cluster has room.

    Each is a process below an actor, `Place`, that takes the cores. The process is that of a sweep on one machine,
    so that it takes signals, ends with whatever started it, and its trial is anybody's once its lease is over.
    """

    def __init__(self, config: SweepConfig, executor: RayExecutor, runs_dir: Path, store: Store | None):
        """Join the cluster.

        Args:
            config: of the sweep.
            executor: of it.
            runs_dir: where its runs are.
            store: where they are recorded.

        Raises:
            BadInput: Ray is missing, no cluster answers, it has room for no worker, or nodes that cannot reach the
                study or MLflow.
        """
        self._executor, self.cores = executor, executor.cpus_per_worker
        ray_cluster.connect(executor.address, _ASKED_BY)
        needs = {"CPU": float(executor.cpus_per_worker), "GPU": executor.gpus_per_worker}
        places = ray_cluster.room(needs)
        if not places:
            ray_cluster.leave()
            raise BadInput(
                f"sweep.executor.cpus_per_worker={executor.cpus_per_worker}, "
                f"gpus_per_worker={executor.gpus_per_worker:g}: no node of the Ray cluster has as many"
            )
        try:
            refuse_files(config.storage, runs_dir, store, ray_cluster.node_addresses())
        except BadInput:
            ray_cluster.leave()
            raise
        self.workers = config.workers or places
        self._marks: list[Path] = []

    def folder(self, runs_dir: Path) -> Path:
        """Return it as all nodes know it."""
        return runs_dir.absolute()

    def start(self, plan: Plan, token: str) -> "RayWorker":
        """Ask for a place for a worker; it begins when there is one."""
        import ray

        mark = plan.folder / f".seen-by-all-{uuid.uuid4().hex[:8]}"
        if not self._marks:
            mark.touch()
            self._marks.append(mark)
        kind = ray.remote(
            num_cpus=self._executor.cpus_per_worker,
            num_gpus=self._executor.gpus_per_worker,
            scheduling_strategy="SPREAD",
            max_restarts=0,
            # While one thread waits for the process, another one hears that it is to end.
            max_concurrency=2,
        )(Place)
        place = kind.remote()
        return RayWorker(place, place.begin.remote(plan, token, self._marks[0], str(Path.cwd())))

    def close(self) -> None:
        """Take leave of the cluster."""
        for mark in self._marks:
            mark.unlink(missing_ok=True)
        ray_cluster.leave()


class RayWorker:
    """A worker on some node."""

    def __init__(self, place: Any, begun: Any):
        self._place, self._begun = place, begun
        self._ended: Any = None
        self._exitcode: int | None = None
        self.owner: str | None = None
        self.is_seen = True

    @property
    def exitcode(self) -> int | None:
        """How it ended; None while it lives or waits for its place.

        Raises:
            BadInput, RunFailed: it cannot begin, on this node or on any.
        """
        if self._exitcode is None:
            self._look(0.0)
        return self._exitcode

    def terminate(self) -> None:
        """Tell it to end; one that has no place yet ends at once."""
        if self.exitcode is not None:
            return
        if self._ended is None:
            self.kill()
        else:
            self._place.terminate.remote()

    def join(self, timeout_s: float) -> None:
        """Wait for its end."""
        if self._exitcode is None:
            self._look(timeout_s)

    def kill(self) -> None:
        """End it, with its place."""
        import ray

        with contextlib.suppress(ray.exceptions.RayError):
            if self._exitcode is None and self._ended is not None:
                ray.get(self._place.kill.remote(), timeout=10.0)
        ray.kill(self._place)
        self._exitcode = _LOST if self._exitcode is None else self._exitcode

    def _look(self, timeout_s: float) -> None:
        import ray

        try:
            if self._ended is None:
                if not ray.wait([self._begun], timeout=timeout_s)[0]:
                    return
                self.owner = ray.get(self._begun)
                self._ended = self._place.ended.remote()
            if ray.wait([self._ended], timeout=timeout_s)[0]:
                self._exitcode = ray.get(self._ended)
                ray.kill(self._place)
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, BadInput | RunFailed):
                raise error.cause from None
            raise RunFailed(f"a worker did not begin: {type(error.cause).__name__}: {error.cause}") from error
        except ray.exceptions.RayError:
            # Its process may live on where nobody sees it, until it finds its lease gone.
            self._exitcode, self.is_seen = _LOST, False


def refuse_files(storage: str | None, runs_dir: Path, store: Store | None, nodes: Sequence[str]) -> None:
    """Refuse databases that are files when the cluster has nodes on several machines.

    Args:
        storage: of the configuration.
        runs_dir: where runs are.
        store: where they are recorded.
        nodes: addresses of the machines.

    Raises:
        BadInput: the study's database, or MLflow's, is a file.
    """
    if len(nodes) < 2:
        return
    where = f"a file, and the Ray cluster has nodes on {len(nodes)} machines"
    if resolve_database(storage, runs_dir).file is not None:
        raise BadInput(
            f"sweep.storage={storage or 'null'}: {where}; accepted: postgresql+psycopg://user@host/name, "
            "mysql+pymysql://user@host/name"
        )
    if store is not None and store.sqlite_file is not None:
        raise BadInput(f"tracking.uri={store.shown}: {where}; accepted: http://host:port, or tracking=off")
