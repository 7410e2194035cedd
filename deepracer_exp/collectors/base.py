"""The interface of every collector, and what all of them need."""

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self

import torch
from tensordict import TensorDictBase

from deepracer_exp.config.learning import AlgorithmConfig
from deepracer_exp.config.running import CollectorConfig
from deepracer_exp.env.head_to_head import Weights
from deepracer_exp.errors import BadInput, count
from deepracer_exp.sim.batch import cores


class Collector(ABC):
    """An endless source of batches; a context manager that leaves no process behind.

    Each batch is a TensorDict of batch size [cars of all processes, T], keys as in `RaceEnv` plus the policy's.

    Attributes:
        ahead_s: Seconds for which the last batch had been driven when it was asked for, see `begin_next`.
    """

    ahead_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
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

    @abstractmethod
    def next_batch(self) -> TensorDictBase:
        """Return the next batch; it is valid until the one after it.

        Raises:
            RunFailed: a worker is lost.
        """

    def begin_next(self) -> None:  # noqa: B027 - a collector need not be able to
        """Start to collect the next batch with the policy published last, while the caller does other things.

        Until it is asked for, only `state_dict`, which is that before this batch, and `close` may be called.
        """

    @abstractmethod
    def publish_policy(self) -> None:
        """Drive the next batches with the policy's present weights; raises as `next_batch`."""

    @abstractmethod
    def publish_rivals(self, weights: Sequence[Weights]) -> None:
        """Let policies with these weights drive the rivals from the next batch on; raises as `next_batch`."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next batch depends on except the policy: arrays and plain values.

        It is the state at the end of the last batch; call it before the next. Raises as `next_batch`.
        """

    @abstractmethod
    def close(self) -> None:
        """End every worker."""


def worker_count(config: CollectorConfig) -> int:
    """Return the number of worker processes, 0 for collection in this process."""
    if config.mode == "in_process":
        return 0
    return config.processes or max(n for n in config.accepted_processes if n <= cores())


def steps_per_batch(config: CollectorConfig, frames: int) -> int:
    """Return the steps of each car in a batch of so many frames over all cars, rounded up to whole steps of all."""
    return -(-frames // config.cars)


def cars_per_process(config: CollectorConfig) -> int:
    """Return how many of the cars drive in each process."""
    return config.cars // max(1, worker_count(config))


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
