"""Charts on paper."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from .chart import FAINT, INK, Band, Bars, Cells, Chart, Line, Mark, Note, Panel, Points, Road, Values
from .chart_layout import (
    DIVERGING,
    GRID,
    ROAD_CENTER,
    ROAD_EDGE,
    ROAD_FILL,
    SCALE,
    SPINE,
    WIDTH_IN,
    bar_width,
    categories,
    color_range,
    extent,
    legend_names,
    places,
    row_heights,
    word_places,
    wound,
)

_COLORS = LinearSegmentedColormap.from_list("values", SCALE)
_SYMBOLS = {"circle": "o", "cross": "x", "diamond": "D", "triangle": "^", "star": "*"}
_HALO = [withStroke(linewidth=3.0, foreground="white")]
_WORD: dict[str, Any] = {
    **{"textcoords": "offset points", "fontsize": 10, "path_effects": _HALO, "zorder": 7},
    # A mark out of sight has no word.
    "annotation_clip": True,
    "clip_on": True,
}


def draw(chart: Chart) -> Figure:
    """Draw a chart, 12 inches wide; its caption is for the text around it."""
    heads = [max(_head(panel, len(row)) for panel in row) for row in chart.rows]
    feet = [
        0.85 if any(panel.x_label or categories(panel, "x") for panel in row) else 0.35 for row in chart.rows
    ]
    height = sum(row_heights(chart.rows)) + sum(heads) + sum(feet) + 0.45
    figure = Figure(
        figsize=(WIDTH_IN, height), dpi=150, layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08)
    )
    figure.suptitle(
        chart.title, x=0.012, ha="left", fontsize=15, fontweight="bold", color=INK, linespacing=1.3
    )
    columns = math.lcm(*(len(row) for row in chart.rows))
    grid = figure.add_gridspec(len(chart.rows), columns, height_ratios=row_heights(chart.rows))
    firsts: dict[tuple[int, int], Axes] = {}
    for number, row in enumerate(chart.rows):
        span = columns // len(row)
        for column, panel in enumerate(row):
            place = grid[number, column * span : (column + 1) * span]
            first = firsts.get((len(row), column)) if chart.share_x else None
            axes = figure.add_subplot(place, sharex=first)
            firsts.setdefault((len(row), column), axes)
            _draw_panel(axes, panel, len(row))
    return figure


def _head(panel: Panel, columns: int) -> float:
    """Return how high title and legend of a panel are, inches."""
    rows = math.ceil(len(legend_names(panel)) / _legend_columns(panel, columns))
    return 0.12 + 0.3 * bool(panel.title) + 0.23 * rows


def _legend_columns(panel: Panel, columns: int) -> int:
    names = legend_names(panel)
    widths = [0.085 * len(name) + 0.5 for name in names]
    room = WIDTH_IN / columns - 1.3
    if sum(widths) <= room:
        return max(1, len(names))
    return max(1, int(room / max(widths)))


def _draw_panel(axes: Axes, panel: Panel, columns: int) -> None:
    for order, layer in enumerate(panel.layers):
        _draw_layer(axes, panel, layer, 1.5 + 0.05 * order)
    axes.tick_params(length=0, labelcolor=FAINT, labelsize=10.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(SPINE)
    axes.set_axisbelow(True)
    if panel.map:
        left, right, bottom, top = extent(panel)
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        axes.set_axis_off()
    else:
        _draw_axes(axes, panel, columns)
    names = legend_names(panel)
    rows = math.ceil(len(names) / _legend_columns(panel, columns))
    if panel.title:
        axes.set_title(
            panel.title, loc="left", fontsize=12, fontweight="bold", color=INK, pad=7 + (16.5 * rows)
        )
    if names:
        legend = axes.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=_legend_columns(panel, columns),
            frameon=False,
            fontsize=10.5,
            labelcolor=INK,
            borderaxespad=0.15,
            borderpad=0.1,
            labelspacing=0.3,
            columnspacing=1.6,
            handlelength=1.8,
        )
        for handle in legend.legend_handles:
            if isinstance(handle, PathCollection):
                handle.set_sizes([36.0])
                handle.set_alpha(1.0)
    _draw_marks(axes, panel, columns)


def _draw_axes(axes: Axes, panel: Panel, columns: int) -> None:
    axes.set_xlabel(panel.x_label, color=INK, fontsize=11)
    axes.set_ylabel(panel.y_label, color=INK, fontsize=11)
    heat = any(isinstance(layer, Cells) for layer in panel.layers)
    if not heat:
        axes.grid(axis="both", color=GRID, linewidth=0.8)
    for axis, names in ((axes.xaxis, categories(panel, "x")), (axes.yaxis, categories(panel, "y"))):
        if not names:
            axis.set_major_locator(MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]))
            continue
        axis.set_ticks(range(len(names)), names)
        axis.grid(visible=False)
    if panel.x_range is not None:
        axes.set_xlim(*panel.x_range)
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    names = categories(panel, "x")
    if names and 0.085 * len(names) * (max(map(len, names)) + 2) > WIDTH_IN / columns - 1.4:
        axes.tick_params(axis="x", rotation=30)
        for label in axes.get_xticklabels():
            label.set(ha="right", rotation_mode="anchor")


def _draw_layer(axes: Axes, panel: Panel, layer: object, order: float) -> None:
    match layer:
        case Line():
            _draw_line(axes, layer, order)
        case Points():
            _draw_points(axes, layer, order)
        case Band():
            axes.fill_between(
                layer.x,
                layer.low,
                layer.high,
                color=layer.color,
                alpha=0.2,
                linewidth=0,
                label=layer.name,
                zorder=order,
            )
        case Bars():
            x = places(layer.x, categories(panel, "x"))
            drawn = axes.bar(
                x,
                layer.height,
                width=bar_width(layer, x),
                bottom=layer.base,
                color=layer.color,
                edgecolor="white",
                linewidth=0.4,
                label=layer.name,
                zorder=order,
            )
            if layer.base is not None:
                # Every base would be an edge at which the axis may end.
                for bar in drawn:
                    bar.sticky_edges.y[:] = [0.0]
        case Cells():
            _draw_cells(axes, panel, layer, order)
        case Road():
            _draw_road(axes, layer)
        case Note():
            axes.text(
                layer.x,
                layer.y,
                layer.text,
                fontsize=10,
                color=INK,
                ha="center",
                va="center",
                path_effects=_HALO,
                clip_on=True,
                zorder=6,
            )


def _draw_line(axes: Axes, line: Line, order: float) -> None:
    axes.plot(
        line.x,
        line.y,
        color=line.color,
        linewidth=line.width,
        linestyle=(0, (4.5, 2.5)) if line.dashed else "-",
        drawstyle="steps-post" if line.steps else "default",
        # Known values between unknown ones are points, and a point has no line.
        marker="o" if len(line.x) < 3 else "",
        markersize=4,
        label=line.name,
        solid_joinstyle="round",
        zorder=order,
    )


def _draw_points(axes: Axes, points: Points, order: float) -> None:
    cross = points.symbol == "cross"
    drawn = axes.scatter(
        points.x,
        points.y,
        s=points.size**2,
        marker=_SYMBOLS[points.symbol],
        linewidths=1.6 if cross else 0.0,
        color=points.color if points.values is None else None,
        c=points.values,
        cmap=None if points.values is None else _COLORS,
        alpha=0.45 if len(points.x) > 500 and points.values is None else 0.9,
        label=points.name,
        zorder=order,
        rasterized=len(points.x) > 2000,
    )
    if points.values is not None:
        drawn.set_clim(*color_range(points))
        _color_bar(axes, drawn, points.values, points.scale or "")


def _draw_cells(axes: Axes, panel: Panel, cells: Cells, order: float) -> None:
    x, y = places(cells.x, categories(panel, "x")), places(cells.y, categories(panel, "y"))
    low, high = color_range(cells)
    mesh = axes.pcolormesh(
        _edges(x),
        _edges(y),
        np.ma.masked_invalid(cells.values),
        cmap=DIVERGING if cells.diverging else _COLORS,
        vmin=low,
        vmax=high,
        linewidth=0,
        rasterized=True,
        zorder=order,
    )
    if categories(panel, "y"):
        axes.set_ylim(len(y) - 0.5, -0.5)
    _color_bar(axes, mesh, cells.values, cells.scale)
    if not cells.written:
        return
    colors = np.asarray(mesh.to_rgba(np.nan_to_num(cells.values)))
    for (row, column), value in np.ndenumerate(cells.values):
        if np.isfinite(value):
            red, green, blue, _ = colors[row, column]
            light = 0.299 * red + 0.587 * green + 0.114 * blue > 0.55
            axes.text(
                float(x[column]),
                float(y[row]),
                f"{value:.3g}",
                ha="center",
                va="center",
                fontsize=10,
                color=INK if light else "white",
                zorder=order + 0.5,
            )


def _edges(centers: Values) -> Values:
    if len(centers) == 1:
        return np.array([centers[0] - 0.5, centers[0] + 0.5])
    middle = (centers[:-1] + centers[1:]) / 2
    return np.concatenate([[2 * centers[0] - middle[0]], middle, [2 * centers[-1] - middle[-1]]])


def _draw_road(axes: Axes, road: Road) -> None:
    outline = Path.make_compound_path(*(Path(ring, closed=True) for ring in wound(road.rings)))
    axes.add_patch(PathPatch(outline, facecolor=ROAD_FILL, edgecolor=ROAD_EDGE, linewidth=1.2, zorder=1.1))
    axes.plot(*road.center.T, color=ROAD_CENTER, linewidth=0.9, dashes=(5, 4), zorder=1.2)
    axes.autoscale_view()


def _color_bar(axes: Axes, drawn: ScalarMappable, values: Values, label: str) -> None:
    low, high = drawn.get_clim()
    below, above = bool(np.nanmin(values, initial=low) < low), bool(np.nanmax(values, initial=high) > high)
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    place = axes.inset_axes((1.015, 0.02, 0.022, 0.96))
    bar = axes.figure.colorbar(drawn, cax=place, extend=extend[below, above])
    bar.outline.set_visible(False)
    if bar.solids is not None:
        bar.solids.set(alpha=1.0)
    bar.ax.tick_params(length=0, labelcolor=FAINT, labelsize=10)
    bar.set_label(label, color=INK, fontsize=10.5)


def _draw_marks(axes: Axes, panel: Panel, columns: int) -> None:
    marks = [layer for layer in panel.layers if isinstance(layer, Mark)]
    upright = sorted((mark for mark in marks if not mark.horizontal), key=lambda mark: mark.at)
    for mark in marks:
        draw_line = axes.axhline if mark.horizontal else axes.axvline
        draw_line(mark.at, color=mark.color, linewidth=1.5, linestyle=(0, (5, 2)), zorder=4)
    left, right = axes.get_xlim()
    upright = [mark for mark in upright if mark.label]
    room = 0.21 * (right - left) / (WIDTH_IN / columns - 1.6)
    words = word_places([mark.at for mark in upright], left, right, room)
    for mark, (side, level) in zip(upright, words, strict=True):
        axes.annotate(
            mark.label,
            xy=(mark.at, 0.99 - 0.34 * level),
            xycoords=axes.get_xaxis_transform(),
            xytext=(-2 if side == "left" else 2, 0),
            rotation=90,
            ha="right" if side == "left" else "left",
            va="top",
            color=INK,
            **_WORD,
        )
    for mark in marks:
        if mark.horizontal:
            axes.annotate(
                mark.label,
                xy=(0.995, mark.at),
                xycoords=axes.get_yaxis_transform(),
                xytext=(0, 3),
                ha="right",
                va="bottom",
                color=INK,
                **_WORD,
            )
