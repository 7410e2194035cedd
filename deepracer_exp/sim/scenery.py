"""The scenery of a track: outlines of its road, lines and walls, and boxes that stand on the floor.

Sizes are those of the service's worlds (deepracer-simapp, `bundle/meshes`).
"""

import math
from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from deepracer_exp.tracks.outline import rings_of
from deepracer_exp.tracks.track import Track

LINE_WIDTH_M = 0.0762
"""Width of the edge lines; where they lie inside the road, its border is their outer edge."""
DASH_WIDTH_M = 0.0254
"""Width of the dashed centre line."""
KERB_WIDTH_M, KERB_LENGTH_M, KERB_GAP_M = 0.0762, 0.185, 0.185
"""Size of the coloured parts of kerbs, which lie beyond edge lines; the gaps are white as the lines."""
START_AHEAD_M, START_LENGTH_M, START_WIDTH_M = 0.13, 0.0733, 0.914
"""Distance of the start line's middle from the first waypoint, and its size along and across the road."""
START_CHECKS = (2, 8)
"""Light and dark fields of the start line, along and across the road."""
FIELD_M = 20.0
"""Width of the field drawn around a track without walls, in metres."""

MATERIALS = (
    "sky",
    "field",
    "road",
    "line",
    "dash",
    "far_dash",
    "wall_low_x",
    "wall_low_y",
    "kerb",
    "far_kerb",
    "start",
    "far_start",
    "wall_high_x",
    "wall_high_y",
)
"""Parts that have a colour of their own: `far_dash` is the centre line where dashes run together, and so on;
`wall_low_x` is the wall of a rectangle at the lowest x, `start` the start line's dark fields. A barrier that follows
the road is all `wall_low_x`."""
SKY, FIELD, ROAD, LINE, DASH, FAR_DASH, WALL_LOW_X, WALL_LOW_Y, *_REST = range(len(MATERIALS))
KERB, FAR_KERB, START, FAR_START, WALL_HIGH_X, WALL_HIGH_Y = _REST

DASHES_UNTIL_M = 2.0
"""Distance from which dashes run together: a row of the picture sees more than one of them."""

CURVES_UNTIL_M, COARSE_M = 4.0, 0.004
"""Beyond the first, outlines are drawn with fewer points, off by the second at most: an eighth of a pixel."""

PIECE = np.dtype(
    [
        ("first", "i4"),
        ("last", "i4"),
        ("inside", "i4"),
        ("outside", "i4"),
        # A circle around the points; cameras draw them from `near_m` to `far_m` from its middle.
        ("middle_m", "f4", 2),
        ("radius_m", "f4"),
        ("near_m", "f4"),
        ("far_m", "f4"),
    ]
)
"""Some consecutive points of an outline, with the materials to its left (`inside`) and right, seen from above."""


class Scenery(NamedTuple):
    """The outlines of one or more tracks.

    Attributes:
        points_m: (P, 3), float32.
        joined: whether a line leads from the point before to this one, (P,).
        pieces: `PIECE` records.
        first_piece: index of each track's first piece, then the number of all pieces, (tracks + 1,).
    """

    points_m: NDArray[np.float32]
    joined: NDArray[np.bool_]
    pieces: NDArray[np.void]
    first_piece: NDArray[np.int64]


def build_scenery(track: Track) -> Scenery:
    """Build the outlines of a track."""
    floor, road = track.floor, track.road
    drawing = _Drawing()
    ring = wall_ring(track)
    if ring is None:
        low_x, low_y, high_x, high_y = road.bounds
        (field,) = rings_of(shapely.box(low_x - FIELD_M, low_y - FIELD_M, high_x + FIELD_M, high_y + FIELD_M))
        drawing.add(([field], FIELD, SKY))
    else:
        for (ax, ay), (bx, by) in pairwise(ring):
            wall = wall_material(track, ring, (ax, ay), (bx, by))
            z = floor.walls_height_m
            # Counter-clockwise in the picture of a camera between the walls.
            drawing.add(([np.array([[ax, ay, 0], [ax, ay, z], [bx, by, z], [bx, by, 0]])], wall, SKY))
            drawing.add(([np.array([[bx, by, 0], [ax, ay, 0]])], wall, FIELD))
    plain = road
    if floor.lines_inside:
        borders = [shapely.LineString(line).buffer(LINE_WIDTH_M) for line in (track.inner, track.outer)]
        plain = road.difference(shapely.union_all(borders))
    for area, inside, outside in ((paved_area(track), LINE, FIELD), (plain, ROAD, LINE)):
        for ring in rings_of(area):
            for first in range(0, len(ring) - 1, _PIECE_LINES):
                some = ring[first : first + _PIECE_LINES + 1]
                coarse = shapely.get_coordinates(shapely.LineString(some).simplify(COARSE_M))
                drawing.add_levels(CURVES_UNTIL_M, [([some], inside, outside)], [([coarse], inside, outside)])
    # In the published direction: what lies on the floor does not depend on how the track is driven.
    center = track.waypoints[::-1] if track.reversed else track.waypoints
    dashes = list(_dashes(center, DASH_WIDTH_M, floor.dash_length_m, floor.dash_gap_m))
    runs = [dashes]
    if floor.start_line_color is not None:
        start, dark = _start_line(center, plain)
        rings = rings_of(start)
        if rings:  # not on a road that is narrower than its lines
            drawing.add_levels(
                CURVES_UNTIL_M,
                [(rings, LINE, ROAD), (rings_of(dark), START, LINE)],
                [(rings, FAR_START, ROAD)],
            )
        seen = groupby(dashes, lambda dash: not start.intersects(shapely.Polygon(dash)))
        runs = [list(run) for visible, run in seen if visible]
    for run in runs:
        drawing.add_dashes(run, DASH, FAR_DASH, ROAD)
    if floor.kerb_color is not None:
        for ring in rings_of(paved_area(track, KERB_WIDTH_M / 2)):
            stripes = list(_dashes(ring, KERB_WIDTH_M, KERB_LENGTH_M, KERB_GAP_M))
            drawing.add_dashes(stripes, KERB, FAR_KERB, LINE)
    return drawing.finish()


def wall_ring(track: Track) -> NDArray[np.float64] | None:
    """Return the foot of the walls around a track, counter-clockwise and closed, (n, 2); None: there are none."""
    beyond = track.floor.walls_beyond_m
    if beyond is None:
        return None
    low_x, low_y, high_x, high_y = track.road.bounds
    # Convex either way: no wall hides anything but what lies beyond the walls.
    around = (
        track.road.convex_hull.buffer(beyond).simplify(0.02)
        if track.floor.walls_follow_road
        else shapely.box(low_x - beyond, low_y - beyond, high_x + beyond, high_y + beyond)
    )
    (ring,) = rings_of(around)
    return ring


def wall_material(
    track: Track, ring: NDArray[np.float64], begin: Sequence[float], end: Sequence[float]
) -> int:
    """Return the material of the wall from `begin` to `end`, neighbours in the track's `wall_ring`, (n, 2)."""
    if track.floor.walls_follow_road:
        return WALL_LOW_X
    if begin[0] == end[0]:
        return WALL_LOW_X if begin[0] == ring[:, 0].min() else WALL_HIGH_X
    return WALL_LOW_Y if begin[1] == ring[:, 1].min() else WALL_HIGH_Y


def paved_area(track: Track, kerb_m: float = KERB_WIDTH_M) -> BaseGeometry:
    """Return the road with the lines and kerbs outside its border, kerbs up to the width `kerb_m`."""
    if track.floor.lines_inside and track.floor.kerb_color is None:
        return track.road
    beyond = 0.0 if track.floor.lines_inside else LINE_WIDTH_M
    return track.road.buffer(beyond + (kerb_m if track.floor.kerb_color is not None else 0.0))


def box_corners(boxes: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the floor corners of boxes, counter-clockwise, (..., 4, 2).

    The boxes are as `camera.take_pictures` has them: x, y, yaw, length, width, ..., (..., 5 or more).
    """
    cos, sin = np.cos(boxes[..., 2, None]), np.sin(boxes[..., 2, None])
    along = 0.5 * boxes[..., 3, None] * np.array([-1, 1, 1, -1])
    across = 0.5 * boxes[..., 4, None] * np.array([-1, -1, 1, 1])
    x = boxes[..., 0, None] + along * cos - across * sin
    y = boxes[..., 1, None] + along * sin + across * cos
    return np.stack([x, y], axis=-1)


def join_sceneries(sceneries: Sequence[Scenery]) -> Scenery:
    """Return several tracks' outlines as one; the index of a track is its index in the argument."""
    points = np.cumsum([0, *(len(scenery.points_m) for scenery in sceneries)])
    pieces = [scenery.pieces.copy() for scenery in sceneries]
    for some, first in zip(pieces, points, strict=False):
        some["first"] += first
        some["last"] += first
    return Scenery(
        np.concatenate([scenery.points_m for scenery in sceneries]),
        np.concatenate([scenery.joined for scenery in sceneries]),
        np.concatenate(pieces),
        np.cumsum([0, *(len(some) for some in pieces)]),
    )


_PIECE_LINES = 16

_Outline = tuple[Sequence[NDArray[np.float64]], int, int]
"""Lines of connected points, (n, 2) on the floor or (n, 3) each, and the materials to their left and right."""


class _Drawing:
    """Collects pieces."""

    def __init__(self) -> None:
        self._points: list[NDArray[np.float64]] = []
        self._joined: list[NDArray[np.bool_]] = []
        self._pieces: list[tuple[object, ...]] = []
        self._count = 0

    def add(self, outline: _Outline) -> None:
        """Add an outline that is drawn from every distance."""
        self._add(outline, self._circle([outline]), 0.0, math.inf)

    def add_levels(self, until_m: float, near: Sequence[_Outline], far: Sequence[_Outline]) -> None:
        """Add outlines that are drawn up to a distance, and others that take their place from there on.

        The distance of all of them is that of one circle: cameras draw either all of `near` or all of `far`.
        """
        circle = self._circle(near)
        for outline in near:
            self._add(outline, circle, 0.0, until_m)
        for outline in far:
            self._add(outline, circle, until_m, math.inf)

    def add_dashes(self, dashes: Sequence[NDArray[np.float64]], dash: int, far: int, under: int) -> None:
        """Add consecutive dashes, which run together from `DASHES_UNTIL_M` on."""
        for first in range(0, len(dashes), _PIECE_LINES):
            few = dashes[first : first + _PIECE_LINES]
            self.add_levels(DASHES_UNTIL_M, [(few, dash, under)], [([_strip(few)], far, under)])

    @staticmethod
    def _circle(outlines: Sequence[_Outline]) -> tuple[NDArray[np.float64], float]:
        """Return the middle and the radius of a circle around outlines."""
        points = np.concatenate([line[:, :2] for lines, _, _ in outlines for line in lines])
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        return middle, np.linalg.norm(points - middle, axis=1).max()

    def _add(
        self, outline: _Outline, circle: tuple[NDArray[np.float64], float], near_m: float, far_m: float
    ) -> None:
        lines, inside, outside = outline
        first = self._count
        for points in lines:
            points = points if points.shape[1] == 3 else np.column_stack([points, np.zeros(len(points))])
            self._points.append(points)
            self._joined.append(np.arange(len(points)) > 0)
            self._count += len(points)
        self._pieces.append((first, self._count, inside, outside, *circle, near_m, far_m))

    def finish(self) -> Scenery:
        return Scenery(
            np.concatenate(self._points).astype(np.float32),
            np.concatenate(self._joined),
            np.array(self._pieces, PIECE),
            np.array([0, len(self._pieces)]),
        )


def _dashes(
    center: NDArray[np.float64], width_m: float, length_m: float, gap_m: float
) -> Iterator[NDArray[np.float64]]:
    """Yield the outlines of a line's dashes, counter-clockwise, (5, 2)."""
    line = shapely.LineString(center)
    for start in np.arange(0, line.length - length_m, length_m + gap_m):
        (ax, ay), (bx, by) = shapely.get_coordinates(
            shapely.line_interpolate_point(line, [start, start + length_m])
        )
        length = math.hypot(bx - ax, by - ay)
        x, y = -0.5 * width_m * (by - ay) / length, 0.5 * width_m * (bx - ax) / length
        yield np.array(
            [[ax - x, ay - y], [bx - x, by - y], [bx + x, by + y], [ax + x, ay + y], [ax - x, ay - y]]
        )


def _start_line(center: NDArray[np.float64], road: BaseGeometry) -> tuple[BaseGeometry, BaseGeometry]:
    """Return the area of the start line and of its dark fields, as far as they lie on `road`."""
    ahead = (center[1] - center[0]) / np.linalg.norm(center[1] - center[0])
    left = np.array([-ahead[1], ahead[0]])
    along, across = START_CHECKS
    size = np.array([START_LENGTH_M / along, START_WIDTH_M / across])
    low = np.array([START_AHEAD_M - 0.5 * START_LENGTH_M, -0.5 * START_WIDTH_M])
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])

    def area(place: Sequence[float], size: NDArray[np.float64]) -> shapely.Polygon:
        return shapely.Polygon(center[0] + (low + (place + corners) * size) @ [ahead, left])

    dark = [area((i, j), size) for i in range(along) for j in range(i % 2, across, 2)]
    return (
        area((0, 0), size * START_CHECKS).intersection(road),
        shapely.multipolygons(dark).intersection(road),
    )


def _strip(dashes: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the outline of a line over dashes and the gaps between them."""
    right = np.concatenate([dash[:2] for dash in dashes])
    left = np.concatenate([dash[3:1:-1] for dash in dashes])
    return np.concatenate([right, left[::-1], right[:1]])
