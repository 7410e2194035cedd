"""Several courses in one structure, so that one call answers for cars on all of them."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .road import join_bands, on_road
from .segments import along, join_segments, nearest_segment

if TYPE_CHECKING:
    from .track import Track

Which = NDArray[np.intp]
"""Number of a course in (n,); of (m, ...) places, m / n that follow one another are on each."""


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


class Tracks:
    """The courses' geometry side by side; what is asked says which course it is asked of.

    An answer is that of the course's own `Track`, bit for bit.

    Attributes:
        length_m: of each course, (W,).
        closed: likewise, bool.
    """

    def __init__(self, tracks: Sequence["Track"]):
        """Put the courses side by side; their numbers are their places in `tracks`."""
        self.length_m = np.array([track.length_m for track in tracks])
        self.closed = np.array([track.closed for track in tracks])
        self._clockwise = np.array([track.is_clockwise for track in tracks])
        self._waypoints = np.concatenate([track.waypoints for track in tracks])
        self._waypoint_at = np.cumsum([0, *(len(track.waypoints) for track in tracks[:-1])])
        self._center_line = join_segments([track._center_line for track in tracks])
        self._inner_line = join_segments([track._inner_line for track in tracks])
        self._outer_line = join_segments([track._outer_line for track in tracks])
        self._bands = join_bands([track._bands for track in tracks])

    def project(self, points: np.ndarray, which: Which) -> Projection:
        """Project points (m, 2) on the centre lines, as `Track.project` does."""
        return Projection(*_project(self._center_line, which, _points(points)))

    def border_distances(self, points: np.ndarray, center: np.ndarray, which: Which) -> Borders:
        """Return width and side as `Track.border_distances` does, all (m, 2)."""
        borders = self._inner_line, self._outer_line
        return Borders(*_borders(*borders, which, _points(points), _points(center), self._clockwise))

    def on_road(self, points: np.ndarray, which: Which) -> np.ndarray:
        """Tell for points (m, 2) whether they are inside the road of their course (bool)."""
        return on_road(self._bands, which, _points(points))

    def points_at(self, ndist: np.ndarray, which: Which) -> np.ndarray:
        """Return the centre-line points (..., 2) at normalised distances, as `Track.points_at` does."""
        ndist = np.asarray(ndist, np.float64)
        x, y, _ = _at(self._center_line, self.closed, which, ndist.ravel())
        return np.stack([x, y], axis=-1).reshape(*ndist.shape, 2)

    def start_pose(self, ndist: np.ndarray, which: Which) -> Pose:
        """Return poses on the centre lines as `Track.start_pose` does; arrays shaped as `ndist`."""
        ndist = np.asarray(ndist, np.float64)
        pose = _at(self._center_line, self.closed, which, ndist.ravel())
        return Pose(*(part.reshape(ndist.shape) for part in pose))

    def waypoints(self, index: np.ndarray, which: Which) -> np.ndarray:
        """Return the waypoints (n, k, 2) of the indices (n, k) on the courses (n,)."""
        return self._waypoints[self._waypoint_at[which][:, None] + index]


def _points(points: np.ndarray) -> np.ndarray:
    points = np.ascontiguousarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points have shape {points.shape}, not (n, 2)")
    return points


@njit(cache=True, nogil=True)
def _project(s, which, points):  # type: ignore[no-untyped-def]
    count = len(points)
    ndist, distance_m, offset_m = np.empty(count), np.empty(count), np.empty(count)
    previous, following = np.empty(count, np.int64), np.empty(count, np.int64)
    center, heading_rad = np.empty((count, 2)), np.empty(count)
    for i in range(count):
        line = which[i * len(which) // count]
        begin, end = s.at[line], s.at[line] + s.segments[line] + 1
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
def _borders(inner, outer, which, points, center, is_clockwise):  # type: ignore[no-untyped-def]
    count = len(points)
    width_m, is_left = np.empty(count), np.empty(count, np.bool_)
    for i in range(count):
        line = which[i * len(which) // count]
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
def _at(s, closed, which, ndist):  # type: ignore[no-untyped-def]
    count = len(ndist)
    x, y, heading_rad = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        line = which[i * len(which) // count]
        begin, last = s.at[line], s.at[line] + s.segments[line] - 1
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
