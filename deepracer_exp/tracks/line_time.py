"""A lower bound of the lap time on a course: the fastest line of a car that uses all its limits at once.

An `Ability` holds these limits: the highest speed at each curvature, and acceleration and braking on a straight. A real
car has to steer into a bend and cannot use them all at once, so it takes longer on the same line. The line comes from a
local search; that no other line is faster is not proved.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.jit import njit

from .track import Track

Floats = NDArray[np.float64]

WINDOW_M = 0.4
"""Curvature is that of the circle through a point and those at this distance behind and ahead of it."""
_SAMPLE_M = 0.1
_KNOT_M = 0.3
"""Distance of the places at which a line is moved."""
_STRAIGHTNESS = (0.0, 1.0, 10.0, 100.0, 1000.0)
"""Weights of curvature relative to length in the initial lines."""
_ITERATIONS = 100


class Ability(NamedTuple):
    """The limits of a car."""

    curvature_per_m: Floats
    """Falling, measured over `WINDOW_M`."""
    speed_mps: Floats
    """The highest mean speed over the window at each, rising."""
    accelerate_mps2: float
    brake_mps2: float

    def speed_at(self, curvature_per_m: Floats) -> Floats:
        """Return the highest speed at each curvature."""
        return np.interp(-np.abs(curvature_per_m), -self.curvature_per_m, self.speed_mps)


def fastest_line(
    track: Track,
    reach_m: float,
    ability: Ability,
    start_ndist: float | None = None,
    short_m: float = 0.0,
    driven: Floats | None = None,
) -> tuple[float, Floats]:
    """Return the least time of a lap in s, and its line, (n, 2).

    Args:
        track: the course.
        reach_m: how far beyond the borders the driven point may be.
        ability: of the car.
        start_ndist: where a lap from standstill begins, at the centre line; None: a flying lap.
        short_m: how far before the line a lap from standstill ends, because the front of the car is ahead of the
            driven point.
        driven: points of a lap (n, 2) from whose line the search begins, in place of simple lines.
    """
    road = _Road(track, reach_m, ability, start_ndist, short_m)
    lines = road.simple_lines() if driven is None else [road.offsets_of(driven)]
    # Improving takes long; only the two most promising lines are improved.
    promising = sorted(lines, key=road.time_s)[:2]
    improved = min((road.improved(offsets) for offsets in promising), key=lambda line: line[0])
    return improved[0], road.line(improved[1])


class _Road:
    """The places of a line across the road: gates from border to border, each with an offset from -1 to 1."""

    def __init__(
        self, track: Track, reach_m: float, ability: Ability, start_ndist: float | None, short_m: float
    ) -> None:
        self._ability, self._short_m = ability, short_m
        self._flying = start_ndist is None
        count = max(30, round(track.length_m / _SAMPLE_M))
        # A flying lap ends where it began, with the same gate.
        shares = np.linspace(0.0, 1.0, count + 1)
        place_m = np.r_[0.0, np.cumsum(np.hypot(*np.diff(track.waypoints, axis=0).T))]
        wanted_m = ((start_ndist or 0.0) + shares) * track.length_m
        if track.closed:
            wanted_m = np.mod(wanted_m, track.length_m)
        places = np.interp(wanted_m, place_m, np.arange(len(place_m)))
        inner, outer = (_between(line, places) for line in (track.inner, track.outer))
        self._middle, self._half = 0.5 * (outer + inner), 0.5 * (outer - inner)
        self._reach = 1.0 + reach_m / np.maximum(np.hypot(*self._half.T), 1e-6)
        # These imports from scipy take half a second, and few commands search a line.
        from scipy.interpolate import CubicSpline

        self._start = None if start_ndist is None else track.points_at(np.array([start_ndist]))[0]
        self._knots = np.round(np.linspace(0, count, max(8, round(track.length_m / _KNOT_M)) + 1)).astype(int)
        self._basis = CubicSpline(self._knots, np.eye(len(self._knots)), bc_type="natural")(
            np.arange(count + 1)
        )

    def line(self, offsets: Floats) -> Floats:
        """Return the points of a line, (n, 2)."""
        points = self._middle + np.clip(offsets, -self._reach, self._reach)[:, None] * self._half
        if self._flying:
            points[-1] = points[0]
        elif self._start is not None:
            points[0] = self._start
        return points

    def time_s(self, offsets: Floats) -> float:
        """Return the least time on a line."""
        can = self._ability
        ability = (-can.curvature_per_m, can.speed_mps, can.accelerate_mps2, can.brake_mps2)
        return float(_time_s(self.line(offsets), ability, self._flying, self._short_m))

    def improved(self, offsets: Floats) -> tuple[float, Floats]:
        """Return the least time on a line near by, and its offsets."""
        from scipy.optimize import minimize

        result = minimize(
            lambda moved: self.time_s(offsets + self._basis @ moved),
            np.zeros(len(self._knots)),
            method="L-BFGS-B",
            options={"eps": 1e-4, "maxiter": _ITERATIONS, "maxfun": 10**6},
        )
        return float(result.fun), offsets + self._basis @ result.x

    def offsets_of(self, driven: Floats) -> Floats:
        """Return the offsets of a driven line, (n, 2), at the gates."""
        along = np.sum((driven[:, None] - self._middle[None]) ** 2, axis=2).argmin(axis=1)
        gates, first = np.unique(np.maximum.accumulate(along), return_index=True)
        half = self._half[gates]
        offsets = ((driven[first] - self._middle[gates]) * half).sum(axis=1) / (half**2).sum(axis=1)
        return np.interp(np.arange(len(self._middle)), gates, offsets)

    def simple_lines(self) -> list[Floats]:
        """Return lines between the shortest and the straightest, as offsets."""
        from scipy.optimize import lsq_linear
        from scipy.sparse import block_diag, csr_array, diags_array, vstack

        def both(matrix: csr_array) -> csr_array:
            """Return the block-diagonal matrix that applies this one to x and to y."""
            return block_diag([matrix, matrix]).tocsr()

        middle, half = self._middle, self._half
        count = len(middle)
        ahead = diags_array([-np.ones(count), np.ones(count - 1), [1.0]], offsets=[0, 1, 1 - count]).tocsr()
        if not self._flying:
            ahead = ahead[:-1]
        # On an even grid, differences are lengths and second differences curvature.
        spread = vstack([diags_array(half[:, 0]), diags_array(half[:, 1])]).tocsr()
        step, bend = both(ahead), both((ahead.T @ ahead).tocsr())
        lines = []
        for weight in _STRAIGHTNESS:
            matrix = vstack([step @ spread, weight * (bend @ spread)]).tocsr()
            target = -np.concatenate([step @ middle.T.ravel(), weight * (bend @ middle.T.ravel())])
            lines.append(
                lsq_linear(
                    matrix, target, bounds=(-self._reach, self._reach), lsmr_tol="auto", max_iter=100
                ).x
            )
        return lines


def _between(line: Floats, places: Floats) -> Floats:
    return np.stack([np.interp(places, np.arange(len(line)), line[:, axis]) for axis in (0, 1)], axis=1)


@njit(cache=True)
def evenly(points, apart_m):  # type: ignore[no-untyped-def]
    """Return a line (n, 2) as points `apart_m` apart along it, (m, 2); the rest at its end is left out."""
    count = len(points)
    place = np.zeros(count)
    for k in range(1, count):
        dx, dy = points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1]
        place[k] = place[k - 1] + np.sqrt(dx * dx + dy * dy)
    even = np.empty((int(place[-1] / apart_m) + 1, 2))
    k = 0
    for n in range(len(even)):
        while k < count - 2 and place[k + 1] < n * apart_m:
            k += 1
        share = (n * apart_m - place[k]) / max(place[k + 1] - place[k], 1e-12)
        even[n] = points[k] + share * (points[k + 1] - points[k])
    return even, place[-1]


@njit(cache=True)
def curvature_per_m(even, window):  # type: ignore[no-untyped-def]
    """Return Menger's curvature of each point of a line and those `window` points around it; 0 at the ends."""
    curvature = np.zeros(len(even))
    for n in range(window, len(even) - window):
        ax, ay = even[n, 0] - even[n - window, 0], even[n, 1] - even[n - window, 1]
        bx, by = even[n + window, 0] - even[n, 0], even[n + window, 1] - even[n, 1]
        cx, cy = ax + bx, ay + by
        lengths = np.sqrt((ax * ax + ay * ay) * (bx * bx + by * by) * (cx * cx + cy * cy))
        curvature[n] = 2.0 * abs(ax * cy - ay * cx) / max(lengths, 1e-12)
    return curvature


@njit(cache=True)
def _time_s(points, ability, flying, short_m):  # type: ignore[no-untyped-def]
    minus_curvature, speed, accelerate, brake = ability
    if flying:  # three times around, of which the middle one counts
        once = len(points) - 1
        long = np.empty((3 * once + 1, 2))
        for n in range(len(long)):
            long[n] = points[n % once]
        points = long
    even, length_m = evenly(points, _SAMPLE_M)
    curvature = curvature_per_m(even, round(WINDOW_M / _SAMPLE_M))
    v = np.interp(-curvature, minus_curvature, speed)
    if not flying:
        v[0] = 0.0
    for n in range(1, len(v)):
        v[n] = min(v[n], np.sqrt(v[n - 1] ** 2 + 2.0 * accelerate * _SAMPLE_M))
    for n in range(len(v) - 2, -1 + (not flying), -1):
        v[n] = min(v[n], np.sqrt(v[n + 1] ** 2 + 2.0 * brake * _SAMPLE_M))
    time = np.zeros(len(v))
    for n in range(1, len(v)):
        time[n] = time[n - 1] + 2.0 * _SAMPLE_M / (v[n - 1] + v[n])
    place = _SAMPLE_M * np.arange(len(v))
    if flying:
        return np.interp(2.0 * length_m / 3.0, place, time) - np.interp(length_m / 3.0, place, time)
    end_m = length_m - short_m
    rest_m = end_m - place[-1]
    return np.interp(end_m, place, time) + max(rest_m, 0.0) / v[-1]
