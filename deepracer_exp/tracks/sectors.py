"""Sectors of a track by its bends."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .track import Track

Values = NDArray[np.float64]

BEND_PM = 0.3
"""Curvature from which on the centre line counts as a bend, 1/m: radii below 3.3 m."""
SMOOTH_M = 0.6
"""Length over which curvature is averaged: half the length of a short corner."""
SHORTEST_M = 0.8
"""Shorter sectors are merged with the neighbour of the more similar curvature."""
_SAMPLE_M = 0.05


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
    """Return the index of the sector of each place; -1 where the place is unknown."""
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


def waypoint_positions(course: Track) -> NDArray[np.float64]:
    """Return the lap position of each waypoint, 0 to 1."""
    steps_m = np.linalg.norm(np.diff(course.waypoints, axis=0), axis=1)
    return np.r_[0.0, np.cumsum(steps_m)] / course.length_m
