"""Course files: the service's worlds, its route arrays (.npy), and YAML files of spline knots."""

import zipfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, TypeAdapter

from deepracer_exp.errors import BadInput, naming, nearest, reading
from deepracer_exp.files import ROUTE_BYTES, open_user_file, read_yaml_as

from .catalogue import FILE, ROUTES, UNITS_PER_M, worlds

REPEAT_M = 1e-9
"""A point closer than this to the one before it repeats it."""
FARTHEST_M = 10_000.0
"""Larger coordinates are refused: they are not in metres."""
ROUTE_ROWS = "rows of 6 numbers: centre x, y, inner x, y, outer x, y in metres"
SPACING_M = 0.15
"""Distance between two rows along knots, as in AWS's worlds of 2018 and 2019."""
MOST_ROWS = 4000
"""Rows a course of knots has at most; one longer than 600 m gets them farther apart."""
LONGEST_FOLD = 8.0
"""Length of a border's fold, in road widths, up to which it counts as the inside of a tight bend."""
NEAR_M = 1.0
"""Largest mean distance of a recording's poses from their closest waypoints: roads are up to 2 m wide."""
_Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
_Width = Annotated[float, Field(gt=0, le=FARTHEST_M)]


@dataclass(frozen=True)
class Knots:
    """The content of a YAML of knots."""

    knots: tuple[tuple[_Coordinate, _Coordinate], ...]
    """Centre-line points (x, y) in metres."""
    width_m: _Width | tuple[_Width, ...]
    """One value, or one per knot."""
    closed: bool = True
    title: str | None = None


def read_route(path: str | Path) -> np.ndarray:
    """Read a route file.

    The file is a `.npy` of shape (n, 6).

    Rows whose centre repeats the one before are kept: they count in the service's waypoint numbers, as recordings of
    such courses show.

    Returns:
        Rows (n, 6) float64: centre x, y, inner x, y, outer x, y in metres. The course is closed if and
        only if the first row equals the last.

    Raises:
        BadInput: The file cannot be read, or does not contain such rows.
    """
    accepted = f"a .npy with {ROUTE_ROWS}"
    with (
        open_user_file(path, accepted, ROUTE_BYTES) as file,
        reading(path, accepted, "not a NumPy array file"),
    ):
        rows = np.lib.format.read_array(file, allow_pickle=False)
    if rows.dtype.kind not in "fiu":
        raise BadInput(path, f"holds {rows.dtype.name} values; accepted are {ROUTE_ROWS}")
    with naming(path):
        return checked_rows(rows)


def checked_rows(rows: np.ndarray) -> np.ndarray:
    """Return route rows as float64.

    Args:
        rows: Numbers of shape (n, 6).

    Raises:
        BadInput: Wrong shape, too few distinct rows, or a value that is not finite or not in metres.
    """
    if rows.ndim != 2 or rows.shape[1] != 6:
        raise BadInput(f"shape {rows.shape}; accepted are {ROUTE_ROWS}")
    rows = np.array(rows, dtype=np.float64)
    wrong = ~(np.abs(rows) <= FARTHEST_M)
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        value = f"row {row}, column {column} is {rows[row, column]:g}"
        raise BadInput(f"{value}; accepted are numbers within +-{FARTHEST_M:g} m")
    closed = bool(len(rows) and (rows[0] == rows[-1]).all())
    needed = 4 if closed else 3
    distinct = int(is_first_of_equals(rows[:, :2]).sum())
    if distinct < needed:
        kind = "closed course with its closing row" if closed else "course"
        raise BadInput(f"{distinct} distinct rows; accepted are at least {needed} for a {kind}")
    return rows


def is_first_of_equals(points: np.ndarray) -> np.ndarray:
    """Return whether each of the points (n, 2) in metres differs from the one before it (bool); the first does."""
    return np.linalg.norm(np.diff(points, axis=0, prepend=np.inf), axis=1) >= REPEAT_M


@cache
def world_rows(name: str) -> np.ndarray:
    """Return a world's route rows (n, 6) float64, read-only: centre x, y, inner x, y, outer x, y in metres.

    Raises:
        BadInput: there is no such world.
    """
    if name not in worlds():
        accepted = f"`deepracer-exp tracks` lists all {len(worlds())}"
        raise BadInput(name, f"no such world{nearest(name, worlds())}; {accepted}")
    # Each world is stored as its second differences.
    rows = _bends()[name].astype(np.int64).cumsum(axis=0).cumsum(axis=0) / UNITS_PER_M
    rows.flags.writeable = False
    return rows


@cache
def _bends() -> dict[str, np.ndarray]:
    """Return the second differences of each world's rows (rows, 6) in units of 0.1 mm."""
    with zipfile.ZipFile(FILE) as file, file.open(ROUTES) as member:
        bends = np.lib.format.read_array(member, allow_pickle=False)
    ends = np.cumsum([world.rows for world in worlds().values()])
    return dict(zip(worlds(), np.split(bends, ends[:-1]), strict=True))


class Recognised(NamedTuple):
    """A world that matches a recording."""

    name: str
    reversed: bool
    distance_m: float
    """Mean distance between the recorded points and the waypoints recorded as closest."""


def recognise(points: np.ndarray, closest_waypoint: np.ndarray) -> list[Recognised]:
    """Return the worlds that match a recording, the best first; equal ones in the catalogue's order.

    Every world has its own numbering of waypoints: in the right one, each recorded waypoint is near the point where it
    was recorded.

    Args:
        points: recorded points (n, 2) in metres; a few hundred from all around the lap are enough.
        closest_waypoint: the waypoint recorded with each (n,).
    """
    matches = []
    last = int(closest_waypoint.max())
    for world in worlds().values():
        if last < world.rows:
            waypoints = world_rows(world.name)[:, :2]
            for reversed, line in ((False, waypoints), (True, waypoints[::-1])):
                away_m = np.linalg.norm(points - line[closest_waypoint], axis=1)
                matches.append(Recognised(world.name, reversed, float(away_m.mean())))
    near = [match for match in matches if match.distance_m < NEAR_M]
    return sorted(near, key=lambda match: round(match.distance_m, 6))


def read_knots(path: str | Path) -> Knots:
    """Read a YAML of spline knots.

    Keys: `knots` (list of [x, y] in metres) and `width_m` (a number, or one per knot) are required;
    `closed` (default true) and `title` are not.

    Raises:
        BadInput: The file cannot be read, a key is unknown or missing, or a value has the wrong type.
    """
    accepted = (
        "knots: [[x, y], ...] in metres, width_m: metres, or one per knot, closed: true or false, title: text"
    )
    return read_yaml_as(path, TypeAdapter(Knots), accepted)


def rows_from_knots(knots: ArrayLike, width_m: ArrayLike, closed: bool) -> np.ndarray:
    """Return route rows along a cubic spline through knots.

    The spline is periodic on a closed course and natural on an open one. It is parametrised by the
    square root of the chord (centripetal): for evenly spaced knots that is the knot's number, and a
    spline through knots set by hand does not overshoot.

    Args:
        knots: Points (k, 2) in metres; the first is not repeated at the end of a closed course.
        width_m: Distance between the borders in metres: one value or (k,).
        closed: Whether the last knot joins the first.

    Returns:
        Rows (n, 6) float64 about 0.15 m apart. The inner border is the one inside the ring; on an open
        course it is the left one.

    Raises:
        BadInput: Too few knots, repeated knots, another number of widths than of knots, or a road so
            wide that its border crosses itself.
    """
    from scipy.interpolate import CubicSpline  # takes half a second, and few tracks have knots

    knots, width_m = np.asarray(knots, np.float64).reshape(-1, 2), np.atleast_1d(width_m)
    _check_knots(knots, width_m, closed)
    width_m = np.broadcast_to(width_m, len(knots))
    if closed:
        knots, width_m = np.concatenate([knots, knots[:1]]), np.r_[width_m, width_m[:1]]
    chord_m = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    knot = np.r_[0.0, np.cumsum(np.sqrt(chord_m))]
    spline = CubicSpline(knot, np.column_stack([knots, width_m]), bc_type="periodic" if closed else "natural")

    fine = np.linspace(0.0, knot[-1], 100 * len(knots) + 1)
    step_m = np.linalg.norm(np.diff(spline(fine)[:, :2], axis=0), axis=1)
    distance_m = np.r_[0.0, np.cumsum(step_m)]
    rows = min(max(8, round(distance_m[-1] / SPACING_M)), MOST_ROWS)
    at_rows = np.interp(np.linspace(0.0, distance_m[-1], rows + 1), distance_m, fine)

    center, half_m = spline(at_rows)[:, :2], spline(at_rows)[:, 2:] / 2
    if half_m.min() <= 0:
        raise BadInput("width_m falls to 0 between two knots; accepted are widths that change more gently")
    tangent = spline(at_rows, 1)[:, :2]
    left = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1, keepdims=True)
    if closed:
        center[-1], left[-1], half_m[-1] = center[0], left[0], half_m[0]
        if _signed_area(center) < 0:
            left = -left
    longest_m = LONGEST_FOLD * 2 * float(half_m.max())
    inner = _unfold(center + half_m * left, longest_m, closed)
    outer = _unfold(center - half_m * left, longest_m, closed)
    return np.column_stack([center, inner, outer])


def _unfold(border: np.ndarray, longest_m: float, closed: bool) -> np.ndarray:
    """Return a border without self-intersections: each fold is collapsed into its crossing.

    A border on the inside of a bend tighter than half the road's width runs backwards for a while and crosses itself;
    the area between the two passages of the crossing is road.

    Args:
        border: Points (n, 2); on a closed course the last equals the first.
        longest_m: Longest fold that is pulled together.
        closed: Whether the border is a ring.
    """
    border = border.copy()
    last = len(border) - 1
    begin = 0
    while (crossing := _first_crossing(border, closed, begin)) is not None:
        i, j, point = crossing
        begin = i
        step_m = np.linalg.norm(np.diff(border, axis=0), axis=1)
        between_m = step_m[i:j].sum()
        if between_m <= longest_m:
            border[i + 1 : j + 1] = point
        elif closed and step_m.sum() - between_m <= longest_m:
            border[j + 1 :] = point
            border[: i + 1] = point
            begin = 0
        else:
            x, y = point
            raise BadInput(
                f"a border crosses itself at ({x:.2f}, {y:.2f}); accepted is a road narrower than the "
                "space between its stretches"
            )
        if closed:
            border[last] = border[0]
    return border


def _first_crossing(border: np.ndarray, closed: bool, begin: int) -> tuple[int, int, np.ndarray] | None:
    """Return the first pair of segments from `begin` on whose insides cross, and the crossing."""
    a, d = border[:-1], np.diff(border, axis=0)
    count = len(a)
    for i in range(begin, count - 2):
        j = np.arange(i + 2, count - 1 if closed and i == 0 else count)
        gap = a[j] - a[i]
        turn = d[i, 0] * d[j, 1] - d[i, 1] * d[j, 0]
        with np.errstate(divide="ignore", invalid="ignore"):  # parallel segments give nan and do not cross
            on_i = (gap[:, 0] * d[j, 1] - gap[:, 1] * d[j, 0]) / turn
            on_j = (gap[:, 0] * d[i, 1] - gap[:, 1] * d[i, 0]) / turn
        # 1e-9 keeps a pair that meets in a fold already pulled together from counting again.
        hits = j[(on_i > 1e-9) & (on_i < 1 - 1e-9) & (on_j > 1e-9) & (on_j < 1 - 1e-9)]
        if len(hits):
            hit = int(hits[-1])
            return i, hit, a[i] + on_i[hit - i - 2] * d[i]
    return None


def _check_knots(knots: np.ndarray, width_m: np.ndarray, closed: bool) -> None:
    needed = 4 if closed else 3
    if len(knots) < needed:
        kind = "a closed" if closed else "an open"
        raise BadInput(f"{len(knots)} knots; accepted are at least {needed} for {kind} course")
    if len(width_m) not in (1, len(knots)):
        raise BadInput(
            f"width_m has {len(width_m)} values for {len(knots)} knots; accepted is 1 or one per knot"
        )
    if closed and (knots[0] == knots[-1]).all():
        raise BadInput("the last knot repeats the first; accepted is a closed course without that knot")
    repeated = np.flatnonzero((np.diff(knots, axis=0) == 0).all(axis=1))
    if len(repeated):
        raise BadInput(f"knots[{repeated[0] + 1}] repeats the knot before it; accepted are distinct knots")


def runs_clockwise(rows: np.ndarray) -> bool:
    """Return whether a closed course's rows (n, 6) run clockwise around it."""
    return _signed_area(rows[:, :2]) < 0


def _signed_area(ring: np.ndarray) -> float:
    x, y = ring.T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) / 2)
