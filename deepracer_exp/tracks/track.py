"""The course a car drives on: centre line, borders, and where a point lies between them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from deepracer_exp.config.track import FloorConfig, TrackConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.routes import checked_rows, read_knots, read_route, world_rows

from .road import Bands, build_bands, road_area
from .segments import Segments, build_segments
from .spline import rows_from_knots
from .tracks import Borders, Pose, Projection, Tracks

PLAIN_FLOOR = FloorConfig(friction=1.0, road_color="#3d4148", ground_color="#54795a", line_color="#f2f2ee")
"""The floor of a course whose file says nothing about it."""
_FIRST = np.zeros(1, np.intp)


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
    def from_config(cls, config: TrackConfig, reversed: bool | None = None) -> "Track":
        """Build the course an experiment names: a world of the service, or what its file or knots say.

        Args:
            config: What is driven on.
            reversed: Drive against the order of the rows; None: as `config.direction` says of the first episode.

        Raises:
            BadInput: The file or the knots make no course; the message names the file or the track.
        """
        backwards = config.direction == "reversed" if reversed is None else reversed
        if config.file is not None:
            with _blaming("track.file"):
                return _from_file(Path(config.file), backwards, config.floor)
        if config.knots is None:
            rows, title = world_rows(config.name), config.title
            return cls.from_route(rows, config.name, title=title, reversed=backwards, floor=config.floor)
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

    @cached_property
    def _alone(self) -> "Tracks":
        return Tracks([self])

    def project(self, points: np.ndarray) -> Projection:
        """Project points (n, 2) on the centre line.

        `ndist` equals shapely's normalised projection; `previous` and `next` are the two sides of
        `bisect_right` of it in the waypoints' own positions, wrapping at the ends as the service does
        (next = 0 after the last waypoint).
        """
        return self._alone.project(points, _FIRST)

    def border_distances(self, points: np.ndarray, center: np.ndarray) -> Borders:
        """Return the road's width at projected points and the side the points are on.

        Args:
            points: (n, 2) in metres.
            center: Their projections (n, 2), from `project`. The nearest point of each border is the one
                nearest to the projection, not to the point itself.
        """
        return self._alone.border_distances(points, center, _FIRST)

    def on_road(self, points: np.ndarray) -> np.ndarray:
        """Tell for points (m, 2) whether they are inside the road (bool)."""
        return self._alone.on_road(points, _FIRST)

    def points_at(self, ndist: np.ndarray) -> np.ndarray:
        """Return the centre-line points (..., 2) at normalised distances of any shape.

        Distances wrap on a closed course and stop at the ends of an open one.
        """
        return self._alone.points_at(ndist, _FIRST)

    def start_pose(self, ndist: np.ndarray) -> Pose:
        """Return poses on the centre line that look at the next waypoint; arrays shaped as `ndist`."""
        return self._alone.start_pose(ndist, _FIRST)


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


def _frozen(array: np.ndarray) -> np.ndarray:
    array = np.array(array, order="C")
    array.flags.writeable = False
    return array


def _is_counter_clockwise(ring: np.ndarray) -> bool:
    return bool(shapely.is_ccw(shapely.LinearRing(ring)))
