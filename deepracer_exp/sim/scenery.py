"""What there is to see around a track: outlines of its road, lines and walls.

Sizes are those of the service's worlds (deepracer-simapp, `bundle/meshes`).
"""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

LINE_WIDTH_M = 0.0762
"""Of the edge lines, which lie inside the road: its border is their outer edge."""
DASH_WIDTH_M, DASH_LENGTH_M, DASH_PITCH_M = 0.0254, 0.0508, 0.1016
"""Of the centre line."""
WALL_HEIGHT_M = 1.0
FIELD_M = 20.0
"""Of field around a track without walls."""

MATERIALS = ("sky", "field", "road", "line", "dash", "far_dash", "wall_x", "wall_y")
"""What has a colour of its own: `far_dash` is that of the centre line where dashes run together, `wall_x` that of the
walls that face along the x axis."""
SKY, FIELD, ROAD, LINE, DASH, FAR_DASH, WALL_X, WALL_Y = range(len(MATERIALS))

DASHES_UNTIL_M = 2.0
"""Distance from which dashes run together: a row of the picture sees more than one of them."""

CURVES_UNTIL_M, COARSE_M = 4.0, 0.004
"""Beyond this distance outlines are drawn with fewer points, which lie off by so much at most: an eighth of a pixel."""

PIECE = np.dtype(
    [
        ("first", "i4"),
        ("last", "i4"),
        ("inside", "i4"),
        ("outside", "i4"),
        # It is drawn by cameras that are so far from its middle.
        ("middle_m", "f4", 2),
        ("radius_m", "f4"),
        ("near_m", "f4"),
        ("far_m", "f4"),
    ]
)
"""Some consecutive points of an outline: the materials to its left (`inside`) and right seen from above."""


class Scenery(NamedTuple):
    """The outlines of one or more tracks.

    Attributes:
        points_m: (P, 3), float32.
        joined: whether a line leads from the point before to this one, (P,).
        pieces: `PIECE` records.
        first_piece: of each track, and the number of all pieces, (tracks + 1,).
    """

    points_m: NDArray[np.float32]
    joined: NDArray[np.bool_]
    pieces: NDArray[np.void]
    first_piece: NDArray[np.int64]


def build_scenery(
    center: NDArray[np.float64],
    borders: Sequence[NDArray[np.float64]],
    road: BaseGeometry,
    walls_beyond_m: float | None,
) -> Scenery:
    """Build the outlines of a track.

    Args:
        center: centre line in driving order, (n, 2), metres.
        borders: the lines along which the edge lines run, (n, 2) each.
        road: the road's area.
        walls_beyond_m: distance of the walls from the road's extreme coordinates; None: there are no walls.
    """
    lines = shapely.union_all([shapely.LineString(line).buffer(LINE_WIDTH_M) for line in borders])
    low_x, low_y, high_x, high_y = road.bounds
    beyond = FIELD_M if walls_beyond_m is None else walls_beyond_m
    field = shapely.box(low_x - beyond, low_y - beyond, high_x + beyond, high_y + beyond)
    drawing = _Drawing()
    (ring,) = _rings(field)
    if walls_beyond_m is None:
        drawing.add([ring], FIELD, SKY)
    else:
        for (ax, ay), (bx, by) in pairwise(ring):
            wall = WALL_X if ax == bx else WALL_Y
            z = WALL_HEIGHT_M
            # Counter-clockwise in the picture of a camera between the walls.
            drawing.add([np.array([[ax, ay, 0], [ax, ay, z], [bx, by, z], [bx, by, 0]])], wall, SKY)
            drawing.add([np.array([[bx, by, 0], [ax, ay, 0]])], wall, FIELD)
    for area, inside, outside in ((road, LINE, FIELD), (road.difference(lines), ROAD, LINE)):
        for ring in _rings(area):
            for first in range(0, len(ring) - 1, _PIECE_LINES):
                some = ring[first : first + _PIECE_LINES + 1]
                drawing.add([some], inside, outside, far_m=CURVES_UNTIL_M)
                coarse = shapely.get_coordinates(shapely.LineString(some).simplify(COARSE_M))
                drawing.add([coarse], inside, outside, near_m=CURVES_UNTIL_M)
    dashes = list(_dashes(center))
    for first in range(0, len(dashes), _PIECE_LINES):
        few = dashes[first : first + _PIECE_LINES]
        drawing.add(few, DASH, ROAD, far_m=DASHES_UNTIL_M)
        drawing.add([_strip(few)], FAR_DASH, ROAD, near_m=DASHES_UNTIL_M)
    return drawing.finish()


def join_sceneries(sceneries: Sequence[Scenery]) -> Scenery:
    """Return several tracks' outlines as one; the index of a track is its index in the argument."""
    points = np.cumsum([0, *(len(one.points_m) for one in sceneries)])
    pieces = [one.pieces.copy() for one in sceneries]
    for some, at in zip(pieces, points, strict=False):
        some["first"] += at
        some["last"] += at
    return Scenery(
        np.concatenate([one.points_m for one in sceneries]),
        np.concatenate([one.joined for one in sceneries]),
        np.concatenate(pieces),
        np.cumsum([0, *(len(some) for some in pieces)]),
    )


_PIECE_LINES = 16


class _Drawing:
    """Collects pieces."""

    def __init__(self) -> None:
        self._points: list[NDArray[np.float64]] = []
        self._joined: list[NDArray[np.bool_]] = []
        self._pieces: list[tuple[object, ...]] = []
        self._count = 0

    def add(
        self,
        outlines: Sequence[NDArray[np.float64]],
        inside: int,
        outside: int,
        near_m: float = 0.0,
        far_m: float = math.inf,
    ) -> None:
        """Add a piece of connected points, (n, 2) on the floor or (n, 3) each."""
        first = self._count
        for points in outlines:
            points = points if points.shape[1] == 3 else np.column_stack([points, np.zeros(len(points))])
            self._points.append(points)
            self._joined.append(np.arange(len(points)) > 0)
            self._count += len(points)
        all_points = np.concatenate(outlines)[:, :2]
        middle = 0.5 * (all_points.min(axis=0) + all_points.max(axis=0))
        radius = np.linalg.norm(all_points - middle, axis=1).max()
        self._pieces.append((first, self._count, inside, outside, middle, radius, near_m, far_m))

    def finish(self) -> Scenery:
        return Scenery(
            np.concatenate(self._points).astype(np.float32),
            np.concatenate(self._joined),
            np.array(self._pieces, PIECE),
            np.array([0, len(self._pieces)]),
        )


def _rings(area: BaseGeometry) -> Iterator[NDArray[np.float64]]:
    """Yield the outlines of an area, which has them on its left."""
    for polygon in shapely.get_parts(area):
        if isinstance(polygon, shapely.Polygon) and not polygon.is_empty:
            for ring in shapely.get_rings(shapely.orient_polygons(polygon)):
                yield shapely.get_coordinates(ring)


def _dashes(center: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield the dashes' outlines, counter-clockwise, (5, 2)."""
    line = shapely.LineString(center)
    for start in np.arange(0, line.length - DASH_LENGTH_M, DASH_PITCH_M):
        (ax, ay), (bx, by) = shapely.get_coordinates(
            shapely.line_interpolate_point(line, [start, start + DASH_LENGTH_M])
        )
        length = math.hypot(bx - ax, by - ay)
        x, y = -0.5 * DASH_WIDTH_M * (by - ay) / length, 0.5 * DASH_WIDTH_M * (bx - ax) / length
        yield np.array(
            [[ax - x, ay - y], [bx - x, by - y], [bx + x, by + y], [ax + x, ay + y], [ax - x, ay - y]]
        )


def _strip(dashes: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the outline of a line over dashes and the gaps between them."""
    right = np.concatenate([dash[:2] for dash in dashes])
    left = np.concatenate([dash[3:1:-1] for dash in dashes])
    return np.concatenate([right, left[::-1], right[:1]])
