"""Maps of a course: the road, cells over it, and numbers of waypoints beside it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.jit import njit
from deepracer_exp.reports.tables.statistics import Values, means
from deepracer_exp.tracks.outline import Outline
from deepracer_exp.tracks.track import Track

from .figure import Annotation, Layer, Panel, Shape, Trace, colored_points, heatmap, line, note
from .style import FAINT, ROAD_CENTER, ROAD_EDGE, ROAD_FILL

LEAST_STEPS = 4
"""Fewest steps of a cell for a meaningful mean."""
_SIDES_M = (0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.75, 1.0)
"""Sides of a cell; the smallest one that keeps the number of cells within bounds is used."""
_RIM_M = 0.4
"""Width of the ground around the road within a grid."""
_NUMBERED = 10
"""Waypoints from one number on a map to the next."""
_LABEL = 0.035
"""Distance of a waypoint's number from the border, as a share of the longer side of the map."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Square cells over the bounding box of a road."""

    low_x: float
    low_y: float
    side_m: float
    columns: int
    rows: int

    @classmethod
    def over(cls, course: Track, most: int) -> "Grid":
        """Lay cells over a course, at most `most`, as small as `_SIDES_M` allows."""
        low, high = Outline.of(course).corners(_RIM_M)
        for side_m in (*_SIDES_M, float((high - low).max() / most**0.5)):
            columns, rows = (int(np.ceil(length / side_m)) for length in high - low)
            if columns * rows <= most or side_m > _SIDES_M[-1]:
                break
        return cls(low_x=float(low[0]), low_y=float(low[1]), side_m=side_m, columns=columns, rows=rows)

    def of(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.intp]:
        """Return the cell of each point (n,): row by row from the lower left; -1 where it is outside."""
        x, y = (np.ascontiguousarray(values, np.float64) for values in (x, y))
        cells: NDArray[np.intp] = _cells(
            x, y, (self.low_x, self.low_y), self.side_m, (self.columns, self.rows)
        )
        return cells

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.columns * self.rows

    def means(self, rows: pd.DataFrame, values: ArrayLike, scale: str, least: int = 1, **more: Any) -> Trace:
        """Return the means of values in the cells of the rows' `X` and `Y` as the layer of a map."""
        return self.cells(means(self.of(rows["X"], rows["Y"]), values, self.count, least), scale, **more)

    def cells(self, values: Values, scale: str, **more: Any) -> Trace:
        """Return values (count,) as the layer of a map; see `heatmap`."""
        x = self.low_x + self.side_m * (np.arange(self.columns) + 0.5)
        y = self.low_y + self.side_m * (np.arange(self.rows) + 0.5)
        return heatmap(x, y, values.reshape(self.rows, self.columns), scale, **more)


@njit(cache=True, nogil=True)
def _cells(x, y, low, side_m, shape):  # type: ignore[no-untyped-def]
    (low_x, low_y), (columns, rows) = low, shape
    cells = np.full(len(x), -1, np.intp)
    for i in range(len(x)):
        column, row = math.floor((x[i] - low_x) / side_m), math.floor((y[i] - low_y) / side_m)
        if 0 <= column < columns and 0 <= row < rows:
            cells[i] = int(row) * columns + int(column)
    return cells


def map_panel(course: Track, layers: Sequence[Layer], title: str = "", numbers: bool = True) -> Panel:
    """Return a map: the road, `layers` on it, its borders above them, and numbers of waypoints beside it."""
    outline = Outline.of(course)
    borders = [line(ring[:, 0], ring[:, 1], FAINT, width=1.0) for ring in outline.rings]
    x, y = outline.start_line.T
    start = line(x, y, FAINT, width=3.0)
    notes = _waypoint_numbers(course) if numbers else []
    shown = [*_road(outline.rings, course.waypoints), *layers, *borders, start, *notes]
    x_range, y_range = _extent(shown)
    return Panel(layers=shown, title=title, map=True, x_range=x_range, y_range=y_range)


def outlines(corners: Values, color: str, name: str | None = None, width: float = 1.5) -> Trace:
    """Return the outlines of boxes, corners (k, 4, 2), as one layer of a map."""
    closed = np.concatenate([corners, corners[:, :1], np.full((len(corners), 1, 2), np.nan)], axis=1)
    x, y = closed.reshape(-1, 2)[:-1].T
    return line(x, y, color, name, width=width)


def waypoint_map_panel(
    course: Track,
    values: Values,
    scale: str,
    hover: Sequence[str],
    value_range: tuple[float, float] | None = None,
) -> Panel:
    """Return a map with the waypoints coloured by values, at least one each."""
    n = min(len(course.waypoints), len(values))
    x, y = course.waypoints[:n].T
    return map_panel(course, [colored_points(x, y, values[:n], scale, hover=hover, value_range=value_range)])


def waypoint_panel(layers: Sequence[Layer], label: str, n: int, **more: Any) -> Panel:
    """Return a panel along n waypoints."""
    return Panel(layers=layers, x_label="waypoint", y_label=label, x_range=(-1.0, float(n)), **more)


def beside(course: Track, place: Values, offset_m: Values) -> Values:
    """Return the points (n, 2) `offset_m` to the left of the centre line at neighbouring lap positions (n,)."""
    center = course.points_at(place)
    ahead = np.gradient(center, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    return center + offset_m[:, None] * np.column_stack([-ahead[:, 1], ahead[:, 0]])


def _road(rings: Sequence[Values], center: Values) -> list[Shape]:
    """Return the road and its centre line as shapes, because traces are drawn above every heat map."""
    common = {"type": "path", "xref": "x", "yref": "y", "layer": "below"}
    area = "".join(_path(ring) + "Z" for ring in rings)
    edge, dashes = {"color": ROAD_EDGE, "width": 1.4}, {"color": ROAD_CENTER, "width": 1, "dash": "dash"}
    return [
        Shape(path=area, fillcolor=ROAD_FILL, fillrule="evenodd", line=edge, **common),
        Shape(path=_path(center), line=dashes, **common),
    ]


def _path(points: Values) -> str:
    return "M" + "L".join(f"{x:.3f},{y:.3f}" for x, y in points)


def _extent(layers: Sequence[Layer]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of x and y that show all lines, points and texts, with a small rim."""
    places = [
        np.column_stack([np.atleast_1d(layer["x"]), np.atleast_1d(layer["y"])])
        for layer in layers
        if isinstance(layer, Annotation) or layer.get("type") == "scatter"
    ]
    corners = np.concatenate(places).astype(np.float64)
    low, high = np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)
    rim = 0.03 * float((high - low).max())
    (left, bottom), (right, top) = (low - rim).tolist(), (high + rim).tolist()
    return (left, right), (bottom, top)


def _waypoint_numbers(course: Track) -> list[Annotation]:
    """Return the numbers of waypoints, outside the road."""
    last = len(course.waypoints) - course.closed
    # Long courses have more waypoints than room for their numbers.
    every = _NUMBERED * max(1, round(last / 160))
    far_m = _LABEL * float(np.ptp(course.outer, axis=0).max())
    notes: list[Annotation] = []
    for k in range(0, last - every // 2 if course.closed else last, every):
        sides = []
        for border in (course.outer, course.inner):
            aside = border[k] - course.waypoints[k]
            sides.append(border[k] + far_m * aside / max(float(np.linalg.norm(aside)), 1e-9))
        # On the side with more room to other parts of the road.
        rooms = [float(np.linalg.norm(course.waypoints - side, axis=1).min()) for side in sides]
        x, y = sides[int(rooms[1] > 1.05 * rooms[0])].tolist()
        if all(np.hypot(other["x"] - x, other["y"] - y) > far_m for other in notes):
            notes.append(note((x, y), str(k)))
    return notes
