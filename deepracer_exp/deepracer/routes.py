"""Course files: the service's worlds, its route arrays (.npy), and YAML files of spline knots."""

import math
import zipfile
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.files import ROUTE_BYTES, open_user_file, read_yaml

from .worlds import FILE, ROUTES, UNITS_PER_M, worlds

REPEAT_M = 1e-9
"""A point closer than this to the one before it repeats it."""
FARTHEST_M = 10_000.0
"""Larger coordinates are not metres."""
KNOT_KEYS = ("knots", "width_m", "closed", "title")
ROUTE_ROWS = "rows of 6 numbers: centre x, y, inner x, y, outer x, y in metres"


class Knots(NamedTuple):
    """The content of a YAML of knots; `width_m` has one value or one per knot."""

    knots: np.ndarray
    width_m: np.ndarray
    closed: bool
    title: str | None


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
    first = 0
    for world in worlds().values():
        if world.name == name:
            break
        first += world.rows
    rows = _units()[first : first + worlds()[name].rows] / UNITS_PER_M
    rows.flags.writeable = False
    return rows


@cache
def _units() -> np.ndarray:
    """Return the rows of all worlds (rows, 6) int64 in units of 0.1 mm."""
    with zipfile.ZipFile(FILE) as file, file.open(ROUTES) as member:
        bends = np.lib.format.read_array(member, allow_pickle=False)
    ends = np.cumsum([world.rows for world in worlds().values()])
    # Each world is stored as its second differences.
    parts = np.split(bends.astype(np.int64), ends[:-1])
    return np.concatenate([part.cumsum(axis=0).cumsum(axis=0) for part in parts])


def read_knots(path: str | Path) -> Knots:
    """Read a YAML of spline knots.

    Keys: `knots` (list of [x, y] in metres) and `width_m` (a number, or one per knot) are required;
    `closed` (default true) and `title` are not.

    Raises:
        BadInput: The file cannot be read, a key is unknown or missing, or a value has the wrong type.
    """
    path = Path(path)
    content = read_yaml(path, f"a file with the keys {_keys()}")
    if not isinstance(content, dict):
        raise BadInput(f"{path}: no keys found; accepted are {_keys()}")
    for key in content:
        if key not in KNOT_KEYS:
            hint = nearest(str(key), KNOT_KEYS)
            raise BadInput(f"{path}: unknown key {key!r}{hint}; accepted are {_keys()}")
    for key in ("knots", "width_m"):
        if key not in content:
            raise BadInput(f"{path}: key {key} is missing; accepted are {_keys()}")
    closed = content.get("closed", True)
    if not isinstance(closed, bool):
        raise BadInput(f"{path}: closed is {closed!r}; accepted are true and false")
    title = content.get("title")
    if title is not None and not isinstance(title, str):
        raise BadInput(f"{path}: title is {title!r}; accepted is text")
    return Knots(_points(path, content["knots"]), _widths(path, content["width_m"]), closed, title)


def _points(path: Path, value: Any) -> np.ndarray:
    if not isinstance(value, list):
        raise BadInput(f"{path}: knots is {value!r}; accepted is a list of [x, y] in metres")
    for index, point in enumerate(value):
        if not (isinstance(point, list) and len(point) == 2 and all(map(_is_coordinate, point))):
            raise BadInput(
                f"{path}: knots[{index}] is {point!r}; accepted is [x, y], numbers within +-{FARTHEST_M:g} m"
            )
    return np.array(value, dtype=np.float64).reshape(-1, 2)


def _widths(path: Path, value: Any) -> np.ndarray:
    widths = value if isinstance(value, list) else [value]
    for width in widths:
        if not _is_coordinate(width) or width <= 0:
            raise BadInput(f"{path}: width_m has {width!r}; accepted are metres above 0, one or one per knot")
    return np.array(widths, dtype=np.float64)


def _is_coordinate(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value) and abs(value) <= FARTHEST_M


def _keys() -> str:
    return ", ".join(KNOT_KEYS)
