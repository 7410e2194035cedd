"""Courses: centre line, borders, and positions relative to them; one course, or several as one batch."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from deepracer_exp.aws.worlds.catalogue import find_world, worlds
from deepracer_exp.aws.worlds.routes import checked_rows, read_knots, read_route, rows_from_knots, world_rows
from deepracer_exp.config.driving import FloorConfig, TrackConfig
from deepracer_exp.errors import BadInput, naming

from . import segments
from .segments import Bands, Segments, build_bands, build_segments

PLAIN_FLOOR = FloorConfig(friction=1.0, road_color="#3d4148", ground_color="#54795a", line_color="#f2f2ee")
"""The default floor."""
MOST_OFF = 0.05
"""Share of waypoints that may lie off the road before the borders count as wrong."""
_GRID_M = 1e-6
"""Points of a course nearer to each other count as one when it is checked for crossings."""
_FOLD_M = 0.1
"""Longest loop in a centre line that counts as rounding; the world of 2019 has one of 4 mm."""
_FIRST = np.zeros(1, np.intp)

TrackIndex = NDArray[np.intp]
"""Indices of courses, (n,); of (m, ...) points, m / n neighbouring ones belong to each."""


class Projection(NamedTuple):
    """Points projected on the centre line; every array has one entry per point."""

    ndist: np.ndarray
    """Share of the course from waypoint 0 to the projection, 0 to 1."""
    distance_m: np.ndarray
    """Position along the centre line in metres."""
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
    """Points relative to the borders."""

    track_width_m: np.ndarray
    is_left: np.ndarray
    """Whether the point is left of the centre, as the service decides it (bool)."""


class Pose(NamedTuple):
    """Poses on the course; x and y in metres."""

    x: np.ndarray
    y: np.ndarray
    yaw_rad: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """An immutable course; build one with `from_route`, `from_file` or `from_config`.

    Geometry follows deepracer-simapp (track_geom/track_data.py): projections are those of shapely, the
    road is the outer border's polygon minus the inner one's.
    """

    name: str
    title: str
    closed: bool
    reversed: bool
    """Whether the course is driven against the order of its rows."""
    is_clockwise: bool
    """Whether the ring is driven clockwise; an open course counts as counter-clockwise in row order."""
    waypoints: np.ndarray
    """Centre points (n, 2) in driving direction, the closing point repeated on a closed course."""
    inner: np.ndarray
    """Inner border (n, 2), one point for each waypoint."""
    outer: np.ndarray
    length_m: float
    width_m: float
    """Median distance between the borders."""
    width_min_m: float
    width_max_m: float
    floor: FloorConfig
    road: BaseGeometry = field(repr=False)
    """The road's polygon (shapely)."""
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
            title: Title for display; the world name when missing.
            reversed: Drive against the order of the rows.
            floor: Grip, lines and colours of the track.

        Raises:
            BadInput: The rows do not form a course.
        """
        rows = checked_rows(rows)
        closed = bool((rows[0] == rows[-1]).all())
        _check_crossings(rows[:, :2])
        road = _road_area(rows[:, :2], rows[:, 2:4], rows[:, 4:], closed)
        counter_clockwise = not closed or bool(shapely.is_ccw(shapely.LinearRing(rows[:, :2])))
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
            length_m=float(center_line.vertices["start_m"][-1]),
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
    def from_file(cls, path: Path, reversed: bool = False, floor: FloorConfig = PLAIN_FLOOR) -> "Track":
        """Build the course of a route file (.npy) or of a YAML of knots.

        Raises:
            BadInput: The file does not form a course; the message names it.
        """
        title = None
        if path.suffix == ".npy":
            rows = read_route(path)
        elif path.suffix in (".yaml", ".yml"):
            course = read_knots(path)
            title = course.title
            with naming(path):
                rows = rows_from_knots(course.knots, course.width_m, course.closed)
        else:
            raise BadInput(path, f"ending {path.suffix!r}", ".npy (route) and .yaml (knots)")
        with naming(path):
            return cls.from_route(rows, path.stem, title=title, reversed=reversed, floor=floor)

    @classmethod
    def from_config(cls, config: TrackConfig, reversed: bool | None = None) -> "Track":
        """Build the course of an experiment: a world of the service, a file, or knots.

        Driven against the order of the rows if `reversed`; None: as in the first episode by `config.direction`.

        Raises:
            BadInput: The file or the knots do not form a course; the message names the file or the track.
        """
        backwards = config.direction == "reversed" if reversed is None else reversed
        if config.file is not None:
            with naming("track.file"):
                return cls.from_file(Path(config.file), backwards, config.floor)
        with naming(f"track {config.name}"):
            if config.knots is None or config.width_m is None:
                rows = world_rows(config.name)
            else:
                rows = rows_from_knots(config.knots, config.width_m, config.closed)
            return cls.from_route(
                rows, config.name, title=config.title, reversed=backwards, floor=config.floor
            )

    @cached_property
    def _alone(self) -> "Tracks":
        return Tracks([self])

    @property
    def geometry(self) -> segments.Geometry:
        """Return the lines and the road as arrays for compiled code, with this course as number 0."""
        return segments.Geometry(self._center_line, self._inner_line, self._outer_line, self._bands)

    def project(self, points: np.ndarray) -> Projection:
        """Project points (n, 2) on the centre line.

        `ndist` equals shapely's normalised projection; `previous` and `next` are the two sides of
        `bisect_right` of it in the waypoints' own positions, wrapping at the ends as the service does
        (next = 0 after the last waypoint).
        """
        return self._alone.project(points, _FIRST)

    def follow(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return `ndist`, `offset_m` and `heading_rad` of `project` for driven points, (n,) each, as rows (3, n).

        Of a million points the others alone would be 80 MB that are never read.
        """
        return np.asarray(segments.follow(self._center_line, _line(x), _line(y)))

    def border_distances(self, points: np.ndarray, center: np.ndarray) -> Borders:
        """Return the road's width at projected points and the side the points are on.

        Points and their projections (from `project`) are (n, 2), in metres. The nearest point of each border is the one
        nearest to the projection, not to the point itself.
        """
        return self._alone.border_distances(points, center, _FIRST)

    def on_road(self, points: np.ndarray) -> np.ndarray:
        """Return whether points (m, 2) are inside the road (bool)."""
        return self._alone.on_road(points, _FIRST)

    def points_at(self, ndist: np.ndarray) -> np.ndarray:
        """Return the centre-line points (..., 2) at normalised distances of any shape.

        Distances wrap on a closed course and stop at the ends of an open one.
        """
        return self._alone.points_at(ndist, _FIRST)

    def start_pose(self, ndist: np.ndarray) -> Pose:
        """Return poses on the centre line that face the next waypoint; arrays shaped as `ndist`."""
        return self._alone.start_pose(ndist, _FIRST)


@cache
def world_track(name: str, reversed: bool = False) -> Track:
    """Return a world's course on a plain floor.

    The name is its own in any case of letters, or its official one.

    Raises:
        BadInput: there is no such world.
    """
    world = find_world(name) or name
    return Track.from_route(world_rows(world), world, title=worlds()[world].title, reversed=reversed)


class Tracks:
    """Several courses as one batch; every query names the course of each point.

    Results are those of the course's own `Track`, bit for bit.

    Attributes:
        length_m: length of each course, (W,).
        closed: whether each course is closed, (W,), bool.
        clockwise: whether each course is driven clockwise, (W,), bool.
        lines: the centre lines, the inner and the outer borders, for compiled code.
        road: the roads, for compiled code.
        waypoints: those of all courses, (P, 2), and where each course's begin among them, (W,).
    """

    def __init__(self, tracks: Sequence[Track]):
        """Join courses; the index of a course is its index in `tracks`."""
        self.length_m = np.array([track.length_m for track in tracks])
        self.closed = np.array([track.closed for track in tracks])
        self.clockwise = np.array([track.is_clockwise for track in tracks])
        self.waypoints = (
            np.concatenate([track.waypoints for track in tracks]),
            np.cumsum([0, *(len(track.waypoints) for track in tracks[:-1])]),
        )
        self.lines = (
            segments.join_segments([track._center_line for track in tracks]),
            segments.join_segments([track._inner_line for track in tracks]),
            segments.join_segments([track._outer_line for track in tracks]),
        )
        self.road = segments.join_bands([track._bands for track in tracks])

    def project(self, points: np.ndarray, track_index: TrackIndex) -> Projection:
        """Project points (m, 2) on the centre lines, as `Track.project` does."""
        return Projection(*segments.project(self.lines[0], track_index, _points(points)))

    def border_distances(self, points: np.ndarray, center: np.ndarray, track_index: TrackIndex) -> Borders:
        """Return width and side as `Track.border_distances` does, (m,) each, for points and centres (m, 2)."""
        _, *borders = self.lines
        return Borders(
            *segments.border_distances(
                *borders, track_index, _points(points), _points(center), self.clockwise
            )
        )

    def on_road(self, points: np.ndarray, track_index: TrackIndex) -> np.ndarray:
        """Return whether points (m, 2) are inside the road of their course (bool)."""
        return segments.on_road(self.road, track_index, _points(points))

    def points_at(self, ndist: np.ndarray, track_index: TrackIndex) -> np.ndarray:
        """Return the centre-line points (..., 2) at normalised distances, as `Track.points_at` does."""
        ndist = np.asarray(ndist, np.float64)
        x, y, _ = segments.poses_at(self.lines[0], self.closed, track_index, ndist.ravel())
        return np.stack([x, y], axis=-1).reshape(*ndist.shape, 2)

    def start_pose(self, ndist: np.ndarray, track_index: TrackIndex) -> Pose:
        """Return poses on the centre lines as `Track.start_pose` does; arrays shaped as `ndist`."""
        ndist = np.asarray(ndist, np.float64)
        pose = segments.poses_at(self.lines[0], self.closed, track_index, ndist.ravel())
        return Pose(*(part.reshape(ndist.shape) for part in pose))


def _line(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float64)


def _points(points: np.ndarray) -> np.ndarray:
    points = np.ascontiguousarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points have shape {points.shape}, not (n, 2)")
    return points


def directed_tracks(config: TrackConfig) -> tuple[Track, ...]:
    """Build a track in each direction in which it is driven, the one of the first episode first."""
    directions = {"forward": (False,), "reversed": (True,), "alternate": (False, True)}[config.direction]
    return tuple(Track.from_config(config, backwards) for backwards in directions)


def _frozen(array: np.ndarray) -> np.ndarray:
    array = np.array(array, order="C")
    array.flags.writeable = False
    return array


def _check_crossings(center: np.ndarray) -> None:
    """Refuse a centre line (n, 2) that crosses or touches itself: a position there has two values of progress."""
    line = shapely.LineString(center)
    pieces = shapely.get_parts(shapely.line_merge(shapely.unary_union(line, grid_size=_GRID_M)))
    longest = pieces[shapely.length(pieces).argmax()]
    if line.length - longest.length > _FOLD_M:
        # Of an open line one end of a piece may be an end of the line.
        x, y = max(
            (longest.coords[0], longest.coords[-1]),
            key=lambda place: np.linalg.norm(center[[0, -1]] - place, axis=1).min(),
        )
        raise BadInput(
            f"the centre line crosses itself at ({x:.2f}, {y:.2f}); accepted is one that passes each place once"
        )


def _road_area(center: np.ndarray, inner: np.ndarray, outer: np.ndarray, closed: bool) -> BaseGeometry:
    """Return the road between two borders as AWS builds it (deepracer-simapp, track_geom).

    A closed course is the outer ring minus the inner one; an open one is the ring of the outer border
    followed by the inner one backwards.
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
    """Return the polygons that a border encloses, without lines and points at which the border touches itself."""
    polygon = shapely.Polygon(ring)
    if polygon.is_valid:
        return polygon
    parts = shapely.get_parts(
        shapely.get_parts(shapely.make_valid(polygon))
    )  # of a collection of collections
    return shapely.multipolygons(parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON])
