"""Exact queries on polylines and polygons at a cost that does not grow with their length or number.

A uniform grid stores for each cell every segment that can be nearest to some point of the cell. Let c be
the cell's centre and h its half diagonal: no point of the cell is farther than h from c, so the nearest
segment of any point p of the cell lies within d(c) + 2 h of c, where d(c) is the distance from c to the
polyline. The stored set is therefore a superset of the answers, and testing it alone is exact. The edges of polygons
are sorted into horizontal bands, and a point is tested against those of its own band.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from numba import njit
from shapely.geometry.base import BaseGeometry

from deepracer_exp.aws.worlds.routes import is_first_of_equals

CELL_M = 0.1
"""Side of a grid cell; doubled until the grid has at most `MOST_CELLS`."""
MOST_CELLS = 400_000
MARGIN_M = 1.0
"""Metres that the grid reaches beyond the polyline; points farther out are answered by a full scan."""
SPLIT = 8
"""Fine cells to the side of a coarse one, which narrows the search while the grid is built."""
BAND_M = 0.1
"""Height of the y bands that edges are sorted into; grown until there are at most `MOST_BANDS`."""
MOST_BANDS = 10_000


class Segments(NamedTuple):
    """One or more polylines, each with its grid (arrays for compiled code).

    Line w has `segments[w]` segments, rows `at[w]` to `at[w] + segments[w] - 1`, and one vertex more. Arrays of
    segments have an unused last row for each line, so that row numbers are the same in all arrays.
    """

    x: np.ndarray
    """Vertices in metres."""
    y: np.ndarray
    length_m: np.ndarray
    """Length of each segment."""
    start_m: np.ndarray
    """Distance of each vertex from its line's first along the line."""
    share: np.ndarray
    """Position along the line as a share of its whole length, 0 to 1."""
    heading_rad: np.ndarray
    """Direction of each segment."""
    point: np.ndarray
    """Index of each vertex among the line's points; of repeated points, the first."""
    points: np.ndarray
    """Number of points of each line, repeats included."""
    first_row: np.ndarray
    segments: np.ndarray
    total_m: np.ndarray
    bucket: np.ndarray
    """Row of the segment at the start of each of equal shares of the line, so that a look-up needs no search."""
    bucket_at: np.ndarray
    buckets: np.ndarray
    low_x: np.ndarray
    low_y: np.ndarray
    cell_m: np.ndarray
    columns: np.ndarray
    rows: np.ndarray
    cell_at: np.ndarray
    first: np.ndarray
    """Candidates of cell k of line w are `member[first[c]:first[c + 1]]` with c = `cell_at[w] + k`, ascending."""
    member: np.ndarray
    """Rows of segments."""


def build_segments(vertices: np.ndarray) -> Segments:
    """Index a polyline.

    `vertices` are points (n + 1, 2) in metres; the first is repeated at the end of a closed line. Points that repeat
    the one before make no segment; `Segments.point` keeps their numbers.
    """
    point = np.flatnonzero(is_first_of_equals(vertices))
    x, y = np.ascontiguousarray(vertices[point].T)
    dx, dy = np.diff(x), np.diff(y)
    # sqrt of the sum of squares, as GEOS measures, so that sums agree to the last bit.
    length_m = np.sqrt(dx * dx + dy * dy)
    start_m = np.r_[0.0, np.cumsum(length_m)]
    share = start_m / start_m[-1]
    bucket = np.searchsorted(share, np.arange(2 * len(share)) / (2 * len(share)), side="right") - 1
    low_x, low_y = float(x.min()) - MARGIN_M, float(y.min()) - MARGIN_M
    width_m, height_m = x.max() + MARGIN_M - low_x, y.max() + MARGIN_M - low_y
    cell_m = CELL_M
    while width_m * height_m > MOST_CELLS * cell_m**2:
        cell_m *= 2
    columns, rows = math.ceil(width_m / cell_m), math.ceil(height_m / cell_m)
    every = np.arange(len(length_m), dtype=np.int32)
    columns_c, rows_c = -(-columns // SPLIT), -(-rows // SPLIT)
    whole = (np.array([0, len(every)]), every, 1, SPLIT * max(columns, rows))
    coarse = _candidates(x, y, low_x, low_y, cell_m * SPLIT, columns_c, rows_c, *whole)
    first, member = _candidates(x, y, low_x, low_y, cell_m, columns, rows, *coarse, columns_c, SPLIT)
    beyond = [0.0]
    return Segments(
        x=x,
        y=y,
        length_m=np.r_[length_m, beyond],
        start_m=start_m,
        share=share,
        heading_rad=np.r_[np.arctan2(dy, dx), beyond],
        point=point,
        points=np.array([len(vertices)]),
        first_row=np.array([0]),
        segments=np.array([len(length_m)]),
        total_m=start_m[-1:],
        bucket=bucket,
        bucket_at=np.array([0]),
        buckets=np.array([len(bucket)]),
        low_x=np.array([low_x]),
        low_y=np.array([low_y]),
        cell_m=np.array([cell_m]),
        columns=np.array([columns]),
        rows=np.array([rows]),
        cell_at=np.array([0]),
        first=first,
        member=member,
    )


def join_segments(lines: Sequence[Segments]) -> Segments:
    """Join polylines in their order."""
    moved = {
        "first_row": "x",
        "bucket": "x",
        "bucket_at": "bucket",
        "cell_at": "first",
        "first": "member",
        "member": "x",
    }
    return _joined(lines, moved)


class Bands(NamedTuple):
    """The edges of one or more polygons, sorted by y band.

    Band k of polygon w has the rows `first[b]:first[b + 1]` of `edge` with b = `first_row[w] + k`.
    """

    low_y: np.ndarray
    band_m: np.ndarray
    bands: np.ndarray
    first_row: np.ndarray
    first: np.ndarray
    edge: np.ndarray
    """(entries, 4): lower y, upper y, x at the lower end, dx / dy."""


class Geometry(NamedTuple):
    """Centre line, borders and road of the same courses."""

    center: Segments
    inner: Segments
    outer: Segments
    road: Bands


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
        first_row=np.array([0]),
        first=first,
        edge=np.ascontiguousarray(edges[index]),
    )


def join_bands(roads: Sequence[Bands]) -> Bands:
    """Join polygons in their order."""
    return _joined(roads, {"first_row": "first", "first": "edge"})


def _joined(parts: Sequence[Any], moved: Mapping[str, str]) -> Any:
    """Join arrays field by field; those of `moved` hold rows of another field, which follow those of earlier parts."""
    if len(parts) == 1:
        return parts[0]
    fields: dict[str, list[np.ndarray]] = {
        name: [getattr(part, name) for part in parts] for name in parts[0]._fields
    }
    for name, other in moved.items():
        begin = np.cumsum([0, *map(len, fields[other][:-1])])
        fields[name] = [a + by.astype(a.dtype) for a, by in zip(fields[name], begin, strict=True)]
    return type(parts[0])(**{name: np.concatenate(arrays) for name, arrays in fields.items()})


@njit(cache=True, nogil=True)
def squared_distance(x, y, index, px, py):  # type: ignore[no-untyped-def]
    """Return the squared distance from (px, py) to segment `index` and the fraction along it."""
    ax, ay = x[index], y[index]
    dx, dy = x[index + 1] - ax, y[index + 1] - ay
    length2 = dx * dx + dy * dy
    fraction = ((px - ax) * dx + (py - ay) * dy) / length2
    # At an end the vertex itself is measured: both neighbours then tie exactly and the first one wins,
    # which is what GEOS does.
    if fraction <= 0.0:
        return (px - ax) ** 2 + (py - ay) ** 2, 0.0
    if fraction >= 1.0:
        return (px - x[index + 1]) ** 2 + (py - y[index + 1]) ** 2, 1.0
    cross = (px - ax) * dy - (py - ay) * dx
    return cross * cross / length2, fraction


@njit(cache=True, nogil=True)
def _candidates(  # type: ignore[no-untyped-def]
    x, y, low_x, low_y, cell_m, columns, rows, parent_first, parent_member, parent_columns, split
):
    reach = math.sqrt(2.0) * cell_m + 1e-9
    first = np.zeros(columns * rows + 1, np.int64)
    member = np.empty(4 * columns * rows + len(x), np.int32)
    distance = np.empty(len(x))
    used = 0
    for row in range(rows):
        for column in range(columns):
            px, py = low_x + (column + 0.5) * cell_m, low_y + (row + 0.5) * cell_m
            parent = (row // split) * parent_columns + column // split
            begin, end = parent_first[parent], parent_first[parent + 1]
            nearest = np.inf
            for k in range(begin, end):
                d = math.sqrt(squared_distance(x, y, parent_member[k], px, py)[0])
                distance[k - begin] = d
                nearest = min(nearest, d)
            for k in range(begin, end):
                if distance[k - begin] <= nearest + reach:
                    if used == len(member):
                        longer = np.empty(2 * used, np.int32)
                        longer[:used] = member
                        member = longer
                    member[used] = parent_member[k]
                    used += 1
            first[row * columns + column + 1] = used
    return first, member[:used].copy()


@njit(cache=True, nogil=True)
def nearest_segment(s, line, px, py):  # type: ignore[no-untyped-def]
    """Return the row of the line's segment nearest to (px, py) and the fraction along it (nan for a nan point)."""
    column = (px - s.low_x[line]) / s.cell_m[line]
    row = (py - s.low_y[line]) / s.cell_m[line]
    best, nearest, fraction = np.inf, s.first_row[line], np.nan
    if 0.0 <= column < s.columns[line] and 0.0 <= row < s.rows[line]:
        cell = s.cell_at[line] + int(row) * s.columns[line] + int(column)
        for k in range(s.first[cell], s.first[cell + 1]):
            index = s.member[k]
            d, f = squared_distance(s.x, s.y, index, px, py)
            if d < best:
                best, nearest, fraction = d, index, f
    else:
        for index in range(s.first_row[line], s.first_row[line] + s.segments[line]):
            d, f = squared_distance(s.x, s.y, index, px, py)
            if d < best:
                best, nearest, fraction = d, index, f
    return nearest, fraction


@njit(cache=True, nogil=True)
def along(s, index, fraction):  # type: ignore[no-untyped-def]
    """Return the point at `fraction` of the segment in row `index`."""
    if fraction >= 1.0:
        return s.x[index + 1], s.y[index + 1]
    x, y = s.x[index], s.y[index]
    return x + fraction * (s.x[index + 1] - x), y + fraction * (s.y[index + 1] - y)


@njit(cache=True, nogil=True)
def project(s, track_index, points):  # type: ignore[no-untyped-def]
    """Project points (m, 2) on the lines `track_index` (n,), m / n neighbouring points each; see `Tracks.project`."""
    count = len(points)
    ndist, distance_m, offset_m = np.empty(count), np.empty(count), np.empty(count)
    previous, following = np.empty(count, np.int64), np.empty(count, np.int64)
    center, heading_rad = np.empty((count, 2)), np.empty(count)
    for i in range(count):
        line = track_index[i * len(track_index) // count]
        begin, end = s.first_row[line], s.first_row[line] + s.segments[line] + 1
        px, py = points[i, 0], points[i, 1]
        index, fraction = nearest_segment(s, line, px, py)
        x, y = along(s, index, fraction)
        center[i, 0], center[i, 1] = x, y
        distance_m[i] = s.start_m[index] + fraction * s.length_m[index]
        ndist[i] = distance_m[i] / s.total_m[line]
        heading_rad[i] = s.heading_rad[index]
        off_m = math.sqrt((px - x) ** 2 + (py - y) ** 2)
        dx, dy = s.x[index + 1] - s.x[index], s.y[index + 1] - s.y[index]
        offset_m[i] = off_m if dx * (py - s.y[index]) - dy * (px - s.x[index]) >= 0.0 else -off_m
        # bisect_right from close by: rounding or a projection on a vertex moves it by one at most.
        ahead = index
        while ahead < end and s.share[ahead] <= ndist[i]:
            ahead += 1
        while ahead > begin and s.share[ahead - 1] > ndist[i]:
            ahead -= 1
        following[i] = s.point[ahead] if ahead < end else 0
        previous[i] = (following[i] if begin < ahead < end else s.points[line]) - 1
    return ndist, distance_m, offset_m, previous, following, center, heading_rad


@njit(cache=True, nogil=True)
def border_distances(inner, outer, track_index, points, center, is_clockwise):  # type: ignore[no-untyped-def]
    """Return the road's width at projected points and whether the points are left of its centre."""
    count = len(points)
    width_m, is_left = np.empty(count), np.empty(count, np.bool_)
    for i in range(count):
        line = track_index[i * len(track_index) // count]
        index, fraction = nearest_segment(inner, line, center[i, 0], center[i, 1])
        inner_x, inner_y = along(inner, index, fraction)
        index, fraction = nearest_segment(outer, line, center[i, 0], center[i, 1])
        outer_x, outer_y = along(outer, index, fraction)
        px, py = points[i, 0], points[i, 1]
        width_m[i] = math.sqrt((inner_x - outer_x) ** 2 + (inner_y - outer_y) ** 2)
        to_inner = math.sqrt((px - inner_x) ** 2 + (py - inner_y) ** 2)
        to_outer = math.sqrt((px - outer_x) ** 2 + (py - outer_y) ** 2)
        is_left[i] = (to_inner < to_outer) != is_clockwise[line]
    return width_m, is_left


@njit(cache=True, nogil=True)
def poses_at(s, closed, track_index, ndist):  # type: ignore[no-untyped-def]
    """Return x, y and heading of the lines at normalised distances."""
    count = len(ndist)
    x, y, heading_rad = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        line = track_index[i * len(track_index) // count]
        begin, last = s.first_row[line], s.first_row[line] + s.segments[line] - 1
        share = ndist[i] - math.floor(ndist[i]) if closed[line] else min(max(ndist[i], 0.0), 1.0)
        if math.isfinite(share):
            buckets = s.buckets[line]
            index = s.bucket[s.bucket_at[line] + min(int(share * buckets), buckets - 1)]
            while index < last and s.share[index + 1] <= share:
                index += 1
            while index > begin and s.share[index] > share:
                index -= 1
            fraction = (share * s.total_m[line] - s.start_m[index]) / s.length_m[index]
            x[i], y[i] = along(s, index, fraction)
            heading_rad[i] = s.heading_rad[index]
        else:
            x[i], y[i], heading_rad[i] = np.nan, np.nan, np.nan
    return x, y, heading_rad


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
            k = b.first_row[road] + min(int(band), b.bands[road] - 1)
            odd = False
            for j in range(b.first[k], b.first[k + 1]):
                if (
                    b.edge[j, 0] <= py < b.edge[j, 1]
                    and px < b.edge[j, 2] + (py - b.edge[j, 0]) * b.edge[j, 3]
                ):
                    odd = not odd
            inside[i] = odd
    return inside
