"""What both ways to draw a chart work out first: sizes, ranges of colours, names along an axis."""

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
from matplotlib.path import Path

from .chart import Band, Bars, Cells, Line, Note, Panel, Points, Road, Values

DIVERGING = "PuOr"
"""Readers who see no red or no green tell its ends apart."""
SCALE = (
    *("#440154", "#482878", "#3e4a89", "#31688e", "#26828e"),
    *("#1f9e89", "#35b779", "#6dcd59", "#b4de2c", "#dde318"),
)
"""Viridis without the last, palest twentieth, which is hard to see on a road."""
ROAD_FILL, ROAD_EDGE, ROAD_CENTER, GRID, SPINE = "#e6e9ed", "#8d949e", "#a9b0b9", "#e9ecef", "#cdd2d8"
WIDTH_IN = 12.0
_MAP_ROOM_IN = 2.6
"""Least height of a map."""


def categories(panel: Panel, axis: Literal["x", "y"]) -> list[str]:
    """Return the names along an axis; none where it has numbers."""
    names: dict[str, None] = dict.fromkeys(panel.x_names if axis == "x" else ())
    for layer in panel.layers:
        if isinstance(layer, Cells) or (isinstance(layer, Bars) and axis == "x"):
            values = getattr(layer, axis)
            if not isinstance(values, np.ndarray):
                names.update(dict.fromkeys(str(value) for value in values))
    return list(names)


def places(values: Values | Sequence[str], names: Sequence[str]) -> Values:
    """Return where values stand on an axis; names count from 0."""
    if isinstance(values, np.ndarray):
        return values.astype(np.float64)
    return np.array([names.index(str(value)) for value in values], dtype=np.float64)


def color_range(layer: Points | Cells) -> tuple[float, float]:
    """Return the values of the first and of the last colour."""
    if layer.value_range is not None:
        return layer.value_range
    values = np.asarray(layer.values, dtype=np.float64)
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    whole = isinstance(layer, Cells) and layer.written
    low, high = (known.min(), known.max()) if whole else np.percentile(known, [1, 99])
    if isinstance(layer, Cells) and layer.diverging:
        reach = max(abs(low), abs(high)) or 1.0
        return -float(reach), float(reach)
    if low == high:
        low, high = low - 0.5, high + 0.5
    return float(low), float(high)


def bar_width(bars: Bars, x: Values) -> float:
    """Return how wide bars are, in units of x."""
    if bars.width is not None:
        return bars.width
    apart = np.diff(np.unique(x))
    return 0.82 * float(apart.min()) if len(apart) else 0.82


def runs(*columns: Values) -> Iterator[slice]:
    """Yield the stretches in which all columns are known."""
    known = np.logical_and.reduce([np.isfinite(column) for column in columns])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        yield slice(int(first), int(last))


def extent(panel: Panel) -> tuple[float, float, float, float]:
    """Return (left, right, bottom, top) of what a map shows, with a small rim."""
    found: list[Values] = []
    for layer in panel.layers:
        if isinstance(layer, Road):
            found += [*layer.rings, layer.center]
        elif isinstance(layer, Line | Points):
            found.append(np.column_stack([layer.x, layer.y]))
        elif isinstance(layer, Cells) and isinstance(layer.x, np.ndarray) and isinstance(layer.y, np.ndarray):
            found.append(np.array([[v.min(), v.max()] for v in (layer.x, layer.y)]).T)
        elif isinstance(layer, Note):
            found.append(np.array([[layer.x, layer.y]]))
    corners = np.concatenate(found) if found else np.zeros((0, 2))
    corners = corners[np.isfinite(corners).all(axis=1)]
    if not len(corners):
        return 0.0, 1.0, 0.0, 1.0
    (left, bottom), (right, top) = corners.min(axis=0), corners.max(axis=0)
    rim = 0.03 * max(right - left, top - bottom, 1e-6)
    left, right = panel.x_range or (left - rim, right + rim)
    bottom, top = panel.y_range or (bottom - rim, top + rim)
    return float(left), float(right), float(bottom), float(top)


def row_heights(rows: Sequence[Sequence[Panel]], width_in: float = WIDTH_IN) -> list[float]:
    """Return the height of the axes of each row of a figure so many inches wide, inches."""
    several = len(rows) > 1
    heights = []
    for row in rows:
        room = width_in / len(row) - 1.0
        here = 1.9 if len(rows) > 3 else 2.5 if several or width_in < WIDTH_IN else 4.4
        if maps := [extent(panel) for panel in row if panel.map]:
            shapes = [(top - bottom) / max(right - left, 1e-9) for left, right, bottom, top in maps]
            here = min(max(room * max(shapes), _MAP_ROOM_IN), 4.6 if several else 6.5)
        for panel in row:
            names = len(categories(panel, "y"))
            here = max(here, 0.9 + 0.34 * names if names else 0.0)
        heights.append(here)
    return heights


def has_scale(panel: Panel) -> bool:
    """Return whether a panel needs a colour bar."""
    return any(
        isinstance(layer, Cells) or (isinstance(layer, Points) and layer.values is not None)
        for layer in panel.layers
    )


def legend_names(panel: Panel) -> list[str]:
    """Return the names in the legend, in order."""
    named = (layer for layer in panel.layers if isinstance(layer, Line | Points | Band | Bars))
    return [layer.name for layer in named if layer.name is not None]


def word_places(
    at: Sequence[float], left: float, right: float, room: float
) -> list[tuple[Literal["left", "right"], int]]:
    """Return on which side of its upright mark each word stands and how many words down, so that all can be read.

    Args:
        at: where the marks are, ascending.
        left: where the axis begins.
        right: where it ends.
        room: that a word takes along the axis.
    """
    found: list[tuple[Literal["left", "right"], int]] = []
    boxes: list[tuple[float, float, int]] = []
    sides: tuple[Literal["left", "right"], ...] = ("right", "left")
    for number, mark in enumerate(at):
        others = [other for n, other in enumerate(at) if n != number]
        costs = {}
        for level in range(3):
            for side in sides:
                low, high = (mark - room, mark) if side == "left" else (mark, mark + room)
                covered = sum(low < other < high for other in others)
                taken = sum(low < last and first < high for first, last, where in boxes if where == level)
                outside = low < left or high > right
                costs[side, level] = 100 * taken + 10 * outside + 3 * covered + 2 * level
        best = min(costs, key=lambda place: costs[place])
        found.append(best)
        boxes.append((mark - room, mark, best[1]) if best[0] == "left" else (mark, mark + room, best[1]))
    return found


def wound(rings: Sequence[Values]) -> list[Values]:
    """Return closed rings, those inside another running the other way, so that they stay empty."""
    outlines = [Path(ring) for ring in rings]
    closed = []
    for number, ring in enumerate(rings):
        inside = sum(
            bool(outline.contains_point(ring[0])) for other, outline in enumerate(outlines) if other != number
        )
        x, y = ring.T
        ccw = float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) > 0
        turned = ring if ccw == (inside % 2 == 0) else ring[::-1]
        closed.append(np.concatenate([turned, turned[:1]]))
    return closed
