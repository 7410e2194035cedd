"""Batches of driving from cars on a Ray cluster, and what runs in its processes."""

import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from deepracer_exp.config.running import CollectorConfig
from deepracer_exp.env.head_to_head import Rivals, Weights
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import RunFailed
from deepracer_exp.rewards.prints import RewardPrints
from deepracer_exp.runs.crash_dump import write_crash_dump
from deepracer_exp.runs.files import REWARD_PRINTS

from . import ray_cluster
from .base import Collector, by_worker, cars_per_process, states_of, steps_per_batch
from .sampling import SamplingPolicy
from .worker import CarCollector, EnvFactory

_LOOK_EVERY_S = 0.2
_REPORT_EVERY_S = 0.5
_START_TIMEOUT_S = 120.0

_log = logging.getLogger("deepracer_exp")

Key = str | tuple[str, ...]


class Beats:
    """Counts the control steps that each worker has done; an actor of its own, because the others are driving."""

    def __init__(self) -> None:
        self._steps: dict[int, int] = {}

    def report(self, worker: int, steps: int) -> None:
        """Record a worker's heartbeat."""
        self._steps[worker] = steps

    def steps(self) -> dict[int, int]:
        """Return the control steps of the workers that have reported any."""
        return self._steps


class KeptPrints(RewardPrints):
    """Prints of reward functions that are kept until they are asked for: the run's folder may be out of reach."""

    def __init__(self) -> None:
        super().__init__(Path(os.devnull))
        self._lines: list[str] = []

    def take(self) -> str:
        """Return what was printed since the last time."""
        text = "".join(self._lines)
        self._lines.clear()
        return text

    def write(self, text: str) -> None:
        """Keep lines."""
        self._lines.append(text)


class Cars:
    """The cars of one process; a Ray actor whose methods run in its main thread.

    Only there can a hanging reward function be stopped (`rewards.guard`); so the steps are reported to `Beats`, and
    not asked for in another thread of the actor.
    """

    def build(
        self, factory: EnvFactory, policy: torch.nn.Module, frames_per_batch: int, beats: Any
    ) -> tuple[str, int]:
        """Put the cars on the road; return the address of the node and the id of the process."""
        import ray

        # As in worker processes of one machine: the last digits of sums depend on the number of threads.
        torch.set_num_threads(1)
        self._policy, self._kept = policy, KeptPrints()
        steps, reported_at = 0, 0.0

        def on_step() -> None:
            nonlocal steps, reported_at
            steps += 1
            now = time.monotonic()
            if now > reported_at + _REPORT_EVERY_S:
                reported_at = now
                beats.report.remote(factory.worker, steps)

        self._collector = CarCollector(
            replace(factory, prints=self._kept, on_step=on_step)(),
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            use_buffers=True,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        self._source = iter(self._collector)
        return ray.util.get_node_ip_address(), os.getpid()

    def drive(self) -> tuple[dict[Key, np.ndarray], str]:
        """Return a batch [cars, T] by key, and what the reward function printed; raises as `RaceEnv` does."""
        batch = next(self._source)
        return {key: value.numpy() for key, value in batch.items(True, True)}, self._kept.take()

    def take_weights(self, weights: Mapping[str, np.ndarray]) -> None:
        """Drive with these weights from the next batch on."""
        # Arrays that Ray shares between processes cannot be written.
        self._policy.load_state_dict({name: torch.from_numpy(w.copy()) for name, w in weights.items()})
        self._collector.update_policy_weights_()

    def put_rivals(self, weights: Sequence[Weights]) -> None:
        """Let policies with these weights drive the rivals."""
        self._collector.env.put_rivals(weights)

    def take_state(self) -> dict[str, Any]:
        """Return everything that the next batch depends on except the policy."""
        state: dict[str, Any] = self._collector.env.take_state()
        return state

    def put_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what `take_state` returned."""
        self._collector.env.put_state(state)
        self._collector.reset()


class RayCollector(Collector):
    """An endless source of batches, as `LocalCollector` with `sync`: the same batches in the same order, bit for bit.

    TorchRL's RayCollector is not used: it waits forever for a worker that hangs, does not say which one is lost, joins
    the training process with all workers in a process group of torch.distributed that does not survive the loss of one,
    and returns neither prints nor the cars' state after a crash.
    """

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
        """Start the cars; arguments and errors as for `open_collector`."""
        import ray

        assert config.processes is not None
        self._ray, self._policy, self._run_dir = ray, SamplingPolicy(policy), run_dir
        self._prints = RewardPrints(run_dir / REWARD_PRINTS)
        self._hang_timeout_s = config.hang_timeout_s
        self._begun_from = state or {}
        self._began = False
        states = states_of(self._begun_from, config.processes)
        ray_cluster.check_collector(config)
        self._beats = ray.remote(num_cpus=0)(Beats).remote()
        self._asked, self._reported = self._beats.steps.remote(), dict[int, int]()
        kind = ray.remote(num_cpus=config.threads or 1, scheduling_strategy="SPREAD", max_restarts=0)(Cars)
        self._cars = [kind.remote() for _ in range(config.processes)]
        self._where = ["Ray cluster"] * config.processes
        try:
            self._start(config, setup, frames_per_batch, states, rivals)
        except BaseException:
            self.close()
            raise

    def _start(
        self,
        config: CollectorConfig,
        setup: RaceSetup,
        frames_per_batch: int,
        states: Sequence[Any],
        rivals: Rivals | None,
    ) -> None:
        cars = cars_per_process(config)
        frames = steps_per_batch(config, frames_per_batch) * cars
        threads = config.threads or 1
        factories = [
            EnvFactory(
                setup=setup, worker=worker, n_cars=cars, threads=threads, run_dir=self._run_dir, rivals=rivals
            )
            for worker in range(len(self._cars))
        ]
        policy = self._ray.put(self._policy)
        built = self._ask(
            lambda worker: self._cars[worker].build.remote(factories[worker], policy, frames, self._beats),
            max(_START_TIMEOUT_S, self._hang_timeout_s),
        )
        self._where = [f"process {pid} on {address}" for address, pid in built]
        if states:
            self._ask(lambda worker: self._cars[worker].put_state.remote(states[worker]))

    def next_batch(self) -> TensorDictBase:
        """Return the next batch."""
        self._began = True
        return self._joined(self._ask(lambda worker: self._cars[worker].drive.remote()))

    def publish_policy(self) -> None:
        """Send the workers the policy's present weights."""
        # Once for each node, not for each worker.
        weights = self._ray.put({name: w.detach().numpy() for name, w in self._policy.state_dict().items()})
        self._ask(lambda worker: self._cars[worker].take_weights.remote(weights))

    def publish_rivals(self, weights: Sequence[Weights]) -> None:
        """Send the workers the rivals' weights."""
        sent = self._ray.put(list(weights))
        self._ask(lambda worker: self._cars[worker].put_rivals.remote(sent))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the cars after the last batch."""
        if not self._began:
            return dict(self._begun_from)
        states = self._ask(lambda worker: self._cars[worker].take_state.remote())
        return by_worker(states)

    def close(self) -> None:
        """End every worker."""
        if not self._ray.is_initialized():
            return
        for actor in (*self._cars, self._beats):
            self._ray.kill(actor)
        ray_cluster.leave()

    def _joined(self, parts: Sequence[tuple[dict[Any, np.ndarray], str]]) -> TensorDictBase:
        printed = "".join(text for _, text in parts)
        if printed:
            self._prints.write(printed)
        batches = [batch for batch, _ in parts]
        # One copy: what Ray returns cannot be written.
        whole = {
            key: torch.from_numpy(np.concatenate([batch[key] for batch in batches])) for key in batches[0]
        }
        return TensorDict(whole, batch_size=whole["action"].shape[:2])

    def _ask(self, ask: Callable[[int], Any], timeout_s: float | None = None) -> list[Any]:
        """Return the workers' answers in the order of the workers."""
        timeout_s = timeout_s or self._hang_timeout_s
        waiting = {ask(worker): worker for worker in range(len(self._cars))}
        answers: dict[int, Any] = {}
        idle_s = dict.fromkeys(waiting.values(), 0.0)
        steps: dict[int, int] = {}
        looked = time.monotonic()
        while waiting:
            ready, _ = self._ray.wait(list(waiting), num_returns=len(waiting), timeout=_LOOK_EVERY_S)
            for reference in ready:
                worker = waiting.pop(reference)
                answers[worker] = self._answer(worker, reference)
            if not waiting:
                break
            now = time.monotonic()
            reported = self._steps()
            for worker in waiting.values():
                # A longer pause was ours: the whole run stopped with Ctrl-Z.
                moved = reported.get(worker) != steps.get(worker)
                idle_s[worker] = 0.0 if moved else idle_s[worker] + min(now - looked, 2 * _LOOK_EVERY_S)
                if idle_s[worker] > timeout_s:
                    raise RunFailed(
                        f"collector worker {worker} ({self._where[worker]}) took no step for {timeout_s:.0f} s "
                        f"(after {reported.get(worker, 0)} steps) and was ended"
                    )
            steps, looked = reported, now
        return [answers[worker] for worker in range(len(self._cars))]

    def _answer(self, worker: int, reference: Any) -> Any:
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            if not isinstance(error.cause, RunFailed):
                raise
            write_crash_dump(self._run_dir, error.cause, worker=worker)
            raise RunFailed(str(error.cause)) from error
        except self._ray.exceptions.RayError as error:
            _log.debug("collector worker %d: %s", worker, error)
            raise RunFailed(
                f"collector worker {worker} ({self._where[worker]}) is lost: its process was killed or its node is gone"
            ) from error

    def _steps(self) -> dict[int, int]:
        """Return the steps that the workers reported last, without waiting."""
        done, _ = self._ray.wait([self._asked], timeout=0)
        if done:
            try:
                self._reported = self._ray.get(self._asked)
            except self._ray.exceptions.RayError as error:
                raise RunFailed(
                    "the process that counts the steps of the collector's workers is lost, or its node is gone"
                ) from error
            self._asked = self._beats.steps.remote()
        return self._reported
