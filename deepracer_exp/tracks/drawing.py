"""Pictures of a course: braille for the terminal, or an image file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path as RingPath

from .outline import Outline, Points
from .track import Track

DOT_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of a braille character's dots, 4 rows of 2."""
BLANK = "\N{BRAILLE PATTERN BLANK}"
ARROWS = "→↗↑↖←↙↓↘"
LONG_IN = 12.0
"""Inches of the longer side of the course in a picture."""
NARROW_IN = 7.0
"""Width a picture has at least, for its title."""
HEAD_IN = 0.95
MARGIN = 0.05
"""Margin around the course as a share of its longer side."""
LABEL_PT = 12.0
"""Distance of a waypoint's index from the border in printer's points."""
CHEVRON_M = 4.0
"""Distance between two direction arrows."""
CENTER_COLOR = "#f5a623"


def draw_terminal(track: Track, columns: int, rows: int) -> str:
    """Return a drawing of the course in braille: borders, start line and an arrow in driving direction."""
    outline = Outline.of(track)
    low, high = outline.corners()
    # A character is about twice as high as wide, so that braille dots are square.
    dots = np.array([2 * columns, 4 * rows])
    scale = float(((dots - 1) / np.maximum(high - low, 1e-9)).min())

    def dot(points: np.ndarray) -> np.ndarray:
        places = np.rint((points - low) * scale).astype(np.int64)
        places[:, 1] = round((high - low)[1] * scale) - places[:, 1]
        return places

    width, height = dot(np.array([[high[0], low[1]]]))[0] + 1
    image = np.zeros((-(-height // 4) * 4, -(-width // 2) * 2), bool)
    lines = [*outline.borders, outline.start_line]
    if not track.closed:
        lines.append(np.stack([border[-1] for border in outline.borders]))
    for line in lines:
        x, y = dot(_dense(line, 0.5 / scale)).T
        image[y, x] = True
    cells = image.reshape(image.shape[0] // 4, 4, image.shape[1] // 2, 2)
    codes = 0x2800 + np.einsum("aibj,ij->ab", cells, DOT_BITS)
    text = [[chr(code) for code in line] for line in codes]

    ahead_m = min(0.6 * track.width_m + 4.0 / scale, track.length_m / 2)
    pose = track.start_pose(np.array([ahead_m / track.length_m]))
    column, row = dot(np.array([[pose.x[0], pose.y[0]]]))[0] // (2, 4)
    text[row][column] = ARROWS[round(float(pose.yaw_rad[0]) / (np.pi / 4)) % 8]
    return "\n".join("".join(line).replace(BLANK, " ").rstrip() for line in text)


def draw_picture(track: Track, path: str | Path, driven: np.ndarray | None = None) -> None:
    """Write a picture of the course; the file's ending chooses the format (.png, .svg, .pdf).

    `driven` is a lap to draw on it, x and y in m and speed in m/s, (n, 3), coloured by its speed.

    It shows the road in its floor's colours, borders, centre line, start line, driving direction and
    every tenth waypoint with its index.
    """
    outline = Outline.of(track)
    low, high = outline.corners()
    low, high = outline.corners(MARGIN * (high - low).max())
    width_in, height_in = LONG_IN * (high - low) / (high - low).max()
    points_per_m = 72 * LONG_IN / (high - low).max()
    page_in = np.array([max(width_in, NARROW_IN), height_in + HEAD_IN])
    figure = Figure(figsize=tuple(page_in), dpi=150, facecolor=track.floor.ground_color)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, height_in / page_in[1]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_axis_off()

    line = track.floor.line_color
    border_pt = float(np.clip(0.035 * points_per_m, 1.2, 4.0))
    axes.add_patch(area_patch(outline.rings, facecolor=track.floor.road_color, edgecolor="none"))
    for border in outline.borders:
        axes.plot(*border.T, color=line, linewidth=border_pt, solid_joinstyle="round")
    axes.plot(
        *track.waypoints.T, color=CENTER_COLOR, linewidth=0.7 * border_pt, dashes=(5, 4), dash_capstyle="butt"
    )
    for number, square in enumerate(_start_line(track)):
        axes.add_patch(
            Polygon(square, facecolor="#111111" if number % 2 else "#ffffff", edgecolor="none", zorder=3)
        )
    for chevron in _chevrons(track):
        axes.plot(*chevron.T, color=line, linewidth=1.6 * border_pt, solid_capstyle="round", zorder=3)
    # Every tenth waypoint: a dot on the centre line, its index beside the border.
    tenth = np.arange(0, len(track.waypoints) - track.closed, 10)
    dots_x, dots_y = track.waypoints[tenth[1:]].T  # the first lies on the start line
    axes.scatter(dots_x, dots_y, s=(2.2 * border_pt) ** 2, color=line, zorder=4)
    beside = _roomier_border(track)[tenth]
    aside = beside - track.waypoints[tenth]
    labels = beside + LABEL_PT / points_per_m * aside / np.linalg.norm(aside, axis=1, keepdims=True).clip(
        1e-9
    )
    for index, (x, y) in zip(tenth, labels, strict=True):
        axes.text(x, y, str(index), color=line, fontsize=8, ha="center", va="center")

    if driven is not None:
        _draw_lap(figure, axes, driven, border_pt, line)
    left = 0.35 / page_in[0]
    names = track.title if track.title == track.name else f"{track.title}  ({track.name})"
    figure.text(left, 1 - 0.38 / page_in[1], names, color=line, fontsize=17, fontweight="bold", va="center")
    figure.text(left, 1 - 0.72 / page_in[1], _facts(track), color=line, fontsize=11, va="center")
    figure.savefig(path)


def _draw_lap(figure: Figure, axes: Axes, driven: np.ndarray, width_pt: float, text_color: str) -> None:
    """Draw a line coloured by its speed, and the scale of the colours."""
    points, speed = driven[:, :2], driven[:, 2]
    parts = LineCollection(
        np.stack([points[:-1], points[1:]], axis=1).tolist(),
        array=0.5 * (speed[:-1] + speed[1:]),
        cmap="turbo",
        linewidth=2.0 * width_pt,
        capstyle="round",
        zorder=5,
    )
    axes.add_collection(parts)
    scale = figure.colorbar(parts, cax=figure.add_axes((0.6, 0.965, 0.3, 0.012)), orientation="horizontal")
    scale.set_label("speed (m/s)", color=text_color, fontsize=9)
    scale.ax.tick_params(colors=text_color, labelsize=8)


def _facts(track: Track) -> str:
    width = f"{track.width_m:.2f} m wide"
    if track.width_max_m - track.width_min_m > 0.02 * track.width_m:
        width = f"{track.width_min_m:.2f} to {track.width_max_m:.2f} m wide"
    around = "clockwise" if track.is_clockwise else "counter-clockwise"
    direction = around if track.closed else "open"
    return f"{track.length_m:.2f} m long, {width}, {direction}{', reversed' if track.reversed else ''}"


def _dense(line: np.ndarray, step_m: float) -> np.ndarray:
    """Return points at most `step_m` apart along a polyline."""
    start_m = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    places_m = np.linspace(0.0, start_m[-1], int(start_m[-1] / step_m) + 2)
    return np.column_stack([np.interp(places_m, start_m, line[:, k]) for k in (0, 1)])


def area_patch(rings: Sequence[Points], **style: Any) -> PathPatch:
    """Return an area as a patch of matplotlib."""
    return PathPatch(RingPath.make_compound_path(*(RingPath(ring, closed=True) for ring in rings)), **style)


def _start_line(track: Track) -> np.ndarray:
    """Return two rows of squares (count, 4, 2) across the road at waypoint 0, black and white in turn."""
    across = track.outer[0] - track.inner[0]
    count = 2 * max(2, round(float(np.linalg.norm(across)) / 0.2)) + 1
    yaw = float(track.start_pose(np.zeros(1)).yaw_rad[0])
    ahead = np.array([np.cos(yaw), np.sin(yaw)]) * np.linalg.norm(across) / count
    squares = []
    for row in range(2):
        for k in range(count):
            corner = track.inner[0] + across * k / count + ahead * (row - 1)
            squares.append([corner, corner + across / count, corner + across / count + ahead, corner + ahead])
    return np.array(squares)


def _roomier_border(track: Track) -> np.ndarray:
    """Return for every waypoint its border point on the outside of the bend; on a straight, the outer border's."""
    last = len(track.waypoints) - 1
    index = np.arange(last + 1)[:, None] + (-3, 3)
    behind, ahead = (index % last if track.closed else index.clip(0, last)).T
    inner_m = np.linalg.norm(track.inner[ahead] - track.inner[behind], axis=1)
    outer_m = np.linalg.norm(track.outer[ahead] - track.outer[behind], axis=1)
    return np.where((inner_m > 1.1 * outer_m)[:, None], track.inner, track.outer)


def _chevrons(track: Track) -> np.ndarray:
    """Return arrow heads (count, 3, 2) on the centre line that point in driving direction."""
    size_m = 0.28 * track.width_m
    places = track.width_m / track.length_m + np.arange(max(1, round(track.length_m / CHEVRON_M))) * (
        CHEVRON_M / track.length_m
    )
    pose = track.start_pose(places)
    ahead = np.column_stack([np.cos(pose.yaw_rad), np.sin(pose.yaw_rad)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    tip = np.column_stack([pose.x, pose.y])
    back = tip - size_m * ahead
    return np.stack([back + size_m * left, tip, back - size_m * left], axis=1)
