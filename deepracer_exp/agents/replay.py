"""The steps that soft actor-critic learns from again: a ring of the newest ones, in memory and as parts on disk."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import RandomSampler, ReplayBuffer, TensorStorage

_PART_BYTES = 2**28
"""Most bytes of a part that is written to disk."""


class _Complete(RandomSampler):
    """Draws, with repetition, among the steps whose following observation is known."""

    positions = torch.zeros(0, dtype=torch.int64)

    def sample(self, storage: Any, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Return positions in the storage."""
        drawn = torch.randint(len(self.positions), (batch_size,), generator=self._rng)
        return self.positions[drawn], {}


class Replay:
    """The newest control steps of all cars, each observation stored once.

    A row holds a step of every car, and rows follow each other in time, so that what a car sees after a step is what it
    sees in the next row. Two kinds of steps are left out of what is drawn: those of the newest row, until there is a
    next one, and those at which an episode was cut off, after which the next row has another episode. After a step that
    ended an episode by itself nothing is expected any more, and what is seen in the next row has no effect.

    Attributes:
        cars: Steps in a row; 0 before the first batch.
        written_rows: Rows that arrived since the start of the run.
        first_row: Number of the oldest of these that is still there.
    """

    def __init__(
        self, keys: Sequence[str], most_steps: int, most_bytes: int, generator: torch.Generator
    ) -> None:
        """Begin without a step; the first batch says how many cars there are and how large a step is.

        `keys` are those kept of what the cars see; of the bounds of the ring, `most_steps` and `most_bytes`, the
        narrower holds.
        """
        self._keys, self._most_steps, self._most_bytes = tuple(keys), most_steps, most_bytes
        self._sampler, self._generator = _Complete(), generator
        self._buffer: ReplayBuffer | None = None
        self._rows = 0
        self.cars = 0
        self.written_rows, self.first_row = 0, 0

    def __len__(self) -> int:
        """Return how many steps can be drawn."""
        return len(self._sampler.positions)

    @property
    def arrived_steps(self) -> int:
        """Steps that arrived so far."""
        return self.written_rows * self.cars

    def extend(self, batch: TensorDictBase) -> None:
        """Add a batch [cars, T] as `Algorithm.update` gets it."""
        following = batch["next"]
        terminated = following["terminated"]
        rows = TensorDict(
            {
                **{key: batch[key] for key in self._keys},
                "action": batch["action"],
                "reward": following["reward"],
                "terminated": terminated,
                "truncated": following["done"] & ~terminated,
            },
            batch.batch_size,
        )
        self._add(rows.transpose(0, 1))

    def sample(self, size: int) -> TensorDict:
        """Return steps [size]: what was seen, `action`, and under `next` what was seen then, `reward` and the ends."""
        assert self._buffer is not None
        steps, info = self._buffer.sample(size, return_info=True)
        later = self._buffer.storage.get((info["index"] + self.cars) % (self._rows * self.cars))
        reward, terminated = steps.pop("reward"), steps.pop("terminated")
        del steps["truncated"]
        later = later.select(*self._keys)
        later.update({"reward": reward, "terminated": terminated, "done": terminated})
        return steps.set("next", later)

    def parts(self, since: int) -> list[tuple[int, TensorDictBase]]:
        """Return the rows that arrived after the first `since` ones and are still there, in parts of bounded size.

        Returns:
            Of each part the number of its first row, and the rows [T, cars].
        """
        if self._buffer is None:
            return []
        first = max(since, self.first_row)
        size = max(1, _PART_BYTES // (self.cars * self._bytes_per_step))
        begins = range(first, self.written_rows, size)
        return [(begin, self._rows_at(begin, min(begin + size, self.written_rows))) for begin in begins]

    def state_dict(self) -> dict[str, int]:
        """Return everything but the steps themselves, which `parts` has."""
        return {"cars": self.cars, "written_rows": self.written_rows, "first_row": self.first_row}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Take over a `state_dict`; `restore` adds the steps."""
        self.cars, self.written_rows, self.first_row = (
            state[key] for key in ("cars", "written_rows", "first_row")
        )

    def restore(self, parts: Sequence[tuple[int, TensorDictBase]]) -> None:
        """Fill the empty ring with parts that hold all rows of its state."""
        for begin, rows in parts:
            if self._buffer is None:
                self._open(rows)
            self._put(begin, rows)
        if parts:
            self._find_complete()

    def _add(self, rows: TensorDictBase) -> None:
        if self._buffer is None:
            self._open(rows)
        self._put(self.written_rows, rows)
        self.written_rows += len(rows)
        self.first_row = max(0, self.written_rows - self._rows)
        self._find_complete()

    def _put(self, begin: int, rows: TensorDictBase) -> None:
        """Store rows whose first has the number `begin`: a row's place is its number, counted round the ring."""
        assert self._buffer is not None
        begin, rows = max(begin, begin + len(rows) - self._rows), rows[-self._rows :]
        self._buffer.storage.set(self._places(begin, begin + len(rows)), rows.reshape(-1))

    def _places(self, begin: int, end: int) -> Tensor:
        """Return where the steps of some rows are."""
        rows = torch.arange(begin, end) % self._rows
        return (rows[:, None] * self.cars + torch.arange(self.cars)).reshape(-1)

    def _open(self, rows: TensorDictBase) -> None:
        """Allocate the ring for rows like these."""
        self.cars = rows.shape[1]
        self._bytes_per_step = sum(value[0, 0].nbytes for value in rows.values())
        steps = min(self._most_steps, self._most_bytes // self._bytes_per_step)
        self._rows = max(2, steps // self.cars)
        size = self._rows * self.cars
        # Memory that the system gives only as rows are written.
        empty = {key: value.new_zeros(size, *value.shape[2:]) for key, value in rows.items()}
        self._buffer = ReplayBuffer(
            storage=TensorStorage(TensorDict(empty, [size])),
            sampler=self._sampler,
            generator=self._generator,
        )

    def _find_complete(self) -> None:
        assert self._buffer is not None
        places = self._places(self.first_row, self.written_rows - 1)
        cut_off = self._buffer.storage.get(places)["truncated"].squeeze(-1)
        self._sampler.positions = places[~cut_off]

    def _rows_at(self, begin: int, end: int) -> TensorDictBase:
        assert self._buffer is not None
        rows: TensorDictBase = self._buffer.storage.get(self._places(begin, end))
        return rows.reshape(end - begin, self.cars)
