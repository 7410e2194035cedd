"""The layout of a chart on a page: panels in rows with titles, legends and colour bars, for a desk and for a phone."""

import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from deepracer_exp.reports.tables.comparison import shortened

from .figure import Annotation, Chart, Layer, Panel, Trace
from .style import FAINT, GRID, INK, SPINE, WIDTH, Figure, base_layout, escaped

# All in pixels. Letters have mean widths: 9 in a panel's title, 7 in legends and names.
_LEFT, _RIGHT, _COLOR_BAR = 74.0, 14.0, 86.0
"""Room beside the axes of a panel: for its numbers to the left, free to the right, and for a colour bar there."""
_LEGEND_ROW, _TITLE_ROW = 21.0, 24.0


def draw(chart: Chart, width: float = WIDTH) -> Figure:
    """Draw a chart as wide as its page, in pixels; its caption is for the text around it.

    Below `WIDTH` all panels stand below each other; the traces are the same.
    """
    narrow = width < WIDTH
    shape = [[panel] for row in chart.rows for panel in row] if narrow else chart.rows
    rows = [[_Box(panel, width / len(row), len(row), len(shape), narrow) for panel in row] for row in shape]
    layout = base_layout(escaped(chart.title), width)
    top = 46.0 + 20.0 * layout["title"]["text"].count("<br>")
    heights = [[max(getattr(box, part) for box in row) for part in ("head", "body", "foot")] for row in rows]
    total = top + sum(map(sum, heights))
    layout["title"] |= {"y": 1 - 22 / total, "yref": "container"}
    layout |= {
        "height": round(total),
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "barmode": "overlay",
        "hovermode": "closest",
        "shapes": [],
        "annotations": [],
    }
    figure: Figure = {"data": [], "layout": layout}
    columns = [(len(row), column) for row in chart.rows for column in range(len(row))]
    number = 0
    for row, (head, body, foot) in zip(rows, heights, strict=True):
        top += head
        for column, box in enumerate(row):
            number += 1
            axes = _Axes(
                suffix=str(number) if number > 1 else "",
                x=((column * box.width + box.left) / width, ((column + 1) * box.width - box.right) / width),
                y=(1 - (top + body) / total, 1 - top / total),
                width=width,
                height=total,
            )
            _draw_panel(figure, box, axes)
            first = columns.index(columns[number - 1]) + 1
            if chart.share_x and first != number:
                layout[f"xaxis{axes.suffix}"]["matches"] = "x" if first == 1 else f"x{first}"
        top += body + foot
    return figure


@dataclass(frozen=True)
class _Box:
    """The space of a panel in pixels."""

    panel: Panel
    width: float
    """Width of its column."""
    columns: int
    rows: int
    narrow: bool

    @cached_property
    def names(self) -> list[str]:
        """Return the names in the legend; annotations are never there."""
        return [layer["name"] for layer in self.panel.layers if layer.get("showlegend")]

    @cached_property
    def legend_rows_along(self) -> int:
        """Return the rows of a legend along the panel: one, or columns as wide as the longest name."""
        widths = [7.0 * len(name) + 46.0 for name in self.names]
        room = self.width - 60.0
        if sum(widths) <= room:
            return min(len(widths), 1)
        return math.ceil(len(widths) / max(1.0, room // max(widths)))

    @property
    def upright(self) -> bool:
        """Return whether the legend runs downwards: there are panels beside it, and it does not fit into one row."""
        return self.columns > 1 and self.legend_rows_along > 1

    @property
    def legend(self) -> float:
        return _LEGEND_ROW * (len(self.names) if self.upright else self.legend_rows_along)

    @property
    def title(self) -> list[str]:
        return textwrap.wrap(self.panel.title, round((self.width - _LEFT) / 9.0))

    @property
    def head(self) -> float:
        return 10.0 + _TITLE_ROW * len(self.title) + self.legend

    @property
    def body(self) -> float:
        """Return the height of the axes: that of the course on a map, and room for all names."""
        panel = self.panel
        if panel.map and panel.x_range and panel.y_range:
            shape = (panel.y_range[1] - panel.y_range[0]) / (panel.x_range[1] - panel.x_range[0])
            return min(max((self.width - 84.0) * shape, 218.0), 386.0 if self.rows > 1 else 546.0)
        least = 76.0 + 28.6 * len(panel.y_names) if panel.y_names else 0.0
        return max(least, 160.0 if self.rows > 3 else 210.0 if self.rows > 1 or self.narrow else 370.0)

    @property
    def slanted(self) -> bool:
        """Return whether the names along x do not fit beside each other."""
        return sum(7.0 * len(name) + 14.0 for name in self.panel.x_names) > self.width - _LEFT

    @property
    def foot(self) -> float:
        """Return the height of the numbers or names and of the label below."""
        names = 14.0 + 4.2 * max(map(len, self.panel.x_names)) if self.slanted else 26.0
        return names + (24.0 if self.panel.x_label else 4.0)

    @property
    def left(self) -> float:
        """Return the width of the numbers or names and of the label to the left."""
        if self.panel.map:
            return 8.0
        longest = max(map(len, self.panel.y_names), default=0)
        room = max(_LEFT, 24.0 + 7.2 * longest + (20.0 if self.panel.y_label else 0.0))
        return min(room, 0.45 * self.width * self.columns)

    @property
    def right(self) -> float:
        return _RIGHT + (_COLOR_BAR if any(map(_scaled, self.panel.layers)) else 0.0)


@dataclass(frozen=True, kw_only=True)
class _Axes:
    """Position of a panel's axes in the figure: shares of its width and height, which are in pixels."""

    suffix: str
    x: tuple[float, float]
    y: tuple[float, float]
    width: float
    height: float


def _draw_panel(figure: Figure, box: _Box, axes: _Axes) -> None:
    x_name, y_name, legend = f"x{axes.suffix}", f"y{axes.suffix}", f"legend{axes.suffix}"
    data, layout = figure["data"], figure["layout"]
    layout |= _axis_styles(box, axes)
    _draw_title_and_legend(layout, box, axes)
    for layer in box.panel.layers:
        if isinstance(layer, Trace):
            trace = {**layer, "xaxis": x_name, "yaxis": y_name}
            if trace["type"] != "heatmap":
                trace["legend"] = legend
            if (scaled := _scaled(layer)) is not None:
                # In the layout, because that of a phone has the bar at another place.
                color_axis = f"coloraxis{len(data) + 2}"
                layout[color_axis] = _color_axis(scaled, axes)
                referring = {**scaled, "coloraxis": color_axis, "colorscale": None, "colorbar": None}
                trace |= referring if scaled is layer else {"marker": referring}
            data.append(trace)
            continue
        item = {
            **layer,
            "xref": layer["xref"].replace("x", x_name),
            "yref": layer["yref"].replace("y", y_name),
        }
        if isinstance(layer, Annotation):
            layout["annotations"].append(item)
        else:
            layout["shapes"].append(item | ({"legend": legend} if layer.get("showlegend") else {}))


def _scaled(layer: Layer) -> dict[str, Any] | None:
    """Return the part of a trace that has a colour scale, None where there is none."""
    part = layer if layer.get("type") == "heatmap" else layer.get("marker", {})
    return part if "colorscale" in part else None


def _color_axis(scaled: Mapping[str, Any], axes: _Axes) -> dict[str, Any]:
    ends = ("zmin", "zmax") if "zmin" in scaled else ("cmin", "cmax")
    bar = {
        "title": {"text": scaled["colorbar"]["title"]["text"], "side": "right", "font": {"size": 12}},
        "x": axes.x[1] + 6.0 / axes.width,
        "xanchor": "left",
        "y": sum(axes.y) / 2,
        "len": 0.96 * (axes.y[1] - axes.y[0]),
        "thickness": 13,
        "outlinewidth": 0,
        "xpad": 0,
        "ypad": 0,
        "tickfont": {"size": 11, "color": FAINT},
    }
    low, high = (scaled[end] for end in ends)
    colors = scaled["colorscale"]
    scale = [
        [share, color] for share, color in zip(np.linspace(0, 1, len(colors)).tolist(), colors, strict=True)
    ]
    return {"cmin": low, "cmax": high, "colorscale": scale, "colorbar": bar}


def _axis_styles(box: _Box, axes: _Axes) -> dict[str, Any]:
    panel = box.panel
    heat = any(layer.get("type") == "heatmap" for layer in panel.layers)
    styles: list[dict[str, Any]] = []
    letters = max(16, int((box.left - 24.0) / 7.2))
    y_names = [shortened(name, letters) for name in panel.y_names]
    for label, names in ((panel.x_label, panel.x_names), (panel.y_label, y_names)):
        style: dict[str, Any] = {
            "title": {"text": escaped(label), "standoff": 6, "font": {"size": 13}},
            "gridcolor": GRID,
            "linecolor": SPINE,
            "zeroline": False,
            "tickfont": {"color": FAINT, "size": 12},
            "hoverformat": ".6~g",
            "showline": True,
            "ticks": "",
            "visible": not panel.map,
            "constrain": "domain" if panel.map else None,
            "showgrid": not (heat or names),
        }
        if names:
            style |= {"tickvals": list(range(len(names))), "ticktext": [escaped(name) for name in names]}
        styles.append(style)
    x, y = styles
    x |= {"domain": axes.x, "anchor": f"y{axes.suffix}", "range": panel.x_range}
    y |= {"domain": axes.y, "anchor": f"x{axes.suffix}", "range": panel.y_range}
    if panel.y_names:
        y["range"] = (len(panel.y_names) - 0.5, -0.5)
    if panel.map:
        y["scaleanchor"] = f"x{axes.suffix}"
    if box.slanted:
        x["tickangle"] = -30
    return {f"xaxis{axes.suffix}": x, f"yaxis{axes.suffix}": y}


def _draw_title_and_legend(layout: dict[str, Any], box: _Box, axes: _Axes) -> None:
    legend = {
        "x": axes.x[0],
        "y": axes.y[1] + (box.legend + 4.0 if box.upright else 2.0) / axes.height,
        "xanchor": "left",
        "yanchor": "top" if box.upright else "bottom",
        "orientation": "v" if box.upright else "h",
        "font": {"size": 12, "color": INK},
        "itemsizing": "constant",
        "bgcolor": "rgba(0,0,0,0)",
        "tracegroupgap": 0,
    }
    layout[f"legend{axes.suffix}"] = legend
    if box.title:
        title = {
            "text": "<b>" + "<br>".join(map(escaped, box.title)) + "</b>",
            "showarrow": False,
            "align": "left",
            "x": axes.x[0],
            "y": axes.y[1] + (box.legend + 6.0) / axes.height,
            "xref": "paper",
            "yref": "paper",
            "xanchor": "left",
            "yanchor": "bottom",
            "font": {"size": 14, "color": INK},
        }
        layout["annotations"].append(title)
