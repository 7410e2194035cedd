"""The others next to a car along the lap, and their features for a policy."""

from typing import NamedTuple

import numpy as np

from deepracer_exp.jit import njit

SHOWN = 4
"""Number of features that `next_ones` returns of each."""


@njit(cache=True, nogil=True)
def closest(distance_m, own_m):  # type: ignore[no-untyped-def]
    """Return the last of the others at or behind each car along the lap, and the first ahead of it, (N, 2).

    Both wrap around: behind the first comes the last. With one other, both are that.

    Args:
        distance_m: of the others along the lap, (N, K), K at least 1.
        own_m: of the cars' front points, (N,).
    """
    cars, count = distance_m.shape
    nearest = np.empty((cars, 2), np.int64)
    for car in range(cars):
        behind = ahead = first = last = -1
        for other in range(count):
            distance = distance_m[car, other]
            if distance <= own_m[car]:
                if behind < 0 or distance > distance_m[car, behind]:
                    behind = other
            elif ahead < 0 or distance < distance_m[car, ahead]:
                ahead = other
            if first < 0 or distance < distance_m[car, first]:
                first = other
            if last < 0 or distance >= distance_m[car, last]:
                last = other
        nearest[car, 0] = behind if behind >= 0 else last
        nearest[car, 1] = ahead if ahead >= 0 else first
    return nearest


class Around(NamedTuple):
    """The K others of each car."""

    distance_m: np.ndarray
    """Positions along the lap of the others of all cars, (N, K), as in `offset_m`."""
    offset_m: np.ndarray
    """How far to the left of the centre line they are."""
    is_bot: np.ndarray
    """Which of the others are cars, (K,)."""
    speeds_mps: np.ndarray
    """Speeds of the others of the n selected cars, (n, K)."""


class Here(NamedTuple):
    """Positions of n cars: arrays with a row per car."""

    distance_m: np.ndarray
    """Positions of the front points along the lap."""
    offset_m: np.ndarray
    """How far to the left of the centre line they are."""
    speed_mps: np.ndarray
    width_m: np.ndarray
    """Width of the road."""
    length_m: np.ndarray
    """Length of the lap."""


class Reach(NamedTuple):
    """Number and selection of the others."""

    number: int
    behind_m: float
    """An other counts as ahead until it is this far behind."""
    ahead_m: float
    """Distance within which others are shown."""
    speed_scale_mps: float
    """Divisor of closing speeds."""


@njit(cache=True, nogil=True)
def next_ones(ids, others, here, reach):  # type: ignore[no-untyped-def]
    """Return the features of the next others of the cars `ids` in order along the lap, (n, number * SHOWN), float32.

    Of each: how far ahead of the car's front it is over the reach; how far to the left of the car it is across the road
    over half the road's width, -2 to 2; the car's speed less its own over the scale; and whether it is a bot. One
    beyond the reach, or none: 1, 0, 0, 0.

    Args:
        ids: indices of the cars, (n,).
        others: an `Around`.
        here: a `Here` of the cars `ids`.
        reach: a `Reach`.
    """
    count, _, reach_m, speed_scale_mps = reach
    shown = np.zeros((len(ids), count * SHOWN), np.float32)
    following, gap_m = np.empty(count, np.int64), np.empty(count)
    for row in range(len(ids)):
        car = ids[row]
        listed = _list_next(
            others.distance_m[car], here.distance_m[row], here.length_m[row], reach, (following, gap_m)
        )
        for place in range(count):
            begin = SHOWN * place
            if place >= listed:
                shown[row, begin] = 1.0
                continue
            other = following[place]
            side = 2.0 * (others.offset_m[car, other] - here.offset_m[row]) / here.width_m[row]
            shown[row, begin] = gap_m[place] / reach_m
            shown[row, begin + 1] = min(max(side, -2.0), 2.0)
            shown[row, begin + 2] = (here.speed_mps[row] - others.speeds_mps[row, other]) / speed_scale_mps
            shown[row, begin + 3] = others.is_bot[other]
    return shown


@njit(cache=True, nogil=True)
def _list_next(distance_m, own_m, length_m, reach, listed):  # type: ignore[no-untyped-def]
    """List the next others of a car within reach and their gaps, nearest first; return how many there are."""
    count, behind_m, reach_m, _ = reach
    following, gap_m = listed
    filled = 0
    for other in range(len(distance_m)):
        gap = (distance_m[other] - own_m + behind_m) % length_m - behind_m
        if gap >= reach_m:
            continue
        place = min(filled, count - 1)
        if filled == count and gap >= gap_m[place]:
            continue
        while place > 0 and gap < gap_m[place - 1]:
            following[place], gap_m[place] = following[place - 1], gap_m[place - 1]
            place -= 1
        following[place], gap_m[place] = other, gap
        filled = min(filled + 1, count)
    return filled
