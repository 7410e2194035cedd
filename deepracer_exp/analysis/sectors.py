"""Sectors of a course by its bends, the times of laps in them, and the time one lap loses to another."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.tracks.track import Track

from .log_course import waypoint_positions
from .log_view import LEAST_LAPS, LogView
from .once import once_per_view
from .statistics import Values
from .step_columns import first_rows, laps_driven

BEND_PM = 0.3
"""Curvature from which on the centre line counts as a bend, 1/m: radii below 3.3 m."""
SMOOTH_M = 0.6
"""Length over which curvature is averaged: half the length of a short corner."""
SHORTEST_M = 0.8
"""Shorter sectors are merged with the neighbour of the more similar curvature."""
_SAMPLE_M = 0.05
_PLACES = 200
"""Places at which two laps are compared."""
_APART = 4.0
"""Offset between the lap positions of two laps that are interpolated together."""


@dataclass(frozen=True, kw_only=True)
class Sector:
    """A part of the course between two places."""

    name: str
    """`left`, `right` or `straight` and a number, which counts all sectors from the start line on."""
    begin: float
    """Lap position, 0 to 1."""
    end: float
    first_waypoint: int
    last_waypoint: int


def sectors_of(course: Track) -> list[Sector]:
    """Divide a course into bends and straights by the curvature of its centre line, from waypoint 0 on."""
    count = max(20, round(course.length_m / _SAMPLE_M))
    edges = np.linspace(0.0, 1.0, count + 1)
    curvature = _curvature(course, (edges[1:] + edges[:-1]) / 2)
    kinds = np.where(np.abs(curvature) < BEND_PM, 0, np.sign(curvature)).astype(int)
    cuts = [0, *(np.flatnonzero(np.diff(kinds)) + 1), count]
    while len(cuts) > 2 and np.diff(cuts).min() * course.length_m / count < SHORTEST_M:
        shortest = int(np.diff(cuts).argmin())
        means = [float(curvature[a:b].mean()) for a, b in pairwise(cuts)]
        neighbours = [k for k in (shortest - 1, shortest + 1) if 0 <= k < len(means)]
        like = min(neighbours, key=lambda k: abs(means[k] - means[shortest]))
        del cuts[max(shortest, like)]
    # By now neighbours may be of one kind.
    merged = [_kind(curvature[a:b]) for a, b in pairwise(cuts)]
    bounds = [0, *(cut for cut, (a, b) in zip(cuts[1:-1], pairwise(merged), strict=True) if a != b), count]
    waypoint_at = waypoint_positions(course)
    last = len(waypoint_at) - 1 - course.closed
    sectors = []
    for number, (a, b) in enumerate(pairwise(bounds), start=1):
        inside = np.flatnonzero((waypoint_at >= edges[a]) & (waypoint_at < edges[b]))
        sectors.append(
            Sector(
                name=f"{_kind(curvature[a:b])} {number}",
                begin=float(edges[a]),
                end=float(edges[b]),
                first_waypoint=int(inside[0]) if len(inside) else 0,
                last_waypoint=min(int(inside[-1]), last) if len(inside) else 0,
            )
        )
    return sectors


def sector_at(sectors: Sequence[Sector], lap_position: Values) -> NDArray[np.intp]:
    """Return in which sector places lie, -1 where they are not known."""
    index = np.searchsorted([part.end for part in sectors[:-1]], lap_position, side="right")
    return np.where(np.isfinite(lap_position), index, -1)


def _kind(curvature_pm: Values) -> str:
    mean = float(curvature_pm.mean())
    return "straight" if abs(mean) < BEND_PM else "left" if mean > 0 else "right"


def _curvature(course: Track, place: Values) -> Values:
    """Return the centre line's turn over `SMOOTH_M` around places, 1/m, positive to the left."""
    half = SMOOTH_M / 2 / course.length_m
    low, high = place - half, place + half
    if not course.closed:
        low, high = np.maximum(low, 0.0), np.minimum(high, 1.0)
    before, after = (course.start_pose(edge).yaw_rad for edge in (low, high))
    return ((after - before + np.pi) % (2 * np.pi) - np.pi) / ((high - low) * course.length_m)


def interval_times(steps: pd.DataFrame, bounds: Values, wanted: Sequence[int] | None = None) -> pd.DataFrame:
    """Return the seconds each complete lap spends between places, interpolated along the lap position.

    `steps` are those of a `LogView`, training or evaluations; `bounds` are lap positions (n + 1,), growing from 0 to 1;
    `wanted` are indices in `LogView.episodes`, None: all.

    The interval in which a lap begins is driven in two parts, at its beginning and at its end, so that the times of a
    lap always add up to its lap time.

    Returns:
        A row for each lap (`tables.laps_driven`), a column for each interval; the index is that of `LogView.episodes`.
    """
    begin = np.flatnonzero(first_rows(steps))
    end = np.append(begin[1:], len(steps))[: len(begin)] - 1
    columns = {name: steps[name].to_numpy(np.float64) for name in ("progress", "lap_position", "lap_clock_s")}
    laps = np.flatnonzero(laps_driven(steps))
    laps = laps if wanted is None else laps[np.isin(laps, wanted)]
    begin, end = begin[laps], end[laps]
    rows = end - begin + 1
    lap = np.repeat(np.arange(len(laps)), rows)
    row = np.arange(rows.sum()) + np.repeat(begin - np.cumsum(rows) + rows, rows)
    lap_time_s = columns["lap_clock_s"][end]
    gone = np.clip(columns["progress"][row] / 100.0, 0.0, 1.0)
    # Every lap begins with a point of its own, so that nothing is interpolated between two laps.
    starts = np.cumsum(rows) - rows
    places = np.insert(np.maximum.accumulate(_APART * lap + gone), starts, _APART * np.arange(len(laps)))
    time_s = np.insert(columns["lap_clock_s"][row], starts, 0.0)
    start = (columns["lap_position"][begin] - columns["progress"][begin] / 100.0) % 1.0
    relative = (bounds[None, :-1] - start[:, None]) % 1.0  # bound 1 is bound 0 again
    query = _APART * np.arange(len(laps))[:, None] + relative
    passed_s = np.interp(query.ravel(), places, time_s).reshape(relative.shape) if len(laps) else relative
    passed_s[relative == 0.0] = 0.0  # the car stands there for a step
    next_s, next_at = np.roll(passed_s, -1, axis=1), np.roll(relative, -1, axis=1)
    spent_s = next_s - passed_s + np.where(next_at <= relative, lap_time_s[:, None], 0.0)
    return pd.DataFrame(spent_s, index=laps)


def times_by_sector(
    steps: pd.DataFrame, sectors: Sequence[Sector], wanted: Sequence[int] | None = None
) -> pd.DataFrame:
    """Return `interval_times` of the sectors, columns by their names; of laps whose times are all known."""
    bounds = np.array([0.0, *(part.end for part in sectors)])
    times = interval_times(steps, bounds, wanted).set_axis([part.name for part in sectors], axis=1)
    return times[np.isfinite(times).all(axis=1)]


@once_per_view
def sectors_now(view: LogView, course: Track) -> tuple[list[Sector], pd.DataFrame, str]:
    """Return the sectors, `times_by_sector` of the present policy's laps, and the description of these."""
    episodes, when = view.now(LEAST_LAPS)
    sectors = sectors_of(course)
    return sectors, times_by_sector(view.steps, sectors, episodes.index), when


def time_lost(steps: pd.DataFrame, lap: int, other: int) -> pd.DataFrame:
    """Return one lap's delay behind another along the course; both are indices in `LogView.episodes`.

    Returns:
        `lap_position` and `delta_s`, the time lost since lap position 0, negative if the lap is ahead; at 1 it is the
        difference of the lap times.

    Raises:
        KeyError: one of them is not a complete lap.
    """
    bounds = np.linspace(0.0, 1.0, _PLACES + 1)
    times = interval_times(steps, bounds, [lap, other])
    lost_s = times.loc[lap].to_numpy() - times.loc[other].to_numpy()
    return pd.DataFrame({"lap_position": bounds, "delta_s": np.r_[0.0, np.cumsum(lost_s)]})
