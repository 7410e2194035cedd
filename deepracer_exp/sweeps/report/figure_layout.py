"""The layout of a study's figures as plotly.js reads it: their style, panels in a grid, and names below them."""

import copy
import html
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from deepracer_exp.analysis.charts.style import CATEGORIES, GRID, NARROW_WIDTH, SPINE, Figure, base_layout

PANEL = 210.0
"""Height of a panel, pixels."""
COLUMNS = 3
LONGEST_CHOICE = 16
"""Characters of a choice that fit between two parallel axes."""
_PER_AXIS = 120
"""Pixels from one parallel axis to the next."""
_GAP = 62.0
"""Distance between two panels, pixels."""
_PANEL_WIDTH, _NARROW_PANEL_WIDTH = 260.0, 160.0
"""Least width of a panel on a wide and on a narrow screen, pixels."""
_CHARACTER, _LINE = 6.3, 13.0
"""Width of a character and height of a line of the labels below a panel, pixels."""
_FEWEST_UPRIGHT = 9
"""Characters that must fit below each choice for its name to be written upright; else it is turned."""

Axis = dict[str, Any]
Trace = dict[str, Any]


def styled(
    traces: Sequence[Trace],
    title: str,
    height: float,
    axes: Mapping[str, Axis] | None = None,
    *,
    legend: bool = True,
    margin: Mapping[str, float] | None = None,
) -> Figure:
    """Return a figure of traces in the style that all share.

    Args:
        traces: by the keys of plotly.js.
        title: of the figure.
        height: pixels.
        axes: what is special to each axis, by its name in the layout (`xaxis`, `yaxis2`); a `title` is its text alone.
        legend: whether it has one.
        margin: pixels, of the sides that differ.
    """
    layout = base_layout(title) | {
        "meta": {"title": title},
        "height": round(height),
        "margin": {"l": 70, "r": 20, "t": 60, "b": 60} | dict(margin or {}),
        "showlegend": legend,
        "legend": {"itemsizing": "constant", "font": {"size": 13}},
        "colorway": CATEGORIES,
    }
    for name, axis in (axes or {}).items():
        text = {"text": axis.get("title", ""), "font": {"size": 13}, "standoff": axis.get("standoff")}
        special = {key: value for key, value in axis.items() if key not in ("title", "standoff")}
        layout[name] = {"gridcolor": GRID, "zeroline": False, "linecolor": SPINE, **special, "title": text}
    return {"data": list(traces), "layout": layout}


def narrowed(figure: Figure) -> Figure:
    """Return a figure with a layout for a narrow screen: its panels below each other, the legend below them."""
    desk = figure["layout"]
    layout = copy.deepcopy(desk) | base_layout(desk["meta"]["title"], NARROW_WIDTH)
    margin = desk["margin"]
    head = margin["t"] + 20.0 * layout["title"]["text"].count("<br>")
    names = {trace["name"] for trace in figure["data"] if trace.get("name")} if desk["showlegend"] else ()
    foot = margin["b"] + 22.0 * len(names)
    body = desk["height"] - margin["t"] - margin["b"]
    for axis in _x_axes(layout):
        if axis.get("type") == "category":
            _write_choices(axis, _NARROW_PANEL_WIDTH)
    if len(panels := _panels(layout)) > 1:
        body = _arrange(layout, panels, 1)
    layout |= {
        "height": round(head + body + foot),
        "margin": {"l": 62, "r": 12, "t": head, "b": foot},
        "legend": desk["legend"] | {"orientation": "h", "x": 0, "y": -margin["b"] / body, "yanchor": "top"},
    }
    return {"data": figure["data"], "layout": layout}


def least_width(figure: Figure) -> int:
    """Return the pixels below which a figure cannot be read: each parallel axis needs room for its values."""
    parallel = (trace for trace in figure["data"] if trace["type"] == "parcoords")
    return max((_PER_AXIS * len(trace["dimensions"]) for trace in parallel), default=0)


def arrange_panels(figure: Figure) -> None:
    """Lay out the panels of a figure in a grid of `COLUMNS`, with the choices of their parameters below them."""
    layout = figure["layout"]
    for axis in _x_axes(layout):
        if axis.get("type") == "category":
            _write_choices(axis, _PANEL_WIDTH)
    panels = _panels(layout)
    body = _arrange(layout, panels, min(COLUMNS, len(panels)))
    foot = _label_height(layout)
    layout["height"] = round(body + layout["margin"]["t"] + foot)
    layout["margin"]["b"] = foot


def decades(values: Sequence[float]) -> Axis:
    """Return the ticks of a logarithmic axis: up to four powers of ten, or the ends where it has less than two."""
    low, high = min(values), max(values)
    powers = range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1)
    if len(powers) < 2:
        return {"tickvals": [low, high], "ticktext": [f"{low:.2g}", f"{high:.2g}"]}
    some = list(powers)[:: math.ceil(len(powers) / 4)]
    return {
        "tickvals": [10.0**power for power in some],
        "ticktext": [f"10<sup>{power}</sup>" for power in some],
    }


def wrapped(text: str, width: int) -> str:
    """Return a text in up to four lines of at most `width` characters, broken after `_`, `-` and `,` if possible."""
    lines = [""]
    for part in re.split(r"(?<=[_,\- ])", text):
        while part:
            room = width - len(lines[-1])
            if len(part) > room and lines[-1]:
                lines.append("")
                continue
            lines[-1] += part[:room]
            part = part[room:]
    if len(lines) > 4:
        lines = [*lines[:3], f"{lines[3][: width - 1]}…"]
    return "<br>".join(html.escape(line, quote=False) for line in lines)


def plain(text: object, longest: int = 90) -> str:
    """Return a text escaped for Plotly, which reads tags and entities as HTML."""
    cut = str(text) if len(str(text)) <= longest else f"{str(text)[: longest - 1]}…"
    return html.escape(cut, quote=False)


def _x_axes(layout: Mapping[str, Any]) -> list[Axis]:
    return [axis for name, axis in layout.items() if name.startswith("xaxis")]


def _panels(layout: Mapping[str, Any]) -> list[str]:
    """Return the numbers of a layout's pairs of axes, as Plotly names them: "", "2", "3", ..."""
    return [name.removeprefix("xaxis") for name in layout if name.startswith("xaxis")]


def _arrange(layout: dict[str, Any], panels: Sequence[str], columns: int) -> float:
    """Arrange panels in a grid; return its height, pixels."""
    gap = _label_height(layout)
    body = math.ceil(len(panels) / columns) * (PANEL + gap) - gap
    for index, number in enumerate(panels):
        row, column = divmod(index, columns)
        top = 1 - row * (PANEL + gap) / body
        domain = column / columns + 0.03 * (column > 0), (column + 1) / columns - 0.01 * (columns > 1)
        rows = {"domain": (max(0.0, top - PANEL / body), top), "showticklabels": column == 0}
        layout[f"yaxis{number}"] |= rows
        layout[f"xaxis{number}"] |= {"domain": domain}
    return body


def _label_height(layout: Mapping[str, Any]) -> float:
    """Return the pixels that the tick labels and titles below a panel take, the most of all panels."""
    axes = _x_axes(layout)
    lines = max((text.count("<br>") for axis in axes for text in axis.get("ticktext", ())), default=0)
    turned = any(axis.get("tickangle") == -90 for axis in axes)
    return _GAP + max(_LINE * lines, _CHARACTER * LONGEST_CHOICE - _LINE if turned else 0.0)


def _write_choices(axis: Axis, panel_width: float) -> None:
    """Write the choices of a parameter below their places so that no two of them meet."""
    choices = [value.strip("'") for value in axis["categoryarray"]]
    width = int(panel_width / len(choices) / _CHARACTER)
    upright = width >= min(_FEWEST_UPRIGHT, max(map(len, choices)))
    axis |= {
        "range": [-0.5, len(choices) - 0.5],
        "tickvals": axis["categoryarray"],
        "ticktext": [
            wrapped(choice, width) if upright else plain(choice, LONGEST_CHOICE) for choice in choices
        ],
        "tickangle": 0 if upright else -90,
    }
