"""Random numbers that belong to a car, whatever drives beside it."""

from collections.abc import Sequence

import numpy as np

# Draws taken from a generator at once: 256 generators asked one number each would cost 0.5 ms a step.
_BLOCK = 128


class CarStreams:
    """One independent stream of standard normal numbers per car.

    A car's numbers depend on the seed and its own number alone, not on how many cars, processes or threads
    there are, and on no other car's episodes.
    """

    def __init__(self, seed: int, cars: Sequence[int], width: int):
        """Start the streams.

        Args:
            seed: seed of the experiment.
            cars: numbers of the cars over all processes.
            width: numbers drawn per car and step.
        """
        self._generators = [np.random.default_rng(np.random.SeedSequence([seed, car])) for car in cars]
        self._block = np.empty((len(cars), _BLOCK, width))
        self._used = _BLOCK

    def normal(self) -> np.ndarray:
        """Return the next numbers of each car, shape (cars, width)."""
        if self._used == _BLOCK:
            for row, generator in zip(self._block, self._generators, strict=True):
                generator.standard_normal(out=row)
            self._used = 0
        self._used += 1
        return self._block[:, self._used - 1]
