"""One panel of a chart on a page."""

import html
import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from .chart import FAINT, INK, PAPER, Band, Bars, Cells, Line, Mark, Note, Panel, Points, Road, Values
from .chart_layout import (
    DIVERGING,
    GRID,
    ROAD_CENTER,
    ROAD_EDGE,
    ROAD_FILL,
    SCALE,
    SPINE,
    bar_width,
    categories,
    color_range,
    extent,
    legend_names,
    places,
    runs,
    word_places,
    wound,
)

WIDTH, NARROW_WIDTH = 1040.0, 400.0
"""Pixels for which room is laid out, on a desk and on a phone; the figure takes what it gets."""
LEFT = 74.0
"""Beside axes with numbers, pixels."""
VEIL = "rgba(255,255,255,0.7)"
"""Behind words that stand on data."""
_LEGEND_ROW = 21.0
_TITLE_LETTER = 8.4
"""Mean width of a letter of a panel's title, pixels."""
_SYMBOLS = {"circle": "circle", "cross": "x", "diamond": "diamond", "triangle": "triangle-up", "star": "star"}


def turned(panel: Panel, width: float) -> bool:
    """Return whether the names along x do not fit beside each other on a panel of this width, pixels."""
    names = categories(panel, "x")
    return sum(7.0 * len(name) + 14.0 for name in names) > width - LEFT


def _legend_rows(panel: Panel, width: float) -> int:
    """Return the rows of a legend that runs along the panel: one, or columns as wide as the longest name."""
    widths = [7.0 * len(name) + 46.0 for name in legend_names(panel)]
    room = width - 60.0
    return 1 if sum(widths) <= room else math.ceil(len(widths) / max(1.0, room // max(widths)))


def _upright_legend(panel: Panel, columns: int, width: float) -> bool:
    """Return whether a legend beside others must go down instead of along the row."""
    return columns > 1 and _legend_rows(panel, width) > 1


def _title_lines(panel: Panel, width: float) -> list[str]:
    """Return the title of a panel of this width in lines that fit."""
    return textwrap.wrap(panel.title, round((width - LEFT) / _TITLE_LETTER))


def head(panel: Panel, columns: int, width: float) -> float:
    """Return how high title and legend are, pixels."""
    names = legend_names(panel)
    rows = len(names)
    if names and not _upright_legend(panel, columns, width):
        rows = _legend_rows(panel, width)
    return 10.0 + 24.0 * len(_title_lines(panel, width)) + _LEGEND_ROW * rows


class PanelPlace:
    """Where a panel stands in the figure."""

    def __init__(
        self,
        figure: go.Figure,
        panel: Panel,
        number: int,
        x: tuple[float, float],
        y: tuple[float, float],
        total: float,
        columns: int,
        width: float,
    ) -> None:
        self.figure, self.panel, self.x, self.y, self.total = figure, panel, x, y, total
        self.columns, self.width, self.number = columns, width, number
        suffix = "" if number == 1 else str(number)
        self.x_name, self.y_name, self.legend = f"x{suffix}", f"y{suffix}", f"legend{suffix}"
        axis: dict[str, Any] = {
            "gridcolor": GRID,
            "linecolor": SPINE,
            "zeroline": False,
            "tickfont": {"color": FAINT, "size": 12},
            "title": {"font": {"size": 13}},
            "hoverformat": ".6~g",
            "automargin": False,
            "showline": True,
            "ticks": "",
        }
        x_axis = {**axis, "domain": x, "anchor": self.y_name}
        y_axis = {**axis, "domain": y, "anchor": self.x_name}
        figure.update_layout({f"xaxis{suffix}": x_axis, f"yaxis{suffix}": y_axis})
        self.x_axis, self.y_axis = figure.layout[f"xaxis{suffix}"], figure.layout[f"yaxis{suffix}"]

    def draw_panel(self) -> None:
        """Draw axes, title, legend and all layers."""
        panel = self.panel
        if panel.map:
            left, right, bottom, top = extent(panel)
            self.x_axis.update(range=(left, right), visible=False, constrain="domain")
            self.y_axis.update(
                range=(bottom, top), visible=False, scaleanchor=self.x_name, constrain="domain"
            )
        else:
            self._axes()
        for layer in panel.layers:
            self._layer(layer)
        width = self.width / self.columns
        upright, title = _upright_legend(panel, self.columns, width), _title_lines(panel, width)
        room = head(panel, self.columns, width) - 10.0 - 24.0 * len(title)
        self.figure.update_layout(
            {
                self.legend: {
                    "x": self.x[0],
                    "y": self.y[1] + (2.0 if not upright else room + 4.0) / self.total,
                    "xanchor": "left",
                    "yanchor": "top" if upright else "bottom",
                    "orientation": "v" if upright else "h",
                    "font": {"size": 12, "color": INK},
                    "itemsizing": "constant",
                    "bgcolor": "rgba(0,0,0,0)",
                    "tracegroupgap": 0,
                }
            }
        )
        if title:
            self._write(
                "<b>" + "<br>".join(map(plain, title)) + "</b>",
                align="left",
                x=self.x[0],
                y=self.y[1] + (room + 6.0) / self.total,
                xref="paper",
                yref="paper",
                xanchor="left",
                yanchor="bottom",
                font={"size": 14, "color": INK},
            )

    def _axes(self) -> None:
        panel = self.panel
        self.x_axis.title.text, self.y_axis.title.text = plain(panel.x_label), plain(panel.y_label)
        self.x_axis.title.standoff, self.y_axis.title.standoff = 6, 6
        heat = any(isinstance(layer, Cells) for layer in panel.layers)
        for axis, names in ((self.x_axis, categories(panel, "x")), (self.y_axis, categories(panel, "y"))):
            if names:
                axis.update(tickvals=list(range(len(names))), ticktext=[plain(name) for name in names])
            if heat or names:
                axis.showgrid = False
        if names := categories(panel, "y"):
            self.y_axis.range = (len(names) - 0.5, -0.5)
        if turned(panel, self.width / self.columns):
            self.x_axis.tickangle = -30
        if panel.x_range is not None:
            self.x_axis.range = panel.x_range
        if panel.y_range is not None:
            self.y_axis.range = panel.y_range

    def _write(self, text: str, **where: Any) -> None:
        self.figure.add_annotation(text=text, showarrow=False, **where)

    def _add(self, kind: Any, layer: Any, **values: Any) -> None:
        """Add a trace to the panel."""
        name = getattr(layer, "name", None)
        hover = getattr(layer, "hover", None)
        values["hovertext"] = None if hover is None else [str(text).replace("\n", "<br>") for text in hover]
        values.setdefault("hoverinfo", None if hover is None else "text")
        if kind is not go.Heatmap:
            values |= {"showlegend": name is not None, "legend": self.legend}
        self.figure.add_trace(kind(name=plain(name or ""), xaxis=self.x_name, yaxis=self.y_name, **values))

    def _layer(self, layer: object) -> None:
        match layer:
            case Line():
                self._line(layer)
            case Points():
                self._points(layer)
            case Band():
                self._band(layer)
            case Bars():
                x = places(layer.x, categories(self.panel, "x"))
                self._add(
                    go.Bar,
                    layer,
                    x=_light(x),
                    y=_light(layer.height),
                    base=None if layer.base is None else _light(layer.base),
                    width=bar_width(layer, x),
                    marker={"color": layer.color, "line": {"width": 0.5, "color": PAPER}},
                )
            case Cells():
                self._cells(layer)
            case Road():
                self._road(layer)
            case Mark():
                self._mark(layer)
            case Note():
                self._write(
                    plain(layer.text),
                    x=layer.x,
                    y=layer.y,
                    xref=self.x_name,
                    yref=self.y_name,
                    bgcolor=VEIL,
                    font={"size": 12, "color": INK},
                )

    def _line(self, line: Line) -> None:
        self._add(
            go.Scatter,
            line,
            x=_light(line.x),
            y=_light(line.y),
            # Known values between unknown ones are points, and a point has no line.
            mode="lines" if len(line.x) > 2 else "lines+markers",
            line={
                "color": line.color,
                "width": 1.25 * line.width,
                "dash": "dash" if line.dashed else "solid",
                "shape": "hv" if line.steps else "linear",
            },
        )

    def _points(self, points: Points) -> None:
        marker: dict[str, Any] = {"size": 1.35 * points.size, "symbol": _SYMBOLS[points.symbol]}
        if points.values is None:
            marker |= {"color": points.color, "opacity": 0.45 if len(points.x) > 500 else 0.9}
        else:
            low, high = color_range(points)
            marker |= {
                "color": _light(points.values),
                "coloraxis": self._scale(low, high, SCALE, points.scale or ""),
            }
        extra: dict[str, Any] = {}
        if points.values is not None and points.hover is None:
            extra["hovertemplate"] = f"%{{marker.color:.6~g}}<extra>{plain(points.scale or '')}</extra>"
        self._add(
            go.Scatter,
            points,
            x=_light(points.x),
            y=_light(points.y),
            mode="markers",
            marker=marker,
            **extra,
        )

    def _band(self, band: Band) -> None:
        pieces = list(runs(band.x, band.low, band.high))
        gap = np.array([np.nan])
        x = [np.concatenate([band.x[piece], band.x[piece][::-1], gap]) for piece in pieces]
        y = [np.concatenate([band.low[piece], band.high[piece][::-1], gap]) for piece in pieces]
        if not pieces:
            return
        self._add(
            go.Scatter,
            band,
            x=_light(np.concatenate(x)[:-1]),
            y=_light(np.concatenate(y)[:-1]),
            mode="lines",
            fill="toself",
            line={"width": 0, "color": band.color},
            fillcolor=_faded(band.color, 0.2),
            hoverinfo="skip",
        )

    def _cells(self, cells: Cells) -> None:
        low, high = color_range(cells)
        x, y = categories(self.panel, "x"), categories(self.panel, "y")
        self._add(
            go.Heatmap,
            cells,
            x=_light(places(cells.x, x)),
            y=_light(places(cells.y, y)),
            z=_light(cells.values),
            coloraxis=self._scale(low, high, DIVERGING if cells.diverging else SCALE, cells.scale),
            hoverongaps=False,
            hovertemplate=f"%{{z:.6~g}} {plain(cells.scale)}<extra></extra>",
            texttemplate="%{z:.3~g}" if cells.written else None,
        )

    def _road(self, road: Road) -> None:
        outline = "".join(_path(ring) + "Z" for ring in wound(road.rings))
        self.figure.add_shape(
            type="path",
            path=outline,
            xref=self.x_name,
            yref=self.y_name,
            layer="below",
            fillcolor=ROAD_FILL,
            line={"color": ROAD_EDGE, "width": 1.4},
        )
        # No trace: those stand above every heat map.
        self.figure.add_shape(
            type="path",
            path=_path(road.center),
            xref=self.x_name,
            yref=self.y_name,
            layer="below",
            line={"color": ROAD_CENTER, "width": 1, "dash": "dash"},
        )

    def _scale(self, low: float, high: float, colors: str | Sequence[str], label: str) -> str:
        """Add a colour bar beside the panel to the layout, and return its name."""
        name = f"coloraxis{len(self.figure.data) + 1}"
        bar = {
            "title": {"text": plain(label), "side": "right", "font": {"size": 12}},
            "x": self.x[1] + 6.0 / self.width,
            "xanchor": "left",
            "y": sum(self.y) / 2,
            "len": 0.96 * (self.y[1] - self.y[0]),
            "thickness": 13,
            "outlinewidth": 0,
            "xpad": 0,
            "ypad": 0,
            "tickfont": {"size": 11, "color": FAINT},
        }
        axis = {"cmin": low, "cmax": high, "colorscale": colors, "colorbar": bar}
        self.figure.update_layout({name: axis})
        return name

    def _mark(self, mark: Mark) -> None:
        line = {"color": mark.color, "width": 1.8, "dash": "dash"}
        along = {"x0": 0, "x1": 1, "y0": mark.at, "y1": mark.at}
        if mark.horizontal:
            self.figure.add_shape(
                type="line", xref=f"{self.x_name} domain", yref=self.y_name, line=line, **along
            )
            self._write(
                plain(mark.label),
                x=1.0,
                y=mark.at,
                xref=f"{self.x_name} domain",
                yref=self.y_name,
                xanchor="right",
                yanchor="bottom",
                font={"size": 12, "color": INK},
                bgcolor=VEIL,
                borderpad=0,
            )
            return
        self.figure.add_shape(
            type="line",
            xref=self.x_name,
            yref=f"{self.y_name} domain",
            line=line,
            x0=mark.at,
            x1=mark.at,
            y0=0,
            y1=1,
        )
        if not mark.label:
            return
        side, level = self._word_place(mark)
        self._write(
            plain(mark.label),
            x=mark.at,
            y=0.99 - 0.34 * level,
            xref=self.x_name,
            yref=f"{self.y_name} domain",
            xanchor="right" if side == "left" else "left",
            yanchor="top",
            textangle=-90,
            font={"size": 12, "color": INK},
            bgcolor=VEIL,
            borderpad=0,
        )

    def _word_place(self, mark: Mark) -> tuple[str, int]:
        """Return the side of an upright mark on which its word stands, and how many words down."""
        marks = [layer for layer in self.panel.layers if isinstance(layer, Mark) and not layer.horizontal]
        marks = sorted((other for other in marks if other.label), key=lambda other: other.at)
        left, right = self.panel.x_range or self._ends()
        room = 20.0 / (self.width * (self.x[1] - self.x[0])) * (right - left)
        return word_places([other.at for other in marks], left, right, room)[marks.index(mark)]

    def _ends(self) -> tuple[float, float]:
        """Return the first and the last x of the layers."""
        names = categories(self.panel, "x")
        found = [
            places(layer.x, names)
            for layer in self.panel.layers
            if isinstance(layer, Line | Points | Band | Bars | Cells)
        ]
        x = np.concatenate(found) if found else np.array([0.0, 1.0])
        x = x[np.isfinite(x)]
        return (float(x.min()), float(x.max())) if len(x) else (0.0, 1.0)


def plain(text: str) -> str:
    """Return a text for Plotly, which takes tags and entities for what they are in HTML."""
    return html.escape(text, quote=False).replace("\n", "<br>")


def _light(values: Values) -> NDArray[np.float32]:
    """Return values in half the room: nobody sees more digits."""
    return np.asarray(values, dtype=np.float32)


def _path(points: Values) -> str:
    """Return points as the path of a shape."""
    return "M" + "L".join(f"{x:.3f},{y:.3f}" for x, y in points)


def _faded(color: str, opacity: float) -> str:
    red, green, blue = (int(color[at : at + 2], 16) for at in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity})"
