"""What happens inside a collector's process on a Ray cluster."""

import functools
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.collectors import Collector

from deepracer_exp.rewards.prints import RewardPrints

from .worker import EnvFactory

_TELL_EVERY_S = 0.5

Key = str | tuple[str, ...]


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

    def _write(self, text: str) -> None:
        self._lines.append(text)


@dataclass(frozen=True, kw_only=True)
class FarEnvFactory(EnvFactory):
    """Builds the cars of one process that shares no file with the training process."""

    kept: KeptPrints = field(default_factory=KeptPrints)
    on_step: Callable[[], None] | None = None

    def _prints(self) -> RewardPrints:
        return self.kept

    def _sign_of_life(self) -> Callable[[], None] | None:
        return self.on_step


class Cars:
    """The cars of one process; a Ray actor whose methods run in its main thread.

    Only there a reward function that hangs can be stopped (`env.reward_guard`), so that its steps are told to
    `Beats` and not asked for from another thread of it.
    """

    def build(
        self, factory: FarEnvFactory, policy: torch.nn.Module, frames_per_batch: int, beats: Any
    ) -> tuple[str, int]:
        """Put the cars on the road; return the address of the node and the number of the process.

        Args:
            factory: of the cars.
            policy: which drives them.
            frames_per_batch: control steps of a batch over these cars.
            beats: handle of `Beats`.
        """
        import ray

        # As in worker processes of one machine: with other threads sums have other last digits.
        torch.set_num_threads(1)
        self._policy, self._beats, self._kept = policy, beats, factory.kept
        self._steps, self._told_at = 0, 0.0
        self._collector = Collector(
            replace(factory, on_step=functools.partial(self._step, factory.worker))(),
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
        """Return a batch [cars, T] by key, and what the reward function printed.

        Raises:
            RunFailed: as `RaceEnv` does.
        """
        batch = next(self._source)
        return {key: value.numpy() for key, value in batch.items(True, True)}, self._kept.take()

    def take_weights(self, weights: Mapping[str, np.ndarray]) -> None:
        """Drive with these weights from the next batch on."""
        # Arrays that Ray shares between processes cannot be written.
        self._policy.load_state_dict({name: torch.from_numpy(w.copy()) for name, w in weights.items()})
        self._collector.update_policy_weights_()

    def take_state(self) -> dict[str, Any]:
        """Return all that the next batch depends on but the policy."""
        state: dict[str, Any] = self._collector.env.take_state()
        return state

    def put_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what `take_state` returned."""
        self._collector.env.put_state(state)
        self._collector.reset()

    def _step(self, worker: int) -> None:
        self._steps += 1
        now = time.monotonic()
        if now > self._told_at + _TELL_EVERY_S:
            self._told_at = now
            self._beats.tell.remote(worker, self._steps)
