"""Batches of driving, from cars in this process or in several."""

import contextlib
import functools
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase
from torchrl.collectors import MultiSyncCollector
from torchrl.weight_update import SharedMemWeightSyncScheme

from deepracer_exp.config.learning import AlgorithmConfig
from deepracer_exp.config.running import CollectorConfig
from deepracer_exp.env.head_to_head import Rivals, Weights
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import RunFailed
from deepracer_exp.patience import wait_patiently
from deepracer_exp.runs.crash_dump import read_crash_dump
from deepracer_exp.runs.files import HEARTBEAT, LOG

from .base import Collector, by_worker, cars_per_process, states_of, steps_per_batch, worker_count
from .sampling import SamplingPolicy
from .watchdog import Watchdog
from .worker import CarCollector, EnvFactory

_DEATH_S = 30.0
"""Longest wait, after a pipe to a worker broke, until the system reports the end of its process."""
_LAST_BATCH_S = 1.0  # wait at the end for a batch under way, which is not used, before its workers are killed
_CHUNK_STEPS = 32  # control steps of each car between two counts of the episodes that have ended

_T = TypeVar("_T")


class LocalCollector(Collector):
    """Collects in this process, or in several of this machine."""

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
        """Start the cars; arguments and errors as for `open_collector`.

        `frames_per_batch` is in control steps over all cars, and is rounded up to whole steps of all cars.
        """
        policy = SamplingPolicy(policy)
        self._workers = worker_count(config)
        self._hang_timeout_s = config.hang_timeout_s
        self._run_dir = run_dir
        self._batches = 0
        self._begun_from = state or {}
        self._next: Future[TensorDictBase] | None = None
        self._states: list[Any] = []
        states = states_of(self._begun_from, max(1, self._workers))
        self._watchdog: Watchdog | None = None
        cars = cars_per_process(config)
        factory = functools.partial(EnvFactory, setup=setup, n_cars=cars, run_dir=run_dir, rivals=rivals)
        options: dict[str, Any] = {
            "frames_per_batch": steps_per_batch(config, frames_per_batch) * config.cars,
            "total_frames": -1,
            "use_buffers": True,
            "trust_policy": True,
        }
        if self._workers == 0:
            env = factory(worker=0, threads=config.threads)
            self._collector: Any = CarCollector(
                env, policy, track_traj_ids=False, auto_register_policy_transforms=False, **options
            )
        else:
            heartbeat = run_dir / HEARTBEAT
            self._advice = f"; see {run_dir / LOG}"
            self._watchdog = Watchdog(heartbeat, self._workers, config.hang_timeout_s, self._advice)
            envs = [
                factory(worker=worker, threads=config.threads or 1, heartbeat=heartbeat)
                for worker in range(self._workers)
            ]
            self._collector = self._start(envs, policy, options)
            self._watchdog.workers_started(self._collector.procs)
            _watch_deliveries(self._collector.queue_out, self._watchdog)
        self._source = iter(self._collector)
        if states:
            with contextlib.ExitStack() as undo:
                undo.callback(self.close)
                self._restore_cars(states)
                undo.pop_all()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None and self._watchdog is not None:
            # TorchRL asks its workers to end and waits up to 10 s for those that are driving.
            self._watchdog.close()
            self._end_all()
        self.close()

    def begin_next(self) -> None:
        """Let the workers begin the next batch; cars of this process wait until it is asked for."""
        if self._watchdog is not None:
            self._states = self._worker_states()
            self._begun_at_s = time.monotonic()
            self._next = _in_background(self._receive)

    def publish_policy(self) -> None:
        """Pass the policy's weights to the workers."""
        if self._watchdog is None:
            self._collector.update_policy_weights_()
            return
        self._ask(self._publish, lambda: f"collector worker {self._receiver} took no new weights")

    def publish_rivals(self, weights: Sequence[Weights]) -> None:
        """Pass the rivals' weights to the workers."""
        if self._watchdog is None:
            self._collector.env.put_rivals(weights)
            return
        self._ask(
            lambda: self._collector.map_fn("env.put_rivals", [(weights,)] * self._workers),
            lambda: "a collector worker took no new rivals",
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the cars after the last batch."""
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
        if self._workers:
            self._close_weights()

    def _start(self, envs: list[EnvFactory], policy: torch.nn.Module, options: dict[str, Any]) -> Any:
        others = len(multiprocessing.active_children())
        # The scheme that TorchRL would use itself; ours can be closed even if no collector is returned.
        self._weights = SharedMemWeightSyncScheme()
        options = options | {
            "weight_sync_schemes": {"policy": self._weights},
            "collector_class": CarCollector,
        }
        with contextlib.ExitStack() as undo:
            undo.callback(self._give_up_starting)
            try:
                collector = MultiSyncCollector(
                    envs, policy, num_threads=torch.get_num_threads(), cat_results="stack", **options
                )
            except (RuntimeError, ValueError, OSError) as error:
                verdicts = self._watchdog.verdict.items() if self._watchdog is not None else ()
                hung = next((f"worker {worker} {verdict}" for worker, verdict in verdicts), None)
                reason = hung or str(error).split(". ")[0].splitlines()[0]
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
        self._close_weights()

    def _close_weights(self) -> None:
        """Close the queues through which workers receive new weights.

        TorchRL does it when its collector is garbage-collected. After a failure that is when the interpreter exits,
        which would then hang: on a queue that is never emptied, or on a thread that can no longer start.
        """
        for name in ("_weight_init_queues", "_instruction_queues", "_ack_queues"):
            for queue in getattr(self._weights, name).values():
                queue.cancel_join_thread()
        self._weights.shutdown()

    def _restore_cars(self, states: Sequence[Any]) -> None:
        """Restore each worker's cars from its state."""
        if self._watchdog is None:
            self._collector.env.put_state(states[0])
            self._collector.reset()
            return

        def put() -> None:
            self._collector.map_fn("env.put_state", [(state,) for state in states])
            self._collector.map_fn("reset")

        self._ask(put, lambda: "a collector worker did not restore its cars")

    def _worker_states(self) -> list[Any]:
        """Return the state of each worker's cars after its last batch."""
        return self._ask(
            lambda: self._collector.map_fn("env.take_state"),
            lambda: "a collector worker did not report the state of its cars",
        )

    def _ask(self, question: Callable[[], _T], silence: Callable[[], str]) -> _T:
        """Return the workers' answer; TorchRL alone would wait for it forever, even if the worker is dead."""
        assert self._watchdog is not None
        answer = _in_background(question)

        def arrives(seconds: float) -> bool:
            return bool(wait([answer], seconds).done) or self._loss_now() is not None

        silent = wait_patiently(arrives, self._hang_timeout_s, self._watchdog.use)
        if answer.done():
            try:
                return answer.result()
            except (RuntimeError, OSError, EOFError):  # what TorchRL and a broken pipe raise
                loss = self._loss(_DEATH_S)
                if loss is None:
                    raise
        else:
            loss = self._loss_now()
        self._end_all()
        raise loss or RunFailed(
            f"{silence()} for {silent} and was ended; the limit: collector.hang_timeout_s="
            f"{self._hang_timeout_s:g}{self._advice}"
        )

    def _publish(self) -> None:
        for worker in range(self._workers):
            self._receiver = worker
            self._collector.update_policy_weights_(worker_ids=worker)

    def next_batch(self) -> TensorDictBase:
        """Return the next batch."""
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
        self._watchdog.expect()
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
    """Ask on a thread of its own, which does not keep the process from ending, and return what will be the answer."""
    answer: Future[_T] = Future()

    def ask() -> None:
        try:
            answer.set_result(question())
        except BaseException as error:  # noqa: BLE001 - raised again by the thread that waits
            answer.set_exception(error)

    threading.Thread(target=ask, name="ask the workers", daemon=True).start()
    return answer


def _watch_deliveries(queue: Any, watchdog: Watchdog) -> None:
    """Report to the watchdog each worker's part that leaves the queue of TorchRL's synchronous collector."""
    get = queue.get

    def get_and_note(*args: Any, **options: Any) -> Any:
        message = get(*args, **options)
        # The worker's number; the first time, its buffer and its number.
        part, _ = message
        watchdog.delivered(part if isinstance(part, int) else part[1])
        return message

    queue.get = get_and_note


def open_collector(
    config: CollectorConfig,
    algorithm: AlgorithmConfig,
    setup: RaceSetup,
    policy: torch.nn.Module,
    run_dir: Path,
    state: Mapping[str, Any] | None = None,
    rivals: Rivals | None = None,
) -> Collector:
    """Start the cars where the configuration wants them.

    Args:
        config: the collector's group.
        algorithm: says how many frames or episodes an iteration has.
        setup: what the cars need.
        policy: reads what its network sees of a `RaceEnv`, writes `action` and its log-probability.
        run_dir: where workers leave crash dumps and prints.
        state: `state_dict` of a collector of the same configuration and setup: with the same weights, the next batch
            is what that one would have returned next, bit for bit. None or empty: new episodes begin.
        rivals: what the cars race against; None: they are alone.

    Raises:
        BadInput: the state is of other cars, or of another number of processes.
        RunFailed: a worker did not start.
    """
    frames = frames_per_batch(config, algorithm)
    return LocalCollector(config, setup, policy, frames, run_dir, state, rivals)


def frames_per_batch(config: CollectorConfig, algorithm: AlgorithmConfig) -> int:
    """Return the control steps, over all cars, to ask of a collector at a time."""
    frames = algorithm.frames_per_iteration
    return config.cars * _CHUNK_STEPS if frames is None else frames
