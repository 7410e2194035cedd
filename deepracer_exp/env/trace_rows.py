"""Packed rows of the trace, written for all cars at once."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from deepracer_exp.config.driving import QUANTITIES
from deepracer_exp.jit import compiled

from .rule_passes import nearer_of
from .trace_columns import PACKED_COLUMNS


def row_dtype(extra: Sequence[str] = ()) -> np.dtype[np.void]:
    """Return the record type of a packed row, with these columns after the others.

    Its fields are those of `PACKED_COLUMNS`; the columns of `QUANTITIES`, which are adjacent, are one, `randomized`.
    """
    fields: list[tuple[str, str] | tuple[str, str, int]] = []
    for name in (*PACKED_COLUMNS, *extra):
        if name not in QUANTITIES:
            fields.append((name, "f8"))
        elif fields[-1][0] != "randomized":
            fields.append(("randomized", "f8", len(QUANTITIES)))
    return np.dtype(fields)


class Driven(NamedTuple):
    """Values of a control step: arrays with a row per car."""

    front: np.ndarray
    """(N, 2)."""
    yaw_rad: np.ndarray
    speed_mps: np.ndarray
    """Measured."""
    closest_waypoints: np.ndarray
    """(N, 2)."""
    steering_deg: np.ndarray
    """Commanded, as `throttle_mps`."""
    throttle_mps: np.ndarray
    action: np.ndarray
    """Numbers of actions, float64; NaN for a continuous space."""
    reward: np.ndarray
    episode_return: np.ndarray
    all_wheels_on_track: np.ndarray
    progress: np.ndarray
    status: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    randomized: np.ndarray
    """Values of `QUANTITIES`, (N, Q)."""


class Lengths(NamedTuple):
    """Constants of all steps."""

    waypoints: np.ndarray
    """Waypoints as in `Tracks.waypoints`; `first_waypoint` likewise."""
    first_waypoint: np.ndarray
    length_m: np.ndarray
    """Lengths of the tracks, (W,)."""
    period_s: float


@compiled
def write_rows(rows, episodes, driven, lengths):  # type: ignore[no-untyped-def]
    """Write the columns of a control step; those that are not named stay as they are.

    `rows` are `row_dtype` records, (N,), whose columns are those of `trace.PACKED_COLUMNS`.
    """
    randomized = driven.randomized
    for car in range(len(rows)):
        row, track = rows[car], episodes.track_index[car]
        row.episode, row.steps = episodes.episode[car], episodes.steps[car]
        row.X, row.Y, row.yaw = driven.front[car, 0], driven.front[car, 1], math.degrees(driven.yaw_rad[car])
        row.steer, row.throttle, row.action = (
            driven.steering_deg[car],
            driven.throttle_mps[car],
            driven.action[car],
        )
        row.reward, row.episode_return = driven.reward[car], driven.episode_return[car]
        row.done = driven.terminated[car] or driven.truncated[car]
        row.all_wheels_on_track = driven.all_wheels_on_track[car]
        row.closest_waypoint = nearer_of(
            driven.closest_waypoints[car], driven.front[car], lengths.waypoints, lengths.first_waypoint[track]
        )
        row.progress = driven.progress[car]
        row.track_len, row.track = lengths.length_m[track], episodes.course[car]
        row.tstamp = episodes.clock_steps[car] * lengths.period_s
        row.episode_status, row.speed_mps = driven.status[car], driven.speed_mps[car]
        for quantity in range(randomized.shape[1]):
            row.randomized[quantity] = randomized[car, quantity]
