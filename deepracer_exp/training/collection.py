"""Batches of driving, from cars in this process or in several."""

import contextlib
import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector

from deepracer_exp.config.running import CollectorConfig
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import RunFailed

from .faults import read_fault
from .watchdog import Watchdog
from .worker import EnvFactory

logger = logging.getLogger(__name__)


def cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_count(config: CollectorConfig) -> int:
    """Return the number of worker processes, 0 for collection in this process."""
    return 0 if config.mode == "in_process" else config.processes or cores()


class Collection:
    """An endless source of batches; a context manager that leaves no process behind.

    Each batch is a TensorDict of batch size [cars of all processes, T], for asynchronous collection
    [cars of one process, T], keys as in `RaceEnv` plus the policy's.
    """

    def __init__(
        self,
        config: CollectorConfig,
        setup: RaceSetup,
        policy: torch.nn.Module,
        frames_per_batch: int,
        run_dir: Path,
    ):
        """Start the cars.

        Args:
            config: the collector's group.
            setup: what the cars need.
            policy: reads `observation`, writes `action` and its log-probability.
            frames_per_batch: control steps per batch over all cars; rounded up to whole steps of all cars.
            run_dir: where workers leave faults and prints.

        Raises:
            RunFailed: a worker did not start.
        """
        workers = worker_count(config)
        self._watchdog: Watchdog | None = None
        self._stack_axis_is_process = config.mode == "sync"
        shared: dict[str, Any] = {"total_frames": -1, "use_buffers": True, "trust_policy": True}
        if workers == 0:
            factory = self._factory(setup, config, 0, config.threads, run_dir, None)
            self._steps_per_batch = -(-frames_per_batch // config.cars)
            self._collector: Any = Collector(
                factory,
                policy,
                frames_per_batch=self._steps_per_batch * config.cars,
                track_traj_ids=False,
                **shared,
            )
        else:
            parts = workers if config.mode == "sync" else 1
            self._steps_per_batch = -(-frames_per_batch // (parts * config.cars))
            heartbeat = run_dir / ".heartbeat"
            self._watchdog = Watchdog(
                heartbeat, workers, config.hang_timeout_s, lockstep=config.mode == "sync"
            )
            threads = config.threads or 1
            factories = [
                self._factory(setup, config, worker, threads, run_dir, heartbeat) for worker in range(workers)
            ]
            kind = MultiSyncCollector if config.mode == "sync" else MultiAsyncCollector
            threads_before = torch.get_num_threads()
            try:
                self._collector = kind(
                    factories,
                    policy,
                    frames_per_batch=self._steps_per_batch * parts * config.cars,
                    num_threads=threads_before,
                    **({"cat_results": "stack"} if config.mode == "sync" else {}),
                    **shared,
                )
            except (RuntimeError, OSError) as error:
                self._watchdog.close()
                raise RunFailed(f"collector workers did not start: {str(error).splitlines()[0]}") from error
            self._watchdog.workers_started([process.pid for process in self._collector.procs])
        self._run_dir = run_dir
        self._batches = 0
        self._source = iter(self._collector)

    def __enter__(self) -> "Collection":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __iter__(self) -> Iterator[TensorDictBase]:
        while True:
            yield self._next()

    def publish_policy(self) -> None:
        """Give the workers the policy's weights as they are now."""
        self._collector.update_policy_weights_()

    def close(self) -> None:
        """End every worker."""
        if self._watchdog is not None:
            self._watchdog.close()
        if not self._collector.closed:
            self._collector.shutdown()

    def _next(self) -> TensorDictBase:
        self._batches += 1
        if self._watchdog is None:
            return next(self._source)
        self._watchdog.expect(self._batches * self._steps_per_batch)
        try:
            batch = next(self._source)
        except RuntimeError as error:
            loss = self._loss()
            if loss is None:
                raise
            self._end_all()
            raise loss from error
        finally:
            self._watchdog.rest()
        return batch.flatten(0, 1) if self._stack_axis_is_process else batch

    def _loss(self) -> RunFailed | None:
        """Return what became of the first lost worker, None if all are there."""
        assert self._watchdog is not None
        for worker in range(len(self._collector.procs)):
            fault = read_fault(self._run_dir, worker)
            if fault is not None:
                return RunFailed(fault)
            if worker in self._watchdog.verdict:
                return RunFailed(f"collector worker {worker} {self._watchdog.verdict[worker]}")
        for worker, process in enumerate(self._collector.procs):
            # TorchRL closes the handles of the workers that still lived.
            if process._closed or process.is_alive():
                continue
            code = process.exitcode
            how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
            return RunFailed(f"collector worker {worker} (process {process.pid}) died {how}")
        return None

    def _end_all(self) -> None:
        for process in self._collector.procs:
            with contextlib.suppress(ValueError):  # a handle TorchRL has closed: that worker is gone
                process.kill()
                process.join()

    @staticmethod
    def _factory(
        setup: RaceSetup,
        config: CollectorConfig,
        worker: int,
        threads: int,
        run_dir: Path,
        heartbeat: Path | None,
    ) -> EnvFactory:
        return EnvFactory(
            setup=setup,
            worker=worker,
            n_cars=config.cars,
            threads=threads,
            run_dir=run_dir,
            heartbeat=heartbeat,
        )
