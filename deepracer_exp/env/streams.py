"""Random streams per car that do not depend on the other cars."""

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

# Numbers drawn from a generator at once: one number from each of 256 generators would cost 0.5 ms a step.
_BLOCK = 128


class Purpose(IntEnum):
    """The purpose of random numbers: each has its own streams, so that none shifts another."""

    ACTION = 0
    OBSERVATION = 1
    EPISODE = 2


class CarStreams:
    """Independent random streams per car, numbered from 0 without limit.

    A stream depends only on the seed, the purpose, the car's number and the stream's number: not on how many cars,
    processes or threads there are, nor on earlier draws.
    """

    def __init__(self, seed: int, cars: Sequence[int], purpose: Purpose):
        """Set up streams for cars, given their numbers over all processes."""
        # Not lists of entropy: SeedSequence([seed, car]) and SeedSequence([seed, car, 0]) are the same.
        self._keys: list[NDArray[np.uint64]] = [
            np.random.SeedSequence(seed, spawn_key=(purpose, car))
            .generate_state(2, np.uint64)
            .view(np.uint64)
            for car in cars
        ]
        self._philox = np.random.Philox()
        self._generator = np.random.Generator(self._philox)
        self._state = self._philox.state

    def at(self, place: int, number: int) -> np.random.Generator:
        """Return a generator at the start of a car's stream; every call returns the same object.

        Args:
            place: index of the car in `cars`.
            number: number of the stream, from 0.
        """
        # A key and a counter are the whole state of Philox. Ten times faster than a new generator.
        self._state["state"] = {
            "key": self._keys[place],
            "counter": np.array([0, 0, 0, number], np.uint64),
        }
        self._philox.state = self._state
        return self._generator


class StepNoise:
    """Standard normal numbers for each car and control step.

    Attributes:
        steps: number of steps drawn; setting it continues from there.
    """

    def __init__(self, streams: CarStreams, n_cars: int, width: int):
        """Start at step 0, with `width` numbers per car and step."""
        self.steps = 0
        self._streams = streams
        self._block = np.empty((n_cars, _BLOCK, width))
        self._block_number = -1

    def normal(self) -> np.ndarray:
        """Return the next numbers of each car, shape (cars, width)."""
        number, place = divmod(self.steps, _BLOCK)
        if number != self._block_number:
            for car, numbers in enumerate(self._block):
                self._streams.at(car, number).standard_normal(out=numbers)
            self._block_number = number
        self.steps += 1
        return self._block[:, place]
