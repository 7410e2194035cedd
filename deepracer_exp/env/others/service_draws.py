"""Initial placement of boxes and bots, drawn for each car and episode as by the service.

Their random numbers are hashes of a seed and a number, so that only the seed has to be kept, and all cars are placed in
one compiled pass (Steele and others, "Fast splittable pseudorandom number generators", 2014: SplitMix64).
"""

import numpy as np

from deepracer_exp.jit import njit

END_M = 1.0
"""The last box or bot is placed at least so far before the start line (the service's)."""
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_PLACES = 10**9
"""Numbers of an episode's seed from which places are drawn; those below are of changes of lanes."""


@njit(cache=True, nogil=True)
def _hash(seed, number):  # type: ignore[no-untyped-def]
    z = np.uint64(seed) + np.uint64(1 + number) * _GOLDEN
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True)
def uniform(seed, number):  # type: ignore[no-untyped-def]
    """Return the uniform random number in [0, 1) at position `number`, from 0, of a seed's sequence."""
    return np.float64(_hash(seed, number) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True)
def episode_seeds(keys, episode):  # type: ignore[no-untyped-def]
    """Return the seeds of episodes, (n,) uint64, of cars with these keys.

    Args:
        keys: of the cars, (n,), uint64.
        episode: numbers of their episodes from -1, (n,).
    """
    seeds = np.empty(len(keys), np.uint64)
    for row in range(len(keys)):
        seeds[row] = _hash(keys[row], 1 + episode[row])
    return seeds


@njit(cache=True, nogil=True)
def place(seeds, first, random, room_m, places_m, lanes):  # type: ignore[no-untyped-def]
    """Place boxes or bots: fill `places_m` with distances along the lap, and `lanes` with 0 or 1, both (n, count).

    Spread evenly, lanes alternate. At random, each in turn is moved to anywhere between its neighbours that keeps the
    least distance, and lanes are drawn.

    Args:
        seeds: of the episodes, (n,).
        first: number of the first of these among all others of a car.
        random: whether places are drawn.
        room_m: least distance between two, and of the first from the start line, (n,); length of the lap, (n,).
        places_m: see above.
        lanes: see above.
    """
    least_m, length_m = room_m
    rows, count = places_m.shape
    order = np.empty(count, np.int64)
    for row in range(rows):
        least, end = least_m[row], length_m[row] - END_M
        for index in range(count):
            places_m[row, index] = least + index * ((end - least) / max(count - 1, 1))
            lanes[row, index] = index % 2
            order[index] = index
        if not random:
            continue
        seed, number = seeds[row], _PLACES + 3 * first
        for index in range(count - 1, 0, -1):
            other = int(uniform(seed, number + index) * (index + 1))
            order[index], order[other] = order[other], order[index]
        for index in order:
            low = least if index == 0 else places_m[row, index - 1] + least
            high = end if index == count - 1 else places_m[row, index + 1] - least
            if low < high:
                places_m[row, index] = low + uniform(seed, number + count + index) * (high - low)
            lanes[row, index] = int(2.0 * uniform(seed, number + 2 * count + index))
