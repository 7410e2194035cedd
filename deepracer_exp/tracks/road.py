"""The road's area and the exact test whether a point lies on it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numba import njit
from shapely.geometry.base import BaseGeometry

from deepracer_exp.errors import BadInput

BAND_M = 0.1
"""Height of the y bands that edges are sorted into; grown until there are at most `MOST_BANDS`."""
MOST_BANDS = 10_000
MOST_OFF = 0.05
"""Share of waypoints that may lie off the road before the borders count as wrong."""


class Bands(NamedTuple):
    """The edges of one or more polygons, sorted by y band.

    Band k of polygon w has the rows `first[b]:first[b + 1]` of `edge` with b = `at[w] + k`.
    """

    low_y: np.ndarray
    band_m: np.ndarray
    bands: np.ndarray
    at: np.ndarray
    first: np.ndarray
    edge: np.ndarray
    """(entries, 4): lower y, upper y, x at the lower end, dx / dy."""


def road_area(center: np.ndarray, inner: np.ndarray, outer: np.ndarray, closed: bool) -> BaseGeometry:
    """Return the road between two borders as AWS builds it (deepracer-simapp, track_geom).

    A closed course is the outer ring minus the inner one; an open one is the ring of the outer border
    followed by the inner one backwards.

    Raises:
        BadInput: The borders enclose no road, or not the one the centre line runs on.
    """
    ring = outer if closed else np.concatenate([outer, inner[::-1]])
    road = _area(ring).difference(_area(inner)) if closed else _area(ring)
    off = (
        ~shapely.dwithin(road, shapely.points(center), 1e-6) if road.area > 0 else np.ones(len(center), bool)
    )
    if off.mean() > MOST_OFF:
        raise BadInput(
            f"{off.sum()} of {len(center)} centre points lie off the road between the borders; accepted are "
            "borders on both sides of the centre line that do not cross, the inner one inside"
        )
    return road


def _area(ring: np.ndarray) -> BaseGeometry:
    polygon = shapely.Polygon(ring)
    return polygon if polygon.is_valid else shapely.make_valid(polygon)


def build_bands(road: BaseGeometry) -> Bands:
    """Sort the edges of the road's polygons into y bands for the crossing-number test."""
    corners = [shapely.get_coordinates(ring) for ring in shapely.get_rings(shapely.get_parts(road))]
    a = np.concatenate([ring[:-1] for ring in corners])
    b = np.concatenate([ring[1:] for ring in corners])
    # A level edge is never crossed by the level ray that the test sends out.
    a, b = a[a[:, 1] != b[:, 1]], b[a[:, 1] != b[:, 1]]
    up = a[:, 1] < b[:, 1]
    low, high = np.where(up[:, None], a, b), np.where(up[:, None], b, a)
    low_y, high_y = float(low[:, 1].min()), float(high[:, 1].max())
    band_m = max(BAND_M, (high_y - low_y) / MOST_BANDS)
    bands = math.ceil((high_y - low_y) / band_m)
    begin = np.clip(((low[:, 1] - low_y) / band_m).astype(np.int64), 0, bands - 1)
    end = np.clip(((high[:, 1] - low_y) / band_m).astype(np.int64), 0, bands - 1)
    band = np.concatenate([np.arange(i, j + 1) for i, j in zip(begin, end, strict=True)])
    index = np.repeat(np.arange(len(low)), end - begin + 1)
    index = index[np.argsort(band, kind="stable")]
    edges = np.column_stack(
        [low[:, 1], high[:, 1], low[:, 0], (high[:, 0] - low[:, 0]) / (high[:, 1] - low[:, 1])]
    )
    first = np.r_[0, np.cumsum(np.bincount(band, minlength=bands))]
    return Bands(
        low_y=np.array([low_y]),
        band_m=np.array([band_m]),
        bands=np.array([bands]),
        at=np.array([0]),
        first=first,
        edge=np.ascontiguousarray(edges[index]),
    )


def join_bands(roads: Sequence[Bands]) -> Bands:
    """Join polygons in their order."""
    if len(roads) == 1:
        return roads[0]
    at, edge_at = (
        np.cumsum([0, *(len(getattr(road, name)) for road in roads[:-1])]) for name in ("first", "edge")
    )
    joined = {name: np.concatenate([getattr(road, name) for road in roads]) for name in Bands._fields}
    moved = {
        "at": np.concatenate([road.at + by for road, by in zip(roads, at, strict=True)]),
        "first": np.concatenate([road.first + by for road, by in zip(roads, edge_at, strict=True)]),
    }
    return Bands(**{**joined, **moved})


@njit(cache=True, nogil=True)
def on_road(b, track_index, points):  # type: ignore[no-untyped-def]
    """Return for points (m, 2) whether a ray to the right crosses an odd number of edges of their polygon.

    `track_index` (n,) has the polygon of each m / n neighbouring points.
    """
    inside = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        road = track_index[i * len(track_index) // len(points)]
        px, py = points[i, 0], points[i, 1]
        band = (py - b.low_y[road]) / b.band_m[road]
        # The top edge can round into the band above the last; nan falls through both comparisons.
        if 0.0 <= band < b.bands[road] + 1:
            k = b.at[road] + min(int(band), b.bands[road] - 1)
            odd = False
            for j in range(b.first[k], b.first[k + 1]):
                if (
                    b.edge[j, 0] <= py < b.edge[j, 1]
                    and px < b.edge[j, 2] + (py - b.edge[j, 0]) * b.edge[j, 3]
                ):
                    odd = not odd
            inside[i] = odd
    return inside
