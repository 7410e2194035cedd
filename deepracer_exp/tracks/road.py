"""The road: its rows along knots, its area, and the exact test whether a point lies on it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numba import njit
from numpy.typing import ArrayLike
from shapely.geometry.base import BaseGeometry

from deepracer_exp.errors import BadInput

BAND_M = 0.1
"""Height of the y bands that edges are sorted into; grown until there are at most `MOST_BANDS`."""
MOST_BANDS = 10_000
MOST_OFF = 0.05
"""Share of waypoints that may lie off the road before the borders count as wrong."""
SPACING_M = 0.15
"""Distance between two rows, as in AWS's worlds of 2018 and 2019."""
MOST_ROWS = 4000
"""Rows a course has at most; a course longer than 600 m gets them farther apart."""
LONGEST_FOLD = 8.0
"""Length of a border's fold, in road widths, up to which it counts as the inside of a tight bend."""


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


def rows_from_knots(knots: ArrayLike, width_m: ArrayLike, closed: bool) -> np.ndarray:
    """Return route rows along a cubic spline through knots.

    The spline is periodic on a closed course and natural on an open one. It is parametrised by the
    square root of the chord (centripetal): for evenly spaced knots that is the knot's number, and a
    spline through knots set by hand does not overshoot.

    Args:
        knots: Points (k, 2) in metres; the first is not repeated at the end of a closed course.
        width_m: Distance between the borders in metres: one value or (k,).
        closed: Whether the last knot joins the first.

    Returns:
        Rows (n, 6) float64 about 0.15 m apart. The inner border is the one inside the ring; on an open
        course it is the left one.

    Raises:
        BadInput: Too few knots, repeated knots, another number of widths than of knots, or a road so
            wide that its border crosses itself.
    """
    from scipy.interpolate import CubicSpline  # takes half a second, and few tracks have knots

    knots, width_m = np.asarray(knots, np.float64).reshape(-1, 2), np.atleast_1d(width_m)
    _check(knots, width_m, closed)
    width_m = np.broadcast_to(width_m, len(knots))
    if closed:
        knots, width_m = np.concatenate([knots, knots[:1]]), np.r_[width_m, width_m[:1]]
    chord_m = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    at = np.r_[0.0, np.cumsum(np.sqrt(chord_m))]
    spline = CubicSpline(at, np.column_stack([knots, width_m]), bc_type="periodic" if closed else "natural")

    fine = np.linspace(0.0, at[-1], 100 * len(knots) + 1)
    step_m = np.linalg.norm(np.diff(spline(fine)[:, :2], axis=0), axis=1)
    distance_m = np.r_[0.0, np.cumsum(step_m)]
    rows = min(max(8, round(distance_m[-1] / SPACING_M)), MOST_ROWS)
    at_rows = np.interp(np.linspace(0.0, distance_m[-1], rows + 1), distance_m, fine)

    center, half_m = spline(at_rows)[:, :2], spline(at_rows)[:, 2:] / 2
    if half_m.min() <= 0:
        raise BadInput("width_m falls to 0 between two knots; accepted are widths that change more gently")
    tangent = spline(at_rows, 1)[:, :2]
    left = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1, keepdims=True)
    if closed:
        center[-1], left[-1], half_m[-1] = center[0], left[0], half_m[0]
        if _signed_area(center) < 0:
            left = -left
    longest_m = LONGEST_FOLD * 2 * float(half_m.max())
    inner = unfold(center + half_m * left, longest_m, closed)
    outer = unfold(center - half_m * left, longest_m, closed)
    return np.column_stack([center, inner, outer])


def unfold(border: np.ndarray, longest_m: float, closed: bool) -> np.ndarray:
    """Return a border whose folds are pulled together into the point where they cross.

    A border on the inside of a bend tighter than half the road's width runs backwards for a while and
    crosses itself; what lies between the two passages of the crossing is road.

    Args:
        border: Points (n, 2); on a closed course the last equals the first.
        longest_m: Longest fold that is pulled together.
        closed: Whether the border is a ring.

    Raises:
        BadInput: A crossing that is no such fold.
    """
    border = border.copy()
    last = len(border) - 1
    begin = 0
    while (crossing := _first_crossing(border, closed, begin)) is not None:
        i, j, point = crossing
        begin = i
        step_m = np.linalg.norm(np.diff(border, axis=0), axis=1)
        between_m = step_m[i:j].sum()
        if between_m <= longest_m:
            border[i + 1 : j + 1] = point
        elif closed and step_m.sum() - between_m <= longest_m:
            border[j + 1 :] = point
            border[: i + 1] = point
            begin = 0
        else:
            x, y = point
            raise BadInput(
                f"a border crosses itself at ({x:.2f}, {y:.2f}); accepted is a road narrower than the "
                "space between its stretches"
            )
        if closed:
            border[last] = border[0]
    return border


def _first_crossing(border: np.ndarray, closed: bool, begin: int) -> tuple[int, int, np.ndarray] | None:
    """Return the first pair of segments from `begin` on that cross inside both, and where they cross."""
    a, d = border[:-1], np.diff(border, axis=0)
    count = len(a)
    for i in range(begin, count - 2):
        j = np.arange(i + 2, count - 1 if closed and i == 0 else count)
        gap = a[j] - a[i]
        turn = d[i, 0] * d[j, 1] - d[i, 1] * d[j, 0]
        with np.errstate(divide="ignore", invalid="ignore"):  # parallel segments give nan and do not cross
            on_i = (gap[:, 0] * d[j, 1] - gap[:, 1] * d[j, 0]) / turn
            on_j = (gap[:, 0] * d[i, 1] - gap[:, 1] * d[i, 0]) / turn
        # 1e-9 keeps a pair that meets in a fold already pulled together from counting again.
        hits = j[(on_i > 1e-9) & (on_i < 1 - 1e-9) & (on_j > 1e-9) & (on_j < 1 - 1e-9)]
        if len(hits):
            hit = int(hits[-1])
            return i, hit, a[i] + on_i[hit - i - 2] * d[i]
    return None


def _check(knots: np.ndarray, width_m: np.ndarray, closed: bool) -> None:
    needed = 4 if closed else 3
    if len(knots) < needed:
        kind = "a closed" if closed else "an open"
        raise BadInput(f"{len(knots)} knots; accepted are at least {needed} for {kind} course")
    if len(width_m) not in (1, len(knots)):
        raise BadInput(
            f"width_m has {len(width_m)} values for {len(knots)} knots; accepted is 1 or one per knot"
        )
    if closed and (knots[0] == knots[-1]).all():
        raise BadInput("the last knot repeats the first; accepted is a closed course without that knot")
    repeated = np.flatnonzero((np.diff(knots, axis=0) == 0).all(axis=1))
    if len(repeated):
        raise BadInput(f"knots[{repeated[0] + 1}] repeats the knot before it; accepted are distinct knots")


def _signed_area(ring: np.ndarray) -> float:
    x, y = ring.T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) / 2)
