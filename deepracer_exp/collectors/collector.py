"""Batches of driving, from cars in this process or in several."""

import contextlib
import copy
import functools
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, TypeVar

import torch
from tensordict import TensorDictBase
from torchrl.collectors import MultiSyncCollector

from deepracer_exp.config.learning import AlgorithmConfig
from deepracer_exp.config.running import CollectorConfig
from deepracer_exp.env.others.head_to_head import Rivals, Weights, weights_of
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import BadInput, RunFailed, count
from deepracer_exp.patience import wait_patiently
from deepracer_exp.runs.folder import read_crash_dump
from deepracer_exp.runs.run_files import HEARTBEAT, LOG
from deepracer_exp.sim.batch import cores

from .car_worker import CarCollector, EnvFactory, SamplingPolicy
from .watchdog import Watchdog

_DEATH_S = 30.0
"""Longest wait, after a pipe to a worker broke, until the system reports the end of its process."""
_LAST_BATCH_S = 1.0  # wait at the end for a batch under way, which is not used, before its workers are killed
_CHUNK_STEPS = 32  # control steps of each car between two counts of the episodes that have ended

_T = TypeVar("_T")


class Collector:
    """An endless source of batches; a context manager that leaves no process behind.

    Each batch is a TensorDict of batch size [cars of all processes, T], keys as in `RaceEnv` plus the policy's.

    Attributes:
        ahead_s: Seconds that the last batch had a head start, see `begin_next`.
    """

    ahead_s = 0.0

    def __init__(
        self,
        config: CollectorConfig,
        setup: RaceSetup,
        policy: torch.nn.Module,
        frames_per_batch: int,
        run_dir: Path,
        state: Mapping[str, Any] | None = None,
        rivals: Rivals | None = None,
    ):
        """Start the cars in this process or in workers, as configured.

        Args:
            config: the collector's group.
            setup: the race.
            policy: reads its keys of a `RaceEnv`, writes `action` and its log-probability.
            frames_per_batch: control steps over all cars, rounded up to whole steps of all cars.
            run_dir: where workers leave crash dumps and prints.
            state: `state_dict` of a collector of the same configuration and setup: with the same weights, the next
                batch equals that of the original collector, bit for bit. None or empty: new episodes begin.
            rivals: of the cars; None: they are alone.

        Raises:
            BadInput: the state is of other cars, or of another number of processes.
            RunFailed: a worker did not start.
        """
        if state and config.forks and config.processes is None:
            # Of a run that continues on a machine with another number of cores.
            config = replace(config, processes=len(state))
        self._policy = SamplingPolicy(policy)
        self._workers = worker_count(config)
        self._steps = steps_per_batch(config, frames_per_batch)
        self._hang_timeout_s = config.hang_timeout_s
        self._run_dir = run_dir
        self._batches = 0
        self._begun_from = state or {}
        self._next: Future[TensorDictBase] | None = None
        self._states: list[Any] = []
        states = states_of(self._begun_from, max(1, self._workers))
        self._watchdog: Watchdog | None = None
        cars = config.cars // max(1, self._workers)
        factory = functools.partial(EnvFactory, setup=setup, n_cars=cars, run_dir=run_dir, rivals=rivals)
        options: dict[str, Any] = {
            "frames_per_batch": self._steps * config.cars,
            "total_frames": -1,
            "use_buffers": True,
            "trust_policy": True,
            "auto_register_policy_transforms": False,
        }
        if self._workers == 0:
            env = factory(worker=0, threads=config.threads)
            self._collector: Any = CarCollector(env, self._policy, track_traj_ids=False, **options)
        else:
            heartbeat = run_dir / HEARTBEAT
            self._advice = f"; see {run_dir / LOG}"
            self._watchdog = Watchdog(heartbeat, self._workers, config.hang_timeout_s, self._advice)
            envs = [
                factory(worker=worker, threads=config.threads or 1, heartbeat=heartbeat)
                for worker in range(self._workers)
            ]
            self._collector = self._start(envs, options)
            self._watchdog.workers_started(self._collector.procs)
        self._source = iter(self._collector)
        if states:
            with contextlib.ExitStack() as undo:
                undo.callback(self.close)
                self._restore_cars(states)
                undo.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None and self._watchdog is not None:
            # TorchRL asks its workers to end and waits up to 10 s for those that are driving.
            self._watchdog.close()
            self._end_all()
        self.close()

    def collect(self, algorithm: AlgorithmConfig) -> tuple[TensorDictBase, float]:
        """Return the batch of one update, as large as the algorithm says, and the seconds it took to collect.

        Raises:
            RunFailed: a worker is lost.
        """
        chunks: list[TensorDictBase] = []
        frames = episodes = 0
        spent_s = 0.0
        while True:
            began = time.monotonic()
            chunk = self.next_batch()
            spent_s += time.monotonic() - began + self.ahead_s
            frames += chunk.numel()
            episodes += int(chunk["next", "done"].sum())
            wanted = algorithm.episodes_per_iteration
            enough = frames >= (algorithm.frames_per_iteration or 0) if wanted is None else episodes >= wanted
            if not enough:
                chunks.append(chunk.clone())
                continue
            whole = torch.cat([*chunks, chunk], dim=1) if chunks else chunk
            return whole, spent_s

    def begin_next(self) -> None:
        """Let the workers begin the next batch with the policy published last, while the caller does other work.

        Until `next_batch`, only `close` and `state_dict`, which is that before this batch, may be called. Cars in this
        process wait for `next_batch`.
        """
        if self._watchdog is not None:
            self._states = self._worker_states()
            self._begun_at_s = time.monotonic()
            self._next = _in_background(self._receive)

    def publish_policy(self) -> None:
        """Drive the next batches with the policy's present weights; raises as `next_batch`."""
        if self._watchdog is None:
            self._collector.update_policy_weights_()
            return
        weights = weights_of(self._policy)
        self._ask(
            lambda: self._collector.map_fn("put_weights", [(weights,)] * self._workers),
            "took no new weights",
        )

    def publish_rivals(self, weights: Sequence[Weights]) -> None:
        """Let policies with these weights drive the rivals from the next batch on; raises as `next_batch`."""
        if self._watchdog is None:
            self._collector.env.put_rivals(weights)
            return
        self._ask(
            lambda: self._collector.map_fn("env.put_rivals", [(weights,)] * self._workers),
            "took no new rivals",
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the state that decides the next batch, except the policy: arrays and plain values.

        It is the state at the end of the last batch; call it before the next. Raises as `next_batch`.
        """
        if not self._batches:
            return dict(self._begun_from)
        if self._watchdog is None:
            return by_worker([self._collector.env.take_state()])
        return by_worker(self._worker_states() if self._next is None else self._states)

    def close(self) -> None:
        """End every worker."""
        if self._watchdog is not None:
            self._watchdog.close()
        if self._next is not None and wait([self._next], _LAST_BATCH_S).not_done:
            self._end_all()
            wait([self._next])
        if not self._collector.closed:
            threads = torch.get_num_threads()
            self._collector.shutdown()
            # TorchRL changes this process's number of threads, with which the last digits of sums change.
            torch.set_num_threads(threads)

    def _start(self, envs: list[EnvFactory], options: dict[str, Any]) -> Any:
        others = len(multiprocessing.active_children())
        with contextlib.ExitStack() as undo:
            undo.callback(self._give_up_starting)
            try:
                collector = MultiSyncCollector(
                    envs,
                    # A copy for each worker: TorchRL's ways to pass on weights keep queues that outlive a lost worker.
                    policy_factory=functools.partial(copy.deepcopy, self._policy),
                    weight_sync_schemes={},
                    num_threads=torch.get_num_threads(),
                    cat_results="stack",
                    collector_class=CarCollector,
                    **options,
                )
            except (RuntimeError, ValueError, OSError) as error:
                verdicts = self._watchdog.verdict.items() if self._watchdog is not None else ()
                hung = next((f"worker {worker} {verdict}" for worker, verdict in verdicts), None)
                reason = hung or str(error).partition("\n")[0]
                if not hung and isinstance(error, BrokenPipeError):
                    reason = f"worker {len(multiprocessing.active_children()) - others} died before it began"
                raise RunFailed(f"collector workers did not start: {reason}") from error
            undo.pop_all()
        return collector

    def _give_up_starting(self) -> None:
        assert self._watchdog is not None
        self._watchdog.close()
        for process in multiprocessing.active_children():
            process.kill()
            process.join()

    def _restore_cars(self, states: Sequence[Any]) -> None:
        """Restore each worker's cars from its state."""
        if self._watchdog is None:
            self._collector.env.put_state(states[0])
            self._collector.reset()
            return

        def put() -> None:
            self._collector.map_fn("env.put_state", [(state,) for state in states])
            self._collector.map_fn("reset")

        self._ask(put, "did not restore its cars")

    def _worker_states(self) -> list[Any]:
        """Return the state of each worker's cars after its last batch."""
        return self._ask(
            lambda: self._collector.map_fn("env.take_state"), "did not report the state of its cars"
        )

    def _ask(self, question: Callable[[], _T], silence: str) -> _T:
        """Return the workers' answer, or raise the error `silence` about a worker that does not answer in time.

        TorchRL alone would wait for it forever.
        """
        assert self._watchdog is not None
        answer = _in_background(question)

        def arrives(seconds: float) -> bool:
            return bool(wait([answer], seconds).done) or self._loss_now() is not None

        silent = wait_patiently(arrives, self._hang_timeout_s, self._watchdog.use)
        if answer.done():
            try:
                return answer.result()
            except (RuntimeError, ValueError, OSError, EOFError):  # what TorchRL and a broken pipe raise
                loss = self._loss(_DEATH_S)
                if loss is None:
                    raise
        else:
            loss = self._loss_now()
        # Answers are read in the order of the workers: those behind the silent one have theirs in the pipe.
        worker = max((n for n, pipe in enumerate(self._collector.pipes) if not pipe.poll()), default=0)
        self._end_all()
        raise loss or RunFailed(
            f"collector worker {worker} {silence} for {silent} and was ended; the limit: "
            f"collector.hang_timeout_s={self._hang_timeout_s:g}{self._advice}"
        )

    def next_batch(self) -> TensorDictBase:
        """Return the next batch; it is valid until the one after it.

        Raises:
            RunFailed: a worker is lost.
        """
        self._batches += 1
        if self._watchdog is None:
            return next(self._source)
        asked_s, begun, self._next = time.monotonic(), self._next, None
        if begun is None:
            self.ahead_s = 0.0
            return self._receive()
        batch = begun.result()
        self.ahead_s = min(asked_s, self._driven_at_s) - self._begun_at_s
        return batch

    def _receive(self) -> TensorDictBase:
        """Let the workers drive a batch and return it."""
        assert self._watchdog is not None
        self._watchdog.expect(self._steps)
        try:
            batch: TensorDictBase = next(self._source)
        except (RuntimeError, ValueError, OSError, EOFError) as error:  # what TorchRL and a broken pipe raise
            loss = self._loss(_DEATH_S)
            if loss is None:
                raise
            self._end_all()
            raise loss from error
        finally:
            self._watchdog.rest()
        self._driven_at_s = time.monotonic()
        return batch.flatten(0, 1)

    def _loss(self, patience_s: float) -> RunFailed | None:
        """Return the error about the first lost worker, None if all are still alive after `patience_s`."""
        give_up_at = time.monotonic() + patience_s
        while (loss := self._loss_now()) is None and time.monotonic() < give_up_at:
            time.sleep(0.05)
        return loss

    def _loss_now(self) -> RunFailed | None:
        assert self._watchdog is not None
        for worker in range(len(self._collector.procs)):
            fault = read_crash_dump(self._run_dir, worker)
            if fault is not None:
                return RunFailed(fault)
            if worker in self._watchdog.verdict:
                return RunFailed(f"collector worker {worker} {self._watchdog.verdict[worker]}")
        dead = self._watchdog.first_dead
        if dead is None:
            return None
        process = self._collector.procs[dead]
        process.join()
        code = process.exitcode
        how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        return RunFailed(f"collector worker {dead} (process {process.pid}) died {how}")

    def _end_all(self) -> None:
        for process in self._collector.procs:
            with contextlib.suppress(ValueError):  # a handle TorchRL has closed: that worker is gone
                process.kill()
                process.join()


def _in_background(question: Callable[[], _T]) -> Future[_T]:
    """Ask on a daemon thread and return a future of the answer."""
    answer: Future[_T] = Future()

    def ask() -> None:
        try:
            answer.set_result(question())
        except BaseException as error:  # noqa: BLE001 - raised again by the waiting thread
            answer.set_exception(error)

    threading.Thread(target=ask, name="ask the workers", daemon=True).start()
    return answer


def frames_per_batch(config: CollectorConfig, algorithm: AlgorithmConfig) -> int:
    """Return the control steps of a batch, over all cars."""
    frames = algorithm.frames_per_iteration
    return config.cars * _CHUNK_STEPS if frames is None else frames


def worker_count(config: CollectorConfig) -> int:
    """Return the number of worker processes, 0 for collection in this process."""
    if config.mode == "in_process":
        return 0
    return config.processes or max(n for n in config.accepted_processes if n <= cores())


def steps_per_batch(config: CollectorConfig, frames: int) -> int:
    """Return the steps of each car in a batch of this many frames over all cars, rounded up."""
    return -(-frames // config.cars)


def by_worker(states: Iterable[Any]) -> dict[str, Any]:
    """Return the states of workers as a collector's `state_dict`, whose keys are names."""
    return {f"worker-{worker}": state for worker, state in enumerate(states)}


def states_of(state: Mapping[str, Any], workers: int) -> list[Any]:
    """Return the workers' states in a collector's `state_dict`; an empty one has none.

    Raises:
        BadInput: it is that of other workers.
    """
    names = by_worker(range(workers))
    if state and state.keys() != names.keys():
        raise BadInput(
            "the checkpoint does not fit",
            f"it has the cars of {count(len(state), 'worker')}; accepted by this collector: {len(names)}",
        )
    return [state[name] for name in names if state]
