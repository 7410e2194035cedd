"""The two lanes of courses, in which boxes stand and bots drive, and to which cars are put back."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import segments
from .segments import Segments, build_segments
from .track import Pose, Track, TrackIndex

INNER, OUTER = 0, 1
"""Numbers of the lanes: beside the inner and beside the outer border."""
_CELL_M = 0.01
"""Length of a cell of a `Paths`: between its ends a straight line is less than 0.2 mm off a smooth spline."""
_TIE_M, _NEARBY_M = 1e-3, 1.0
"""Distances that count as equal, and largest shift along the lap of the projection of a lane's point."""

Floats = NDArray[np.float64]


class Paths(NamedTuple):
    """The paths of bots along both lanes of one or more courses, sampled for look-up (arrays for compiled code).

    Course w has `cells[w]` cells; their ends are rows `first_row[w]` to `first_row[w] + cells[w]` of each lane.
    """

    rows: Floats
    """(2, R, 6): x and y in metres, their derivatives by the distance along the centre line, the distance of the
    projection on the centre line less the distance itself, and the offset to the left of it, in metres."""
    first_row: NDArray[np.int64]
    cells: NDArray[np.int64]
    length_m: Floats
    """Length of each course's centre line, in metres."""


class Lanes:
    """Both lanes of several courses.

    A lane runs halfway between the centre line and a border, waypoint by waypoint (deepracer-simapp,
    track_geom/track_data.py).
    """

    def __init__(self, tracks: Sequence[Track]):
        """Set up the lanes of the courses; the index of a course is its index in `tracks`."""
        self._tracks = tracks
        of_tracks = [_lines(track) for track in tracks]
        self._lines: Segments = segments.join_segments(
            [lines[lane] for lane in (INNER, OUTER) for lines in of_tracks]
        )

    def poses(self, points: Floats, lane: NDArray[np.int64], track_index: TrackIndex) -> Pose:
        """Return the poses on the lanes that are nearest to points, facing along the lane's segment; (n,) each.

        `lane` is `INNER` or `OUTER` and `track_index` the course of each point, (n,); points are in metres, (n, 2).
        """
        line = track_index + len(self._tracks) * lane
        projection = segments.project(self._lines, line, np.ascontiguousarray(points))
        x, y = projection[5].T
        return Pose(x, y, projection[6])

    def paths(self) -> Paths:
        """Return the paths of bots on closed courses.

        A path is a periodic cubic spline through the lane's points over the distances of their projections on the
        centre line (deepracer-simapp, track_geom/spline/track_spline.py).
        """
        of_tracks = [_path_rows(track) for track in self._tracks]
        rows = [[paths[lane] for paths in of_tracks] for lane in (INNER, OUTER)]
        cells = [len(path) - 1 for path in rows[INNER]]
        sizes = np.array(cells) + 1
        return Paths(
            np.stack([np.concatenate(lane) for lane in rows]),
            np.cumsum(sizes) - sizes,
            np.array(cells),
            np.array([track.length_m for track in self._tracks]),
        )


def _points(track: Track) -> tuple[Floats, Floats]:
    """Return the points of the inner and of the outer lane of a course, (n, 2) each."""
    return (track.waypoints + track.inner) / 2, (track.waypoints + track.outer) / 2


# Both lanes of a course take 20 ms, and a validation among others asks for them a hundred times.
_once = lru_cache(maxsize=256)


@_once
def _lines(track: Track) -> tuple[Segments, Segments]:
    """Return both lanes of a course."""
    inner, outer = _points(track)
    return build_segments(inner), build_segments(outer)


@_once
def _path_rows(track: Track) -> tuple[Floats, Floats]:
    """Return the rows of `Paths` for both lanes of a course."""
    inner, outer = _points(track)
    cells = math.ceil(track.length_m / _CELL_M)
    return _path(track, inner, cells), _path(track, outer, cells)


def _path(track: Track, points: Floats, cells: int) -> Floats:
    """Return the rows of `Paths` for one lane of a course, (cells + 1, 6)."""
    from scipy.interpolate import splev, splprep  # takes a quarter of a second, and few races have bots

    length_m = track.length_m
    knots_m, first = np.unique(_knots_m(track, points), return_index=True)
    spline, _ = splprep(points[first].T, u=knots_m, k=3, s=0, per=1)
    distance_m = np.linspace(0.0, length_m, cells + 1)
    within_m = knots_m[0] + np.mod(distance_m - knots_m[0], length_m)
    x, y = splev(within_m, spline)
    dx, dy = splev(within_m, spline, der=1)
    projection = track.project(np.stack([x, y], axis=-1))
    ahead_m = projection.distance_m - distance_m
    ahead_m -= length_m * np.round(ahead_m / length_m)
    return np.stack([x, y, dx, dy, ahead_m, projection.offset_m], axis=-1)


def _knots_m(track: Track, points: Floats) -> Floats:
    """Return the distances along the centre line of a lane's points, (n,), for a closed course.

    On the inside of a bend a point is as near to the segment before a waypoint as to the one after it, up to rounding,
    and their projections lie up to 15 cm apart. The service takes whichever is nearer; here it is the middle between
    them.
    """
    begin, end = track.waypoints[:-1], track.waypoints[1:]
    step, length_m = end - begin, np.linalg.norm(end - begin, axis=1)
    start_m = np.concatenate([[0.0], np.cumsum(length_m)])
    share = np.clip(((points[:, None] - begin) * step).sum(axis=2) / np.maximum(length_m**2, 1e-12), 0.0, 1.0)
    away_m = np.linalg.norm(points[:, None] - begin - share[..., None] * step, axis=2)
    total_m = start_m[-1]
    beyond_m = start_m[:-1] + share * length_m - start_m[:, None]
    beyond_m = np.mod(beyond_m + 0.5 * total_m, total_m) - 0.5 * total_m
    nearest = (away_m <= away_m.min(axis=1, keepdims=True) + _TIE_M) & (np.abs(beyond_m) < _NEARBY_M)
    # Where no segment close by is nearest, the waypoint's own distance.
    shift_m = np.where(nearest, beyond_m, 0.0).sum(axis=1) / np.maximum(nearest.sum(axis=1), 1)
    knots_m: Floats = start_m + shift_m
    knots_m[-1] = knots_m[0] + total_m
    return np.asarray(np.maximum.accumulate(knots_m))
