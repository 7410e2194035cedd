"""Random numbers that belong to a car, whatever drives beside it."""

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

# Draws taken from a generator at once: 256 generators asked one number each would cost 0.5 ms a step.
_BLOCK = 128


class Purpose(IntEnum):
    """What random numbers are for: each purpose has streams of its own, so that none shifts another."""

    ACTION = 0
    OBSERVATION = 1
    EPISODE = 2


class CarStreams:
    """Endlessly many independent streams per car, each with a number.

    What a stream holds depends on the seed, the purpose, the car's own number and the stream's number alone, not on how
    many cars, processes or threads there are, nor on what was drawn before.
    """

    def __init__(self, seed: int, cars: Sequence[int], purpose: Purpose):
        """Know the cars by their numbers over all processes."""
        # Lists of entropy would not do: SeedSequence([seed, car]) and SeedSequence([seed, car, 0]) are the same.
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
        """Return a generator at the beginning of a car's stream; it is the same object in every call.

        Args:
            place: of the car among `cars`.
            number: of the stream, from 0.
        """
        # Philox is made for this: a key and a counter say where it is. Ten times faster than a new generator.
        self._state["state"] = {
            "key": self._keys[place],
            "counter": np.array([0, 0, 0, number], np.uint64),
        }
        self._philox.state = self._state
        return self._generator


class StepNoise:
    """Standard normal numbers for each car and control step.

    Attributes:
        steps: how many steps were drawn; noise set to another's `steps` goes on like it.
    """

    def __init__(self, streams: CarStreams, n_cars: int, width: int):
        """Begin at step 0, with `width` numbers per car and step."""
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
