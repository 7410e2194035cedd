"""The layout of a chart on a page: panels in rows with titles, legends and colour bars, for a desk and for a phone."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import plotly.graph_objects as go

from .figure import Chart, Layer, Panel
from .style import FAINT, GRID, INK, SPINE, WIDTH, base_layout, escaped

_LEFT, _RIGHT, _COLOR_BAR = 74.0, 14.0, 86.0
"""Room beside the axes of a panel for its numbers, for nothing and for a colour bar, pixels."""
_LEGEND_ROW, _TITLE_ROW = 21.0, 24.0
_TITLE_LETTER = 9.0
"""Mean width of a letter of a panel's title, pixels."""


def draw(chart: Chart, width: float = WIDTH) -> go.Figure:
    """Draw a chart as wide as its page; its caption is for the text around it.

    Args:
        chart: what to draw.
        width: pixels for which it is laid out: `WIDTH`, or less with all panels below each other. The traces are the
            same.
    """
    rows = chart.rows if width == WIDTH else [[panel] for row in chart.rows for panel in row]
    heads = [max(_head(panel, width / len(row), len(row)) for panel in row) for row in rows]
    bodies = [max(_body(panel, width / len(row), len(rows), width < WIDTH) for panel in row) for row in rows]
    feet = [max(_foot(panel, width / len(row)) for panel in row) for row in rows]
    layout = base_layout(escaped(chart.title), width)
    top = 46.0 + 20.0 * layout["title"]["text"].count("<br>")
    total = top + sum(heads) + sum(bodies) + sum(feet)
    figure = go.Figure(layout=layout)
    figure.update_layout(
        title={"y": 1 - 22 / total, "yref": "container"},
        height=round(total),
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        barmode="overlay",
        hovermode="closest",
    )
    shared = [(len(row), column) for row in chart.rows for column in range(len(row))]
    first_of: dict[tuple[int, int], str] = {}
    number = 0
    for row, head, body, foot in zip(rows, heads, bodies, feet, strict=True):
        top += head
        for column, panel in enumerate(row):
            number += 1
            left = 8.0 if panel.map else min(_left(panel), 0.45 * width)
            right = _RIGHT + (_COLOR_BAR if any(map(_scaled, panel.layers)) else 0.0)
            place = _Place(
                number=number,
                x=(column / len(row) + left / width, (column + 1) / len(row) - right / width),
                y=(1 - (top + body) / total, 1 - top / total),
                columns=len(row),
                width=width,
                height=total,
            )
            _draw_panel(figure, panel, place)
            if chart.share_x:
                first = first_of.setdefault(shared[number - 1], place.x_name)
                if first != place.x_name:
                    figure.layout[f"xaxis{number}"].matches = first
        top += body + foot
    return figure


@dataclass(frozen=True, kw_only=True)
class _Place:
    """Where a panel stands in the figure."""

    number: int
    """From 1 on."""
    x: tuple[float, float]
    """Ends of the axis, as shares of the figure; likewise `y`."""
    y: tuple[float, float]
    columns: int
    width: float
    """Of the figure, pixels; likewise `height`."""
    height: float

    @property
    def suffix(self) -> str:
        return str(self.number) if self.number > 1 else ""

    @property
    def x_name(self) -> str:
        return f"x{self.suffix}"

    @property
    def y_name(self) -> str:
        return f"y{self.suffix}"

    @property
    def column_width(self) -> float:
        return self.width / self.columns


def _draw_panel(figure: go.Figure, panel: Panel, place: _Place) -> None:
    _draw_axes(figure, panel, place)
    _draw_title_and_legend(figure, panel, place)
    for layer in panel.layers:
        if isinstance(layer, go.layout.Shape | go.layout.Annotation):
            own = layer.to_plotly_json()
            own["xref"] = own["xref"].replace("x", place.x_name)
            own["yref"] = own["yref"].replace("y", place.y_name)
            if isinstance(layer, go.layout.Annotation):
                figure.add_annotation(own)
            else:
                figure.add_shape(own | ({"legend": f"legend{place.suffix}"} if layer.showlegend else {}))
            continue
        figure.add_trace(layer)
        trace = figure.data[-1]
        trace.update(xaxis=place.x_name, yaxis=place.y_name)
        if trace.type != "heatmap":
            trace.legend = f"legend{place.suffix}"
        if (scaled := _scaled(trace)) is not None:
            # In the layout, because that of a phone has the bar at another place.
            axis = f"coloraxis{len(figure.data) + 1}"
            figure.update_layout({axis: _color_axis(scaled, place)})
            scaled.update(coloraxis=axis, colorscale=None, colorbar=None)


def _scaled(layer: Layer) -> Any:
    """Return the part of a trace that has a colour scale, None where there is none."""
    part = layer if isinstance(layer, go.Heatmap) else getattr(layer, "marker", None)
    return part if part is not None and part.colorscale is not None else None


def _color_axis(scaled: Any, place: _Place) -> dict[str, Any]:
    ends = ("zmin", "zmax") if isinstance(scaled, go.Heatmap) else ("cmin", "cmax")
    bar = {
        "title": {"text": scaled.colorbar.title.text, "side": "right", "font": {"size": 12}},
        "x": place.x[1] + 6.0 / place.width,
        "xanchor": "left",
        "y": sum(place.y) / 2,
        "len": 0.96 * (place.y[1] - place.y[0]),
        "thickness": 13,
        "outlinewidth": 0,
        "xpad": 0,
        "ypad": 0,
        "tickfont": {"size": 11, "color": FAINT},
    }
    low, high = (scaled[end] for end in ends)
    return {"cmin": low, "cmax": high, "colorscale": scaled.colorscale, "colorbar": bar}


def _draw_axes(figure: go.Figure, panel: Panel, place: _Place) -> None:
    both: dict[str, Any] = {
        "gridcolor": GRID,
        "linecolor": SPINE,
        "zeroline": False,
        "tickfont": {"color": FAINT, "size": 12},
        "hoverformat": ".6~g",
        "showline": True,
        "ticks": "",
        "visible": not panel.map,
        "constrain": "domain" if panel.map else None,
    }
    heat = any(isinstance(layer, go.Heatmap) for layer in panel.layers)
    axes: list[dict[str, Any]] = []
    for label, names in ((panel.x_label, panel.x_names), (panel.y_label, panel.y_names)):
        axis = both | {"title": {"text": escaped(label), "standoff": 6, "font": {"size": 13}}}
        if names:
            axis |= {"tickvals": list(range(len(names))), "ticktext": [escaped(name) for name in names]}
        axes.append(axis | {"showgrid": not (heat or names)})
    x, y = axes
    x |= {"domain": place.x, "anchor": place.y_name, "range": panel.x_range}
    y |= {"domain": place.y, "anchor": place.x_name, "range": panel.y_range}
    if panel.y_names:
        y["range"] = (len(panel.y_names) - 0.5, -0.5)
    if panel.map:
        y["scaleanchor"] = place.x_name
    if _slanted(panel, place.column_width):
        x["tickangle"] = -30
    figure.update_layout({f"xaxis{place.suffix}": x, f"yaxis{place.suffix}": y})


def _draw_title_and_legend(figure: go.Figure, panel: Panel, place: _Place) -> None:
    title = _title_lines(panel, place.column_width)
    room = _LEGEND_ROW * _legend_rows(panel, place.column_width, place.columns)
    upright = _upright(panel, place.column_width, place.columns)
    legend = {
        "x": place.x[0],
        "y": place.y[1] + (room + 4.0 if upright else 2.0) / place.height,
        "xanchor": "left",
        "yanchor": "top" if upright else "bottom",
        "orientation": "v" if upright else "h",
        "font": {"size": 12, "color": INK},
        "itemsizing": "constant",
        "bgcolor": "rgba(0,0,0,0)",
        "tracegroupgap": 0,
    }
    figure.update_layout({f"legend{place.suffix}": legend})
    if title:
        figure.add_annotation(
            text="<b>" + "<br>".join(map(escaped, title)) + "</b>",
            showarrow=False,
            align="left",
            x=place.x[0],
            y=place.y[1] + (room + 6.0) / place.height,
            xref="paper",
            yref="paper",
            xanchor="left",
            yanchor="bottom",
            font={"size": 14, "color": INK},
        )


def _head(panel: Panel, width: float, columns: int) -> float:
    """Return the height of title and legend of a panel in a column of this width, pixels."""
    legend = _LEGEND_ROW * _legend_rows(panel, width, columns)
    return 10.0 + _TITLE_ROW * len(_title_lines(panel, width)) + legend


def _body(panel: Panel, width: float, rows: int, narrow: bool) -> float:
    """Return the height of the axes, pixels: that of the course on a map, and room for all names."""
    if panel.map and panel.x_range and panel.y_range:
        shape = (panel.y_range[1] - panel.y_range[0]) / (panel.x_range[1] - panel.x_range[0])
        return min(max((width - 84.0) * shape, 218.0), 386.0 if rows > 1 else 546.0)
    least = 76.0 + 28.6 * len(panel.y_names) if panel.y_names else 0.0
    return max(least, 160.0 if rows > 3 else 210.0 if rows > 1 or narrow else 370.0)


def _foot(panel: Panel, width: float) -> float:
    """Return the height of the numbers or names and of the label below, pixels."""
    names = 14.0 + 4.2 * max(map(len, panel.x_names)) if _slanted(panel, width) else 26.0
    return names + (24.0 if panel.x_label else 4.0)


def _left(panel: Panel) -> float:
    """Return the width of the numbers or names and of the label to the left, pixels."""
    longest = max(map(len, panel.y_names), default=0)
    return max(_LEFT, 24.0 + 7.2 * longest + (20.0 if panel.y_label else 0.0))


def _slanted(panel: Panel, width: float) -> bool:
    """Return whether the names along x do not fit beside each other."""
    return sum(7.0 * len(name) + 14.0 for name in panel.x_names) > width - _LEFT


def _title_lines(panel: Panel, width: float) -> list[str]:
    return textwrap.wrap(panel.title, round((width - _LEFT) / _TITLE_LETTER))


def _legend_rows(panel: Panel, width: float, columns: int) -> int:
    """Return how many rows the legend takes; if it is upright, one a name."""
    names = _legend_names(panel)
    return len(names) if _upright(panel, width, columns) else _rows_along(names, width)


def _upright(panel: Panel, width: float, columns: int) -> bool:
    """Return whether the legend must go down, because others stand beside it and it does not fit into one row."""
    return columns > 1 and _rows_along(_legend_names(panel), width) > 1


def _legend_names(panel: Panel) -> list[str]:
    """Return the names in the legend; annotations are never there."""
    return [layer.name for layer in panel.layers if getattr(layer, "showlegend", False)]


def _rows_along(names: Sequence[str], width: float) -> int:
    """Return the rows of a legend along the panel: one, or columns as wide as the longest name."""
    widths = [7.0 * len(name) + 46.0 for name in names]
    room = width - 60.0
    if sum(widths) <= room:
        return min(len(names), 1)
    return math.ceil(len(names) / max(1.0, room // max(widths)))
