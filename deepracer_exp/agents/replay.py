"""The replay of soft actor-critic, in TorchRL's replay buffer."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer

_FOLLOWING = ("reward", "done", "terminated")


class Replay:
    """The newest transitions of all cars: `obs, action, next_obs, reward, done`."""

    def __init__(
        self, keys: Sequence[str], most_steps: int, most_bytes: int, generator: torch.Generator
    ) -> None:
        """Start empty; the first batch decides the size of a step.

        `keys` are the kept entries of the observation; the narrower of the bounds `most_steps` and `most_bytes` holds.
        `generator` draws the steps.
        """
        self._keys, self._most_steps, self._most_bytes = tuple(keys), most_steps, most_bytes
        self._generator = generator
        self._buffer: ReplayBuffer | None = None

    def __len__(self) -> int:
        """Return the number of stored steps."""
        return 0 if self._buffer is None else len(self._buffer)

    def extend(self, batch: TensorDictBase) -> None:
        """Add a batch [cars, T] as `Algorithm.update` gets it."""
        steps = batch.select(*self._keys, "action")
        steps["next"] = batch["next"].select(*self._keys, *_FOLLOWING)
        # In the order of time, so that the oldest steps of all cars are replaced first.
        self._add(steps.transpose(0, 1).reshape(-1))

    def sample(self, size: int) -> TensorDictBase:
        """Return steps [size], drawn with replacement; keys as in a batch."""
        assert self._buffer is not None
        steps: TensorDictBase = self._buffer.sample(size)
        return steps

    def state_dict(self) -> dict[str, Any]:
        """Return the steps in their places in the buffer, and the place of the next one."""
        if self._buffer is None:
            return {}
        return {"steps": self._buffer[:].to_dict(), "writer": self._buffer.writer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict` into an empty replay; with the same generator it draws the same steps."""
        if state:
            self._add(TensorDict(state["steps"], state["steps"]["action"].shape[:1]))
            assert self._buffer is not None
            self._buffer.writer.load_state_dict(state["writer"])

    def _add(self, steps: TensorDictBase) -> None:
        """Add steps [n], the oldest first."""
        if self._buffer is None:
            step_bytes = sum(value[0].nbytes for value in steps.values(True, True))
            most_steps = max(1, min(self._most_steps, self._most_bytes // step_bytes))
            self._buffer = ReplayBuffer(storage=LazyTensorStorage(most_steps), generator=self._generator)
        self._buffer.extend(steps[-self._buffer.storage.max_size :])
