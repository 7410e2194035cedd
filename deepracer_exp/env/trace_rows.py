"""Packed rows of the trace, written for all cars at once."""

import math
from collections.abc import Sequence

import numpy as np

from deepracer_exp.compiled import compiled

from .rule_passes import nearer_of
from .trace import PACKED_COLUMNS, RANDOMIZED


def row_dtype(extra: Sequence[str] = ()) -> np.dtype[np.void]:
    """Return the record that a packed row is, with these columns after the others.

    Its fields are those of `PACKED_COLUMNS`; the columns of `RANDOMIZED`, which are adjacent, are one, `randomized`.
    """
    fields: list[tuple[str, str] | tuple[str, str, int]] = []
    for name in (*PACKED_COLUMNS, *extra):
        if name not in RANDOMIZED:
            fields.append((name, "f8"))
        elif fields[-1][0] != "randomized":
            fields.append(("randomized", "f8", len(RANDOMIZED)))
    return np.dtype(fields)


@compiled
def write_rows(  # type: ignore[no-untyped-def]
    rows,
    episode,
    steps,
    front,
    yaw_rad,
    steering_deg,
    speed_mps,
    action,
    reward,
    terminated,
    truncated,
    all_wheels_on_track,
    progress,
    closest_waypoints,
    waypoints,
    first_waypoint,
    length_m,
    course,
    track_index,
    clock_steps,
    period_s,
    status,
    measured_mps,
    episode_return,
    randomized,
):
    """Write the columns of a control step; those that are not named stay as they are.

    `rows` are `row_dtype` records, (N,), whose columns are those of `trace.PACKED_COLUMNS`. Front points are (N, 2),
    closest waypoints (N, 2), waypoints those of `Tracks.waypoints`, commanded steering and speed (N,), numbers of
    actions float64, NaN for a continuous space, lengths those of the tracks, (W,), and randomized quantities those of
    `trace.RANDOMIZED`, (N, Q); the rest is (N,).
    """
    for car in range(len(rows)):
        row = rows[car]
        row.episode, row.steps = episode[car], steps[car]
        row.X, row.Y, row.yaw = front[car, 0], front[car, 1], math.degrees(yaw_rad[car])
        row.steer, row.throttle, row.action = steering_deg[car], speed_mps[car], action[car]
        row.reward, row.episode_return = reward[car], episode_return[car]
        row.done = terminated[car] or truncated[car]
        row.all_wheels_on_track = all_wheels_on_track[car]
        first = first_waypoint[track_index[car]]
        row.closest_waypoint = nearer_of(closest_waypoints[car], front[car], waypoints, first)
        row.progress = progress[car]
        row.track_len, row.track = length_m[track_index[car]], course[car]
        row.tstamp = clock_steps[car] * period_s
        row.episode_status, row.speed_mps = status[car], measured_mps[car]
        for quantity in range(randomized.shape[1]):
            row.randomized[quantity] = randomized[car, quantity]
