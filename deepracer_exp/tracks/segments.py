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
from shapely.geometry.base import BaseGeometry

from deepracer_exp.aws.worlds.routes import is_first_of_equals
from deepracer_exp.jit import compiled, njit

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

# A query takes less time than passing all arrays to a function.
inlined = njit(cache=True, nogil=True, error_model="numpy", inline="always")


LINE = np.dtype(
    [
        ("first_row", "i8"),
        ("segments", "i8"),
        # Points of the line, repeats included.
        ("points", "i8"),
        ("total_m", "f8"),
        ("bucket_at", "i8"),
        ("buckets", "i8"),
        ("low_x", "f8"),
        ("low_y", "f8"),
        ("cell_m", "f8"),
        ("columns", "i8"),
        ("rows", "i8"),
        ("cell_at", "i8"),
    ]
)
"""A polyline: its vertices are rows `first_row` to `first_row + segments`, its grid `rows` x `columns` cells."""

VERTEX = np.dtype(
    [
        ("x", "f8"),
        ("y", "f8"),
        # Of the segment that begins here; 0 at the last vertex of a line.
        ("length_m", "f8"),
        # Distance from the line's first vertex along the line, and the same as a share of the whole length, 0 to 1.
        ("start_m", "f8"),
        ("share", "f8"),
        # Direction of the segment that begins here.
        ("heading_rad", "f8"),
        # Index among the line's points; of repeated points, the first.
        ("point", "i8"),
    ]
)
"""A vertex of a polyline, and the segment that begins there."""


class Segments(NamedTuple):
    """One or more polylines, each with its grid.

    Records, because compiled code passes each array by seven numbers, which takes longer than a query does.
    """

    lines: np.ndarray
    """`LINE` records."""
    vertices: np.ndarray
    """`VERTEX` records of all lines."""
    bucket: np.ndarray
    """Row of the segment at the start of each of equal shares of a line, so that a look-up needs no search."""
    first: np.ndarray
    """Candidates of cell k of a line are `member[first[c]:first[c + 1]]` with c = `cell_at + k`, ascending."""
    member: np.ndarray
    """Rows of vertices at which segments begin."""


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
    vertex = np.zeros(len(x), VERTEX)
    vertex["x"], vertex["y"], vertex["point"] = x, y, point
    vertex["start_m"], vertex["share"] = start_m, share
    vertex["length_m"][:-1], vertex["heading_rad"][:-1] = length_m, np.arctan2(dy, dx)
    every = np.arange(len(length_m))
    columns_c, rows_c = -(-columns // SPLIT), -(-rows // SPLIT)
    whole = _Cells(np.array([0, len(every)]), every, 1)
    grid = (low_x, low_y, cell_m * SPLIT, columns_c, rows_c)
    first, member = _candidates(vertex, grid, whole, SPLIT * max(columns, rows))
    coarse = _Cells(first, member, columns_c)
    first, member = _candidates(vertex, (low_x, low_y, cell_m, columns, rows), coarse, SPLIT)
    line = np.zeros(1, LINE)
    line["segments"], line["points"], line["total_m"] = len(length_m), len(vertices), start_m[-1]
    line["buckets"] = len(bucket)
    line["low_x"], line["low_y"], line["cell_m"] = low_x, low_y, cell_m
    line["columns"], line["rows"] = columns, rows
    return Segments(line, vertex, bucket, first, member)


def join_segments(lines: Sequence[Segments]) -> Segments:
    """Join polylines in their order."""
    moved = {
        "lines.first_row": "vertices",
        "bucket": "vertices",
        "lines.bucket_at": "bucket",
        "lines.cell_at": "first",
        "first": "member",
        "member": "vertices",
    }
    return _joined(lines, moved)


POLYGON = np.dtype([("low_y", "f8"), ("band_m", "f8"), ("bands", "i8"), ("first_row", "i8")])
"""The y bands of a polygon."""


class Bands(NamedTuple):
    """The edges of one or more polygons, sorted by y band.

    Band k of a polygon has the rows `first[b]:first[b + 1]` of `edge` with b = `first_row + k`.
    """

    polygons: np.ndarray
    """`POLYGON` records."""
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
    polygon = np.zeros(1, POLYGON)
    polygon["low_y"], polygon["band_m"], polygon["bands"] = low_y, band_m, bands
    return Bands(polygon, first, np.ascontiguousarray(edges[index]))


def join_bands(roads: Sequence[Bands]) -> Bands:
    """Join polygons in their order."""
    return _joined(roads, {"polygons.first_row": "first", "first": "edge"})


def _joined(parts: Sequence[Any], moved: Mapping[str, str]) -> Any:
    """Join arrays one by one.

    The arrays, or fields of arrays, that `moved` names hold rows of another array, which follow those of earlier parts.
    """
    if len(parts) == 1:
        return parts[0]
    arrays = {name: [getattr(part, name).copy() for part in parts] for name in parts[0]._fields}
    for name, other in moved.items():
        array, _, column = name.partition(".")
        begins = np.cumsum([0, *map(len, arrays[other][:-1])])
        for values, begin in zip(arrays[array], begins, strict=True):
            (values[column] if column else values)[:] += begin
    return type(parts[0])(**{name: np.concatenate(each) for name, each in arrays.items()})


@inlined
def squared_distance(a, b, px, py):  # type: ignore[no-untyped-def]
    """Return the squared distance from (px, py) to the segment between two `VERTEX` records and the fraction along it.

    All cases are computed and one is selected: branches would be mispredicted.
    """
    dx, dy = b.x - a.x, b.y - a.y
    length2 = dx * dx + dy * dy
    ax, ay, bx, by = px - a.x, py - a.y, px - b.x, py - b.y
    along_it, cross = ax * dx + ay * dy, ax * dy - ay * dx
    # At an end the vertex itself is measured: both neighbours then tie exactly and the first one wins,
    # which is what GEOS does.
    before, behind = along_it <= 0.0, along_it >= length2
    squared, fraction = cross * cross / length2, along_it / length2
    squared = ax * ax + ay * ay if before else squared
    squared = bx * bx + by * by if behind else squared
    fraction = 0.0 if before else fraction
    fraction = 1.0 if behind else fraction
    return squared, fraction


class _Cells(NamedTuple):
    """The candidates of a grid's cells, as in `Segments`."""

    first: np.ndarray
    member: np.ndarray
    columns: int


@compiled
def _candidates(vertices, grid, cells, split):  # type: ignore[no-untyped-def]
    """Return `first` and `member` of a grid's cells, whose candidates are among those of a cell `split` times as large.

    `grid` is the lowest x and y, the side of a cell, and the numbers of columns and rows.
    """
    low_x, low_y, cell_m, columns, rows = grid
    reach = math.sqrt(2.0) * cell_m + 1e-9
    first = np.zeros(columns * rows + 1, np.int64)
    member = np.empty(4 * columns * rows + len(vertices), np.int64)
    distance = np.empty(len(vertices))
    used = 0
    for row in range(rows):
        for column in range(columns):
            px, py = low_x + (column + 0.5) * cell_m, low_y + (row + 0.5) * cell_m
            parent = (row // split) * cells.columns + column // split
            begin, end = cells.first[parent], cells.first[parent + 1]
            nearest = np.inf
            for k in range(begin, end):
                row_k = cells.member[k]
                d = math.sqrt(squared_distance(vertices[row_k], vertices[row_k + 1], px, py)[0])
                distance[k - begin] = d
                nearest = min(nearest, d)
            for k in range(begin, end):
                if distance[k - begin] <= nearest + reach:
                    if used == len(member):
                        longer = np.empty(2 * used, np.int64)
                        longer[:used] = member
                        member = longer
                    member[used] = cells.member[k]
                    used += 1
            first[row * columns + column + 1] = used
    return first, member[:used].copy()


@inlined
def nearest_segment(s, number, px, py):  # type: ignore[no-untyped-def]
    """Return the row of the line's segment nearest to (px, py) and the fraction along it (nan for a nan point)."""
    line, vertices = s.lines[number], s.vertices
    column = (px - line.low_x) / line.cell_m
    row = (py - line.low_y) / line.cell_m
    in_grid = 0.0 <= column < line.columns and 0.0 <= row < line.rows
    if in_grid:
        cell = line.cell_at + int(row) * line.columns + int(column)
        begin, end = s.first[cell], s.first[cell + 1]
    else:
        begin, end = line.first_row, line.first_row + line.segments
    best, nearest, fraction = np.inf, line.first_row, np.nan
    for k in range(begin, end):
        index = s.member[k] if in_grid else k
        d, f = squared_distance(vertices[index], vertices[index + 1], px, py)
        if d < best:
            best, nearest, fraction = d, index, f
    return nearest, fraction


@inlined
def along(s, index, fraction):  # type: ignore[no-untyped-def]
    """Return the point at `fraction` of the segment in row `index`."""
    a, b = s.vertices[index], s.vertices[index + 1]
    if fraction >= 1.0:
        return b.x, b.y
    return a.x + fraction * (b.x - a.x), a.y + fraction * (b.y - a.y)


@inlined
def project_point(s, number, px, py):  # type: ignore[no-untyped-def]
    """Project (px, py) on a line.

    Returns:
        The values of a `track.Projection`; of `center`, x and y.
    """
    line, vertices = s.lines[number], s.vertices
    begin, end = line.first_row, line.first_row + line.segments + 1
    index, fraction = nearest_segment(s, number, px, py)
    x, y = along(s, index, fraction)
    a, b = vertices[index], vertices[index + 1]
    distance_m = a.start_m + fraction * a.length_m
    ndist = distance_m / line.total_m
    off_m = math.sqrt((px - x) ** 2 + (py - y) ** 2)
    offset_m = off_m if (b.x - a.x) * (py - a.y) - (b.y - a.y) * (px - a.x) >= 0.0 else -off_m
    # bisect_right from close by: rounding or a projection on a vertex moves it by one at most.
    ahead = index
    while ahead < end and vertices[ahead].share <= ndist:
        ahead += 1
    while ahead > begin and vertices[ahead - 1].share > ndist:
        ahead -= 1
    following = vertices[ahead].point if ahead < end else 0
    previous = (following if begin < ahead < end else line.points) - 1
    return ndist, distance_m, offset_m, previous, following, x, y, a.heading_rad


@compiled
def project(s, track_index, points):  # type: ignore[no-untyped-def]
    """Project points (m, 2) on the lines `track_index` (n,), m / n neighbouring points each; see `Tracks.project`."""
    count = len(points)
    ndist, distance_m, offset_m = np.empty(count), np.empty(count), np.empty(count)
    previous, following = np.empty(count, np.int64), np.empty(count, np.int64)
    center, heading_rad = np.empty((count, 2)), np.empty(count)
    for i in range(count):
        line = track_index[i * len(track_index) // count]
        (
            ndist[i],
            distance_m[i],
            offset_m[i],
            previous[i],
            following[i],
            center[i, 0],
            center[i, 1],
            heading_rad[i],
        ) = project_point(s, line, points[i, 0], points[i, 1])
    return ndist, distance_m, offset_m, previous, following, center, heading_rad


@compiled
def follow(s, x, y):  # type: ignore[no-untyped-def]
    """Return the rows of `Track.follow` of points (n,) and the first line, (3, n)."""
    out = np.empty((3, len(x)))
    for i in range(len(x)):
        out[0, i], _, out[1, i], _, _, _, _, out[2, i] = project_point(s, 0, x[i], y[i])
    return out


@inlined
def border_point(inner, outer, number, px, py, x, y, is_clockwise):  # type: ignore[no-untyped-def]
    """Return the road's width at the projection (x, y) of (px, py), and whether the point is left of its centre."""
    index, fraction = nearest_segment(inner, number, x, y)
    inner_x, inner_y = along(inner, index, fraction)
    index, fraction = nearest_segment(outer, number, x, y)
    outer_x, outer_y = along(outer, index, fraction)
    width_m = math.sqrt((inner_x - outer_x) ** 2 + (inner_y - outer_y) ** 2)
    to_inner = math.sqrt((px - inner_x) ** 2 + (py - inner_y) ** 2)
    to_outer = math.sqrt((px - outer_x) ** 2 + (py - outer_y) ** 2)
    return width_m, (to_inner < to_outer) != is_clockwise


@compiled
def border_distances(inner, outer, track_index, points, center, is_clockwise):  # type: ignore[no-untyped-def]
    """Return the road's width at projected points and whether the points are left of its centre."""
    count = len(points)
    width_m, is_left = np.empty(count), np.empty(count, np.bool_)
    for i in range(count):
        line = track_index[i * len(track_index) // count]
        px, py, x, y = points[i, 0], points[i, 1], center[i, 0], center[i, 1]
        width_m[i], is_left[i] = border_point(inner, outer, line, px, py, x, y, is_clockwise[line])
    return width_m, is_left


@inlined
def pose_at(s, closed, number, ndist):  # type: ignore[no-untyped-def]
    """Return x, y and heading of a line at a normalised distance, which wraps if it is closed."""
    line, vertices = s.lines[number], s.vertices
    begin, last = line.first_row, line.first_row + line.segments - 1
    share = ndist - math.floor(ndist) if closed else min(max(ndist, 0.0), 1.0)
    if not math.isfinite(share):
        return np.nan, np.nan, np.nan
    index = s.bucket[line.bucket_at + min(int(share * line.buckets), line.buckets - 1)]
    while index < last and vertices[index + 1].share <= share:
        index += 1
    while index > begin and vertices[index].share > share:
        index -= 1
    a = vertices[index]
    x, y = along(s, index, (share * line.total_m - a.start_m) / a.length_m)
    return x, y, a.heading_rad


@compiled
def poses_at(s, closed, track_index, ndist):  # type: ignore[no-untyped-def]
    """Return x, y and heading of the lines at normalised distances."""
    count = len(ndist)
    x, y, heading_rad = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        line = track_index[i * len(track_index) // count]
        x[i], y[i], heading_rad[i] = pose_at(s, closed[line], line, ndist[i])
    return x, y, heading_rad


@inlined
def is_on_road(b, number, px, py):  # type: ignore[no-untyped-def]
    """Return whether a ray to the right of (px, py) crosses an odd number of edges of a polygon."""
    polygon = b.polygons[number]
    band = (py - polygon.low_y) / polygon.band_m
    odd = False
    # The top edge can round into the band above the last; nan falls through both comparisons.
    if 0.0 <= band < polygon.bands + 1:
        k = polygon.first_row + min(int(band), polygon.bands - 1)
        for j in range(b.first[k], b.first[k + 1]):
            if b.edge[j, 0] <= py < b.edge[j, 1]:
                odd ^= px < b.edge[j, 2] + (py - b.edge[j, 0]) * b.edge[j, 3]
    return odd


@compiled
def on_road(b, track_index, points):  # type: ignore[no-untyped-def]
    """Return for points (m, 2) whether they are inside their polygon.

    `track_index` (n,) has the polygon of each m / n neighbouring points.
    """
    inside = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        road = track_index[i * len(track_index) // len(points)]
        inside[i] = is_on_road(b, road, points[i, 0], points[i, 1])
    return inside
