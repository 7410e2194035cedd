"""Which of the others are next to a car along the lap, and what a policy is shown of them."""

import numpy as np

from deepracer_exp.compiled import njit

SHOWN = 4
"""Numbers that `next_ones` returns of each."""


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


@njit(cache=True, nogil=True)
def next_ones(  # type: ignore[no-untyped-def]
    ids,
    distance_m,
    offset_m,
    is_bot,
    speeds_mps,
    own_m,
    own_offset_m,
    own_mps,
    width_m,
    length_m,
    count,
    behind_m,
    reach_m,
    speed_scale_mps,
):
    """Return what is shown of the next others of cars in their order along the lap, (n, count * SHOWN), float32.

    Of each: how far ahead of the car's front it is over `reach_m`; how far to the left of the car it is across the road
    over half the road's width, -2 to 2; the car's speed less its own over `speed_scale_mps`; and whether it is a bot.
    One beyond the reach, or none: 1, 0, 0, 0.

    Args:
        ids: indices of the cars, (n,).
        distance_m: of all cars' others along the lap, (N, K).
        offset_m: of the same to the left of the centre line, (N, K).
        is_bot: which of the others are cars, (K,).
        speeds_mps: of the others of the cars `ids`, (n, K).
        own_m: of the front points of the cars `ids`, (n,).
        own_offset_m: of the same to the left, (n,).
        own_mps: speeds of the cars `ids`, (n,).
        width_m: of the road, (n,).
        length_m: of the lap, (n,).
        count: how many are shown.
        behind_m: an other counts as ahead until it is so far behind.
        reach_m: up to where others are shown.
        speed_scale_mps: see above.
    """
    others = distance_m.shape[1]
    shown = np.zeros((len(ids), count * SHOWN), np.float32)
    following, gap_m = np.empty(count, np.int64), np.empty(count)
    for row in range(len(ids)):
        car, listed = ids[row], 0
        for other in range(others):
            gap = (distance_m[car, other] - own_m[row] + behind_m) % length_m[row] - behind_m
            if gap >= reach_m:
                continue
            place = min(listed, count - 1)
            if listed == count and gap >= gap_m[place]:
                continue
            while place > 0 and gap < gap_m[place - 1]:
                following[place], gap_m[place] = following[place - 1], gap_m[place - 1]
                place -= 1
            following[place], gap_m[place] = other, gap
            listed = min(listed + 1, count)
        for place in range(count):
            begin = SHOWN * place
            if place >= listed:
                shown[row, begin] = 1.0
                continue
            other = following[place]
            side = 2.0 * (offset_m[car, other] - own_offset_m[row]) / width_m[row]
            shown[row, begin] = gap_m[place] / reach_m
            shown[row, begin + 1] = min(max(side, -2.0), 2.0)
            shown[row, begin + 2] = (own_mps[row] - speeds_mps[row, other]) / speed_scale_mps
            shown[row, begin + 3] = is_bot[other]
    return shown
