"""Course files: the service's worlds, its route arrays (.npy), and YAML files of spline knots."""

import zipfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, TypeAdapter

from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.files import ROUTE_BYTES, open_user_file, read_yaml_as

from .worlds import FILE, ROUTES, UNITS_PER_M, worlds

REPEAT_M = 1e-9
"""A point closer than this to the one before it repeats it."""
FARTHEST_M = 10_000.0
"""Larger coordinates are not metres."""
ROUTE_ROWS = "rows of 6 numbers: centre x, y, inner x, y, outer x, y in metres"


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

    Rows whose centre repeats the one before are kept: they count in the service's waypoint numbers, as recordings of
    such courses show.

    Args:
        path: A `.npy` file of shape (n, 6).

    Returns:
        Rows (n, 6) float64: centre x, y, inner x, y, outer x, y in metres. The course is closed if and
        only if the first row equals the last.

    Raises:
        BadInput: The file cannot be read, or does not contain such rows.
    """
    accepted = f"a .npy with {ROUTE_ROWS}"
    with (
        open_user_file(path, accepted, ROUTE_BYTES) as file,
        reading(f"{path}: not a NumPy array file", accepted),
    ):
        rows = np.lib.format.read_array(file, allow_pickle=False)
    if rows.dtype.kind not in "fiu":
        raise BadInput(f"{path}: holds {rows.dtype.name} values; accepted are {ROUTE_ROWS}")
    try:
        return checked_rows(rows)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from None


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
    """Return for points (n, 2) in metres whether each differs from the one before it (bool); the first does."""
    return np.linalg.norm(np.diff(points, axis=0, prepend=np.inf), axis=1) >= REPEAT_M


@cache
def world_rows(name: str) -> np.ndarray:
    """Return a world's route rows (n, 6) float64, read-only: centre x, y, inner x, y, outer x, y in metres.

    Raises:
        BadInput: there is no such world.
    """
    if name not in worlds():
        known = f"`deepracer-exp tracks` lists all {len(worlds())}"
        raise BadInput(f"{name}: no such world{nearest(name, worlds())}; {known}")
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
    found = []
    last = int(closest_waypoint.max())
    for world in worlds().values():
        if last < world.rows:
            waypoints = world_rows(world.name)[:, :2]
            for reversed, line in ((False, waypoints), (True, waypoints[::-1])):
                away_m = np.linalg.norm(points - line[closest_waypoint], axis=1)
                found.append(Recognised(world.name, reversed, float(away_m.mean())))
    near = [one for one in found if one.distance_m < NEAR_M]
    return sorted(near, key=lambda one: round(one.distance_m, 6))


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
