"""Charts made of panels, and the traces and shapes in these, as plotly.js reads them, in one style."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.reports.tables.comparison import shortened

from .style import DIVERGING, INK, PAPER, SCALE, VEIL, escaped

_LONGEST_NAME = 48
"""Most letters of a name in a legend, which has no more room in half a page or on a phone."""

_MANY = 500
"""Number of points from which they are drawn half transparent."""


class Trace(dict[str, Any]):
    """A plotly.js trace (points, bars or cells) as a plain dict; Plotly's own objects cost seconds a page."""


class Shape(dict[str, Any]):
    """A plotly.js shape: a line or an area without data."""


class Annotation(dict[str, Any]):
    """A plotly.js annotation: a text at a place."""


Layer: TypeAlias = Trace | Shape | Annotation


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """One pair of axes; the layers refer to them as `x` and `y`."""

    layers: Sequence[Layer]
    x_label: str = ""
    y_label: str = ""
    title: str = ""
    map: bool = False
    """Both axes in m on the same scale and without numbers; a map has both ranges."""
    x_names: Sequence[str] = ()
    """Shown at 0, 1, 2, ... instead of numbers; likewise `y_names`, from top to bottom."""
    y_names: Sequence[str] = ()
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """One figure of a page."""

    name: str
    """Slug, as in links."""
    title: str
    caption: str
    """Two or three sentences that explain the figure."""
    rows: Sequence[Sequence[Panel]]
    """Panels row by row."""
    share_x: bool = False
    """Whether the panels of a column zoom together along x."""

    @property
    def table(self) -> pd.DataFrame:
        """Return the data that is drawn, a row a point: `panel`, `name` in the legend, `x`, `y`, `value` by colour."""
        panels = [panel for row in self.rows for panel in row]
        tables = [
            _data(layer).assign(panel=panel.title or panel.y_label, name=layer.get("name"))
            for panel in panels
            for layer in panel.layers
            if isinstance(layer, Trace)
        ]
        return pd.concat(tables, ignore_index=True)[["panel", "name", "x", "y", "value"]]


def in_rows(panels: Sequence[Panel], columns: int = 2) -> list[Sequence[Panel]]:
    """Return panels in rows of `columns`."""
    return [panels[first : first + columns] for first in range(0, len(panels), columns)]


def line(
    x: ArrayLike,
    y: ArrayLike,
    color: str,
    name: str | None = None,
    *,
    width: float = 2.0,
    dashed: bool = False,
) -> Trace:
    """Return a line through points; NaN interrupts it. Without a name it is not in the legend."""
    x, y = _light(x), _light(y)
    style = {"color": color, "width": width, "dash": "dash" if dashed else "solid"}
    # One or two points would be hard to see as a line.
    return Trace(
        type="scatter", x=x, y=y, mode="lines" if len(x) > 2 else "lines+markers", line=style, **_named(name)
    )


def points(
    x: ArrayLike,
    y: ArrayLike,
    color: str,
    name: str | None = None,
    *,
    size: float = 7.0,
    symbol: str = "circle",
    hover: Sequence[str] | None = None,
) -> Trace:
    """Return points of one colour; `size` is their diameter in pixels."""
    x = _light(x)
    marker = {
        "size": size,
        "symbol": symbol,
        "color": color,
        "opacity": 0.45 if len(x) > _MANY else 0.9,
    }
    return Trace(
        type="scatter", x=x, y=_light(y), mode="markers", marker=marker, **_named(name), **_hover(hover)
    )


def colored_points(
    x: ArrayLike,
    y: ArrayLike,
    values: ArrayLike,
    scale: str,
    *,
    size: float = 8.5,
    value_range: tuple[float, float] | None = None,
    hover: Sequence[str] | None = None,
) -> Trace:
    """Return points coloured by values.

    `scale` names the values with their unit; `value_range` are those of the first and the last colour, without it the
    percentiles 1 and 99.
    """
    low, high = value_range or color_range(values)
    marker = {"size": size, "color": _light(values), "cmin": low, "cmax": high, "colorscale": SCALE}
    marker["colorbar"] = {"title": {"text": escaped(scale)}}
    text = {"hovertemplate": f"%{{marker.color:.6~g}}<extra>{escaped(scale)}</extra>"}
    if hover is not None:
        text = _hover(hover)
    return Trace(
        type="scatter", x=_light(x), y=_light(y), mode="markers", marker=marker, showlegend=False, **text
    )


def band(x: ArrayLike, low: ArrayLike, high: ArrayLike, color: str, name: str | None = None) -> Trace:
    """Return the area between two lines; NaN interrupts it."""
    x, low, high = (np.asarray(values, np.float64) for values in (x, low, high))
    finite = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    around: list[NDArray[np.float64]] = []
    for piece in np.ma.clump_unmasked(np.ma.array(x, mask=~finite)):
        there = np.column_stack([x[piece], low[piece]])
        back = np.column_stack([x[piece], high[piece]])[::-1]
        around += [there, back, np.full((1, 2), np.nan)]
    outline = np.concatenate([*around, np.zeros((0, 2))])
    red, green, blue = (int(color[begin : begin + 2], 16) for begin in (1, 3, 5))
    return Trace(
        type="scatter",
        x=_light(outline[:-1, 0]),
        y=_light(outline[:-1, 1]),
        mode="lines",
        fill="toself",
        line={"width": 0, "color": color},
        fillcolor=f"rgba({red},{green},{blue},0.2)",
        hoverinfo="skip",
        **_named(name),
    )


def bars(
    x: ArrayLike,
    height: ArrayLike,
    color: str,
    name: str | None = None,
    *,
    base: ArrayLike | None = None,
    width: float | None = None,
) -> Trace:
    """Return bars from `base` upwards, so wide in units of x; without a width they almost touch."""
    x = _light(x)
    apart = np.diff(np.unique(x))
    width = width or (0.82 * float(apart.min()) if len(apart) else 0.82)
    marker = {"color": color, "line": {"width": 0.5, "color": PAPER}}
    base = None if base is None else _light(base)
    return Trace(type="bar", x=x, y=_light(height), base=base, width=width, marker=marker, **_named(name))


def heatmap(
    x: ArrayLike,
    y: ArrayLike,
    values: ArrayLike,
    scale: str,
    *,
    written: bool = False,
    diverging: bool = False,
    value_range: tuple[float, float] | None = None,
) -> Trace:
    """Return cells (m, n) coloured by values, with centres x (n,) and y (m,); NaN leaves a cell empty.

    `written` writes each value into its cell, `diverging` puts zero in the middle of the colours; `scale` and
    `value_range` are those of `colored_points`.
    """
    low, high = value_range or color_range(values)
    if diverging:
        low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
    return Trace(
        type="heatmap",
        x=_light(x),
        y=_light(y),
        z=_light(values),
        zmin=low,
        zmax=high,
        colorscale=DIVERGING if diverging else SCALE,
        colorbar={"title": {"text": escaped(scale)}},
        hoverongaps=False,
        hovertemplate=f"%{{z:.6~g}} {escaped(scale)}<extra></extra>",
        texttemplate="%{z:.3~g}" if written else None,
    )


def mark(
    position: float, label: str, color: str, *, horizontal: bool = False, in_legend: bool = False
) -> Shape:
    """Return a dashed line across the panel, labelled at its end or in the legend; an empty label: the line alone."""
    ends = {"xref": "x domain", "x0": 0, "x1": 1, "yref": "y", "y0": position, "y1": position}
    text = {"text": escaped(label), "textposition": "end", "font": {"size": 12, "color": INK}}
    if not horizontal:
        ends = {"xref": "x", "x0": position, "x1": position, "yref": "y domain", "y0": 0, "y1": 1}
        text |= {"xanchor": "right", "yanchor": "top"}  # below the upper end, to the right of the line
    return Shape(
        type="line",
        line={"color": color, "width": 1.8, "dash": "dash"},
        name=escaped(label),
        showlegend=in_legend,
        label=None if in_legend or not label else text,
        **ends,
    )


def note(place: Sequence[float], text: str) -> Annotation:
    """Return a text at a place (2,)."""
    where = {"x": place[0], "y": place[1], "xref": "x", "yref": "y"}
    font = {"size": 12, "color": INK}
    return Annotation(text=escaped(text), showarrow=False, bgcolor=VEIL, font=font, **where)


def _data(trace: Trace) -> pd.DataFrame:
    if trace["type"] == "heatmap":
        x, y = np.meshgrid(trace["x"], trace["y"])
        return pd.DataFrame({"x": x.ravel(), "y": y.ravel(), "value": trace["z"].ravel()}).dropna()
    color = trace.get("marker", {}).get("color")
    values = color if isinstance(color, np.ndarray) else np.nan
    return pd.DataFrame({"x": trace["x"], "y": trace["y"], "value": values})


def _light(values: ArrayLike) -> NDArray[np.float32]:
    """Return values in single precision, half the size; more digits cannot be seen."""
    return np.asarray(values, dtype=np.float32)


def _named(name: str | None) -> dict[str, Any]:
    return {"name": escaped(shortened(name or "", _LONGEST_NAME)), "showlegend": name is not None}


def _hover(hover: Sequence[str] | None) -> dict[str, Any]:
    if hover is None:
        return {}
    return {"hovertext": [text.replace("\n", "<br>") for text in hover], "hoverinfo": "text"}


def color_range(values: ArrayLike) -> tuple[float, float]:
    """Return the percentiles 1 and 99 of the known values, a little apart where they are equal."""
    numbers = np.asarray(values, np.float64)
    numbers = numbers[np.isfinite(numbers)]
    low, high = np.percentile(numbers, [1, 99]).tolist() if len(numbers) else (0.0, 1.0)
    return (low, high) if low < high else (low - 0.5, high + 0.5)
