"""The driving of the service's bots: along the lanes at a constant speed, with changes of lanes."""

import math
from typing import NamedTuple

import numpy as np

from deepracer_exp.jit import njit

from .service_draws import uniform

_MOST_BOTS = 1000
"""Numbers of an episode's seed for each change of lanes, one for each bot."""


@njit(cache=True, nogil=True, inline="always")
def _between(rows, lane, cell, part, column):  # type: ignore[no-untyped-def]
    before = rows[lane, cell, column]
    return before + part * (rows[lane, cell + 1, column] - before)


class Manner(NamedTuple):
    """Settings of the bots' driving; see `conf/race`."""

    speed_mps: float
    pause_s: float
    least_after_s: float
    """Least and most time between two changes of lanes; infinite: none is changed."""
    most_after_s: float
    change_m: float


class Bots(NamedTuple):
    """The bots of N cars: arrays with a row per car, changed in place; see `env.others.boxes_and_bots.Others`."""

    start_m: np.ndarray
    lane: np.ndarray
    changes: np.ndarray
    change_begin_s: np.ndarray
    change_end_s: np.ndarray
    seed: np.ndarray
    pauses: np.ndarray
    poses: np.ndarray
    distance_m: np.ndarray
    offset_m: np.ndarray


@njit(cache=True, nogil=True)
def drive(ids, track_index, time_s, paths, manner, bots):  # type: ignore[no-untyped-def]
    """Move the bots of the cars `ids` on their tracks to a time, (n,) each, and change their lanes."""
    speed_mps, pause_s, least_after_s, most_after_s, change_m = manner
    start_m, lane, changes, change_begin_s, change_end_s, seed, pauses, poses, distance_m, offset_m = bots
    changing, rows = math.isfinite(least_after_s), paths.rows
    for place in range(len(ids)):
        car, track, now_s = ids[place], track_index[place], time_s[place]
        length_m, first, cells = paths.length_m[track], paths.first_row[track], paths.cells[track]
        driven_m = speed_mps * max(now_s - pauses[car] * pause_s, 0.0)
        for bot in range(start_m.shape[1]):
            if changing and now_s >= change_end_s[car, bot]:
                if changes[car, bot] > 0:
                    lane[car, bot] = 1 - lane[car, bot]
                share = uniform(seed[car], _MOST_BOTS * changes[car, bot] + bot)
                changes[car, bot] += 1
                begin_s = now_s + least_after_s + share * (most_after_s - least_after_s)
                change_begin_s[car, bot] = begin_s
                change_end_s[car, bot] = begin_s + change_m / speed_mps
            at_m = (start_m[car, bot] + driven_m) % length_m
            cell = at_m / length_m * cells
            index = min(int(cell), cells - 1)
            part = cell - index
            here, cell_at = lane[car, bot], first + index
            x, y = _between(rows, here, cell_at, part, 0), _between(rows, here, cell_at, part, 1)
            dx, dy = _between(rows, here, cell_at, part, 2), _between(rows, here, cell_at, part, 3)
            ahead, offset = _between(rows, here, cell_at, part, 4), _between(rows, here, cell_at, part, 5)
            if changing and now_s > change_begin_s[car, bot] and changes[car, bot] > 0:
                # From lane to lane as a cubic with the lanes' here directions at both ends.
                share = min((now_s - change_begin_s[car, bot]) * speed_mps / change_m, 1.0)
                weight, slope = share * share * (3.0 - 2.0 * share), 6.0 * share * (1.0 - share) / change_m
                to_x = _between(rows, 1 - here, cell_at, part, 0) - x
                to_y = _between(rows, 1 - here, cell_at, part, 1) - y
                dx += weight * (_between(rows, 1 - here, cell_at, part, 2) - dx) + slope * to_x
                dy += weight * (_between(rows, 1 - here, cell_at, part, 3) - dy) + slope * to_y
                x, y = x + weight * to_x, y + weight * to_y
                ahead += weight * (_between(rows, 1 - here, cell_at, part, 4) - ahead)
                offset += weight * (_between(rows, 1 - here, cell_at, part, 5) - offset)
            poses[car, bot, 0], poses[car, bot, 1], poses[car, bot, 2] = x, y, math.atan2(dy, dx)
            distance_m[car, bot] = (at_m + ahead) % length_m
            offset_m[car, bot] = offset
