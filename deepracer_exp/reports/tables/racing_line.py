"""The racing line of a course: the line of minimum curvature between its borders, its steering and its speed."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from scipy.optimize import lsq_linear

from deepracer_exp.tracks.track import Track

from .statistics import Values

MARGIN_M = 0.1
"""Room between the line and a border: half a car's width, so that all wheels stay on the road."""
SAMPLE_M = 0.15
"""Distance of the line's points along the centre line, where the course is not longer than `MOST` of them."""
MOST = 200
"""Points of a line; the computing time grows with their cube."""
ROUNDS = 5
"""Damped rounds: each goes half of the way to its solution, so that the line does not oscillate; five go 97 %."""
WHEELBASE_M = 0.164
"""Wheelbase of every car of the service (deepracer-simapp urdf/deepracer)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """A line along a course, at evenly spaced places of the centre line."""

    lap_position: Values
    """Places (n,), 0 to 1; a closed course ends where it began."""
    offset_m: Values
    """Distance from the centre line, positive to the left of the driving direction."""
    xy: Values
    """(n, 2), m."""
    curvature_pm: Values
    """1/m, positive where the line turns left."""

    @property
    def steering_deg(self) -> Values:
        """Return the steering angle of a car that rolls along without slip (kinematic bicycle), left positive."""
        return np.degrees(np.arctan(WHEELBASE_M * self.curvature_pm))

    def speed_mps(self, lateral_mps2: float, top_mps: float) -> Values:
        """Return the speed that needs `lateral_mps2` of lateral acceleration, at most `top_mps`, braking ignored."""
        return np.minimum(top_mps, np.sqrt(lateral_mps2 / np.maximum(np.abs(self.curvature_pm), 1e-9)))

    def interpolate(self, lap_position: Values, values: Values) -> Values:
        """Return `values` of the line's points, interpolated at other places."""
        return np.interp(lap_position, self.lap_position, values)


def center_line(course: Track) -> Line:
    """Return the centre line."""
    lap_position = _places(course)
    return _line(course, lap_position, np.zeros(len(lap_position)), course.points_at(lap_position))


@lru_cache(maxsize=8)
def minimum_curvature_line(course: Track) -> Line:
    """Return the line of least curvature, squared and summed along it, that keeps `MARGIN_M` from both borders.

    Moving point i sideways changes the second differences linearly; given the direction and the pace of the last
    round's line, their component across it is the curvature. So each round is a bounded linear least squares problem.
    """
    lap_position = _places(course)
    center = course.points_at(lap_position)
    first, second = _differences(course.closed, len(center))
    along = first @ center
    sideways = _turned_left(along) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    right_m, left_m = _road_across(course, center, sideways)
    bounds = np.minimum(right_m + MARGIN_M, -1e-6), np.maximum(left_m - MARGIN_M, 1e-6)
    offset_m = np.zeros(len(center))
    for _ in range(ROUNDS):
        velocity = first @ (center + offset_m[:, None] * sideways)
        pace = np.maximum(np.linalg.norm(velocity, axis=1), 1e-9)
        # n / pace**2 turns a second difference into curvature; sqrt(pace) weights the sum by length.
        weight = _turned_left(velocity) / pace[:, None] ** 2.5
        matrix = weight[:, :1] * second * sideways[:, 0] + weight[:, 1:] * second * sideways[:, 1]
        wanted_m = lsq_linear(matrix, -(weight * (second @ center)).sum(axis=1), bounds).x
        offset_m = 0.5 * (offset_m + wanted_m)
    return _line(course, lap_position, offset_m, center + offset_m[:, None] * sideways)


def _places(course: Track) -> Values:
    count = int(np.clip(course.length_m / SAMPLE_M, 20, MOST))
    return np.linspace(0.0, 1.0, count, endpoint=not course.closed)


def _road_across(course: Track, center: Values, sideways: Values) -> tuple[Values, Values]:
    """Return the extent of the road to the right (negative) and to the left of points of the centre line, m, (n,).

    It is measured on the road itself: the two border points of a waypoint may lie far ahead of it or behind.
    """
    reach = course.width_max_m * sideways
    across = shapely.linestrings(np.stack([center - reach, center + reach], axis=1))
    parts, point = shapely.get_parts(shapely.intersection(across, course.road), return_index=True)
    # Another stretch of the road may be within reach; the nearest part is the one that the point is on.
    away_m = shapely.distance(parts, shapely.points(center)[point])
    nearest = np.lexsort((away_m, point))
    nearest = nearest[np.unique(point[nearest], return_index=True)[1]]
    ends, part = shapely.get_coordinates(parts[nearest], return_index=True)
    middle = point[nearest][part]
    side_m = ((ends - center[middle]) * sideways[middle]).sum(axis=1)
    right_m, left_m = np.zeros(len(center)), np.zeros(len(center))
    np.minimum.at(right_m, middle, side_m)
    np.maximum.at(left_m, middle, side_m)
    return right_m, left_m


def _differences(closed: bool, n: int) -> tuple[Values, Values]:
    """Return the matrices (n, n) of first and second differences; an open line does not bend at its ends."""
    here = np.eye(n)
    ahead, behind = np.roll(here, 1, axis=1), np.roll(here, -1, axis=1)
    first, second = 0.5 * (ahead - behind), ahead - 2.0 * here + behind
    if not closed:
        first[0], first[-1] = ahead[0] - here[0], here[-1] - behind[-1]
        second[[0, -1]] = 0.0
    return first, second


def _turned_left(vectors: Values) -> Values:
    return np.column_stack([-vectors[:, 1], vectors[:, 0]])


def _line(course: Track, lap_position: Values, offset_m: Values, points: Values) -> Line:
    first, second = _differences(course.closed, len(points))
    velocity = first @ points
    pace = np.maximum(np.linalg.norm(velocity, axis=1), 1e-9)
    curvature_pm = (_turned_left(velocity) * (second @ points)).sum(axis=1) / pace**3
    if course.closed:  # back to where it began, so that places behind the last point find their values
        lap_position = np.r_[lap_position, 1.0]
        offset_m, curvature_pm = np.r_[offset_m, offset_m[0]], np.r_[curvature_pm, curvature_pm[0]]
        points = np.vstack([points, points[:1]])
    return Line(lap_position=lap_position, offset_m=offset_m, xy=points, curvature_pm=curvature_pm)
