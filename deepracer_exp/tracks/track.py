"""The course a car drives on: centre line, borders, and where a point lies between them."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numba import njit
from shapely.geometry.base import BaseGeometry

from deepracer_exp.config.track import FloorConfig, TrackConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.routes import checked_rows, read_knots, read_route

from .road import Bands, build_bands, on_road, road_area
from .segments import Segments, along, build_segments, nearest_segment
from .spline import rows_from_knots

PLAIN_FLOOR = FloorConfig(friction=1.0, road_color="#3d4148", ground_color="#54795a", line_color="#f2f2ee")
"""The floor of a course whose file says nothing about it."""


class Projection(NamedTuple):
    """Points projected on the centre line; every array has one entry a point."""

    ndist: np.ndarray
    """Share of the course from waypoint 0 to the projection, 0 to 1."""
    distance_m: np.ndarray
    """The same in metres."""
    offset_m: np.ndarray
    """Distance from the centre line, positive on the left of the driving direction."""
    previous: np.ndarray
    """Index of the waypoint behind (int64)."""
    next: np.ndarray
    """Index of the waypoint ahead (int64)."""
    center: np.ndarray
    """The projected points (n, 2)."""
    heading_rad: np.ndarray
    """Direction of the centre line's segment there."""


class Borders(NamedTuple):
    """What the borders say about points."""

    track_width_m: np.ndarray
    is_left: np.ndarray
    """Whether the point is left of the centre, in the service's sense (bool)."""


class Pose(NamedTuple):
    """Places on the course to start from."""

    x: np.ndarray
    y: np.ndarray
    yaw_rad: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """An immutable course; build one with `from_route`, `from_knots` or `from_config`.

    Geometry follows deepracer-simapp (track_geom/track_data.py): projections are those of shapely, the
    road is the outer border's polygon minus the inner one's.
    """

    name: str
    title: str
    closed: bool
    reversed: bool
    """The direction setting: the course is driven against the order of its rows."""
    is_clockwise: bool
    """Whether the ring is driven clockwise; an open course counts as counter-clockwise in row order."""
    waypoints: np.ndarray
    """Centre points (n, 2) in driving direction, the closing point repeated on a closed course."""
    inner: np.ndarray
    """Inner border (n, 2), row by row beside the waypoints."""
    outer: np.ndarray
    length_m: float
    width_m: float
    """Median distance between the borders."""
    width_min_m: float
    width_max_m: float
    floor: FloorConfig
    road: BaseGeometry = field(repr=False)
    """The road's polygon (shapely), for drawing and for obstacles."""
    _center_line: Segments = field(repr=False)
    _inner_line: Segments = field(repr=False)
    _outer_line: Segments = field(repr=False)
    _bands: Bands = field(repr=False)

    @classmethod
    def from_route(
        cls,
        rows: np.ndarray,
        name: str,
        *,
        title: str | None = None,
        reversed: bool = False,
        floor: FloorConfig = PLAIN_FLOOR,
    ) -> "Track":
        """Build a course from route rows.

        Args:
            rows: (n, 6): centre x, y, inner x, y, outer x, y in metres; closed if and only if the first
                row equals the last.
            name: World name.
            title: Name for people; the world name when missing.
            reversed: Drive against the order of the rows.
            floor: What the road is made of.

        Raises:
            BadInput: The rows make no course.
        """
        rows = checked_rows(rows)
        closed = bool((rows[0] == rows[-1]).all())
        road = road_area(rows[:, :2], rows[:, 2:4], rows[:, 4:], closed)
        counter_clockwise = not closed or _is_counter_clockwise(rows[:, :2])
        if reversed:
            rows = rows[::-1]
        waypoints, inner, outer = (_frozen(rows[:, k : k + 2]) for k in (0, 2, 4))
        widths_m = np.linalg.norm(outer - inner, axis=1)
        center_line = build_segments(waypoints)
        return cls(
            name=name,
            title=title or name,
            closed=closed,
            reversed=reversed,
            is_clockwise=counter_clockwise == reversed,
            waypoints=waypoints,
            inner=inner,
            outer=outer,
            length_m=float(center_line.start_m[-1]),
            width_m=float(np.median(widths_m)),
            width_min_m=float(widths_m.min()),
            width_max_m=float(widths_m.max()),
            floor=floor,
            road=road,
            _center_line=center_line,
            _inner_line=build_segments(inner),
            _outer_line=build_segments(outer),
            _bands=build_bands(road),
        )

    @classmethod
    def from_knots(
        cls,
        knots: np.ndarray,
        width_m: float | np.ndarray,
        closed: bool,
        name: str,
        *,
        title: str | None = None,
        reversed: bool = False,
        floor: FloorConfig = PLAIN_FLOOR,
    ) -> "Track":
        """Build a course from spline knots (k, 2) in metres and one width or one per knot.

        Raises:
            BadInput: The knots make no course, or the road is too wide for its bends.
        """
        knots, widths_m = np.asarray(knots, np.float64), np.atleast_1d(np.asarray(width_m, np.float64))
        rows = rows_from_knots(knots, widths_m, closed)
        return cls.from_route(rows, name, title=title, reversed=reversed, floor=floor)

    @classmethod
    def from_config(cls, config: TrackConfig) -> "Track":
        """Build the course an experiment names; `config.file` takes the place of its knots.

        Raises:
            BadInput: The file or the knots make no course; the message names the file or the track.
        """
        backwards = config.direction == "reversed"
        if config.file is not None:
            with _blaming("track.file"):
                return _from_file(Path(config.file), backwards, config.floor)
        with _blaming(f"track {config.name}"):
            return cls.from_knots(
                np.array(config.knots, np.float64).reshape(-1, 2),
                np.array(config.width_m, np.float64),
                config.closed,
                config.name,
                title=config.title,
                reversed=backwards,
                floor=config.floor,
            )

    def project(self, points: np.ndarray) -> Projection:
        """Project points (n, 2) on the centre line.

        `ndist` equals shapely's normalised projection; `previous` and `next` are the two sides of
        `bisect_right` of it in the waypoints' own positions, wrapping at the ends as the service does
        (next = 0 after the last waypoint).
        """
        return Projection(*_project(self._center_line, _points(points)))

    def border_distances(self, points: np.ndarray, center: np.ndarray) -> Borders:
        """Return the road's width at projected points and the side the points are on.

        Args:
            points: (n, 2) in metres.
            center: Their projections (n, 2), from `project`. The nearest point of each border is the one
                nearest to the projection, not to the point itself.
        """
        points, center = _points(points), _points(center)
        return Borders(*_borders(self._inner_line, self._outer_line, points, center, self.is_clockwise))

    def on_road(self, points: np.ndarray) -> np.ndarray:
        """Tell for points (m, 2) whether they are inside the road (bool)."""
        return on_road(self._bands, _points(points))

    def points_at(self, ndist: np.ndarray) -> np.ndarray:
        """Return the centre-line points (..., 2) at normalised distances of any shape.

        Distances wrap on a closed course and stop at the ends of an open one.
        """
        ndist = np.asarray(ndist, np.float64)
        x, y, _ = _at(self._center_line, self.closed, ndist.ravel())
        return np.stack([x, y], axis=-1).reshape(*ndist.shape, 2)

    def start_pose(self, ndist: np.ndarray) -> Pose:
        """Return poses on the centre line that look at the next waypoint; arrays shaped as `ndist`."""
        ndist = np.asarray(ndist, np.float64)
        pose = _at(self._center_line, self.closed, ndist.ravel())
        return Pose(*(part.reshape(ndist.shape) for part in pose))


def _from_file(path: Path, backwards: bool, floor: FloorConfig) -> Track:
    title = None
    if path.suffix == ".npy":
        rows = read_route(path)
    elif path.suffix in (".yaml", ".yml"):
        course = read_knots(path)
        title = course.title
        with _blaming(path):
            rows = rows_from_knots(course.knots, course.width_m, course.closed)
    else:
        raise BadInput(
            f"{path}: its name ends in {path.suffix!r}; accepted are .npy (route) and .yaml (knots)"
        )
    with _blaming(path):
        return Track.from_route(rows, path.stem, title=title, reversed=backwards, floor=floor)


@contextmanager
def _blaming(what: object) -> Iterator[None]:
    """Put the name of what was wrong before the message."""
    try:
        yield
    except BadInput as error:
        raise BadInput(f"{what}: {error}") from None


def _points(points: np.ndarray) -> np.ndarray:
    points = np.ascontiguousarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points have shape {points.shape}, not (n, 2)")
    return points


def _frozen(array: np.ndarray) -> np.ndarray:
    array = np.array(array, order="C")
    array.flags.writeable = False
    return array


def _is_counter_clockwise(ring: np.ndarray) -> bool:
    return bool(shapely.is_ccw(shapely.LinearRing(ring)))


@njit(cache=True, nogil=True)
def _project(s, points):  # type: ignore[no-untyped-def]
    count = len(points)
    ndist, distance_m, offset_m = np.empty(count), np.empty(count), np.empty(count)
    previous, following = np.empty(count, np.int64), np.empty(count, np.int64)
    center, heading_rad = np.empty((count, 2)), np.empty(count)
    vertices = len(s.share)
    for i in range(count):
        px, py = points[i, 0], points[i, 1]
        index, fraction = nearest_segment(s, px, py)
        x, y = along(s, index, fraction)
        center[i, 0], center[i, 1] = x, y
        distance_m[i] = s.start_m[index] + fraction * s.length_m[index]
        ndist[i] = distance_m[i] / s.start_m[-1]
        heading_rad[i] = s.heading_rad[index]
        off_m = math.sqrt((px - x) ** 2 + (py - y) ** 2)
        dx, dy = s.x[index + 1] - s.x[index], s.y[index + 1] - s.y[index]
        offset_m[i] = off_m if dx * (py - s.y[index]) - dy * (px - s.x[index]) >= 0.0 else -off_m
        # bisect_right from close by: rounding or a projection on a vertex moves it by one at most.
        ahead = index
        while ahead < vertices and s.share[ahead] <= ndist[i]:
            ahead += 1
        while ahead > 0 and s.share[ahead - 1] > ndist[i]:
            ahead -= 1
        previous[i] = ahead - 1 if ahead > 0 else vertices - 1
        following[i] = ahead if ahead < vertices else 0
    return ndist, distance_m, offset_m, previous, following, center, heading_rad


@njit(cache=True, nogil=True)
def _borders(inner, outer, points, center, is_clockwise):  # type: ignore[no-untyped-def]
    count = len(points)
    width_m, is_left = np.empty(count), np.empty(count, np.bool_)
    for i in range(count):
        index, fraction = nearest_segment(inner, center[i, 0], center[i, 1])
        inner_x, inner_y = along(inner, index, fraction)
        index, fraction = nearest_segment(outer, center[i, 0], center[i, 1])
        outer_x, outer_y = along(outer, index, fraction)
        px, py = points[i, 0], points[i, 1]
        width_m[i] = math.sqrt((inner_x - outer_x) ** 2 + (inner_y - outer_y) ** 2)
        to_inner = math.sqrt((px - inner_x) ** 2 + (py - inner_y) ** 2)
        to_outer = math.sqrt((px - outer_x) ** 2 + (py - outer_y) ** 2)
        is_left[i] = (to_inner < to_outer) != is_clockwise
    return width_m, is_left


@njit(cache=True, nogil=True)
def _at(s, closed, ndist):  # type: ignore[no-untyped-def]
    count = len(ndist)
    x, y, heading_rad = np.empty(count), np.empty(count), np.empty(count)
    last = len(s.length_m) - 1
    for i in range(count):
        share = ndist[i] - math.floor(ndist[i]) if closed else min(max(ndist[i], 0.0), 1.0)
        if math.isfinite(share):
            index = s.bucket[min(int(share * len(s.bucket)), len(s.bucket) - 1)]
            while index < last and s.share[index + 1] <= share:
                index += 1
            while index > 0 and s.share[index] > share:
                index -= 1
            fraction = (share * s.start_m[-1] - s.start_m[index]) / s.length_m[index]
            x[i], y[i] = along(s, index, fraction)
            heading_rad[i] = s.heading_rad[index]
        else:
            x[i], y[i], heading_rad[i] = np.nan, np.nan, np.nan
    return x, y, heading_rad
