"""Charts on a page: to hover over and to zoom into."""

import textwrap
from collections.abc import Sequence
from typing import Any

import plotly.graph_objects as go

from .chart import BLACK, BLUE, FAINT, INK, PALE, PAPER, SKY, Chart, Panel
from .chart_layout import (
    GRID,
    ROAD_CENTER,
    ROAD_EDGE,
    ROAD_FILL,
    SCALE,
    SPINE,
    WIDTH_IN,
    categories,
    has_scale,
    row_heights,
)
from .chart_plotly_panel import LEFT, VEIL, WIDTH, PanelPlace, head, plain, turned

_PIXELS = 84.0
"""Of an inch of the figure on paper."""
_RIGHT, _SCALE = 14.0, 86.0
_TITLE_LETTER = 11.3
"""Mean width of a letter of the title, pixels."""
DARK = {
    PAPER: "#1c2025",
    VEIL: "rgba(28,32,37,0.7)",
    INK: "#e6e9ed",
    FAINT: "#a2aab5",
    PALE: "#68717c",
    BLACK: "#eef0f2",
    GRID: "#2d333a",
    SPINE: "#4a525c",
    ROAD_FILL: "#2f353d",
    ROAD_EDGE: "#7b838e",
    ROAD_CENTER: "#5d656f",
    BLUE: "#3d94d6",
    SKY: "#9ad2f5",
    "#882255": "#c25586",
    "#332288": "#8a7ae6",
    **dict(
        zip(
            SCALE,
            (
                *("#8464c9", "#7a7bd6", "#6a92d8", "#56a6d2", "#45b8c4"),
                *("#41c7ae", "#5bd48f", "#86de6c", "#c0e750", "#eef06a"),
            ),
            strict=True,
        )
    ),
}
"""What stands for a colour of a figure on a dark page; those that are not here can be seen on both."""


def base_layout(title: str, width: float = WIDTH) -> dict[str, Any]:
    """Return what the layouts of all figures have in common.

    Args:
        title: escaped for Plotly where that is needed; it is broken into lines, so that it fits.
        width: of the figure, pixels.
    """
    lines = [
        line
        for part in title.split("\n")
        for line in textwrap.wrap(part, round(width / _TITLE_LETTER)) or [""]
    ]
    return {
        "template": "none",
        "title": {
            "text": "<b>" + "<br>".join(lines) + "</b>",
            "x": 0.0,
            "xref": "container",
            "xanchor": "left",
            "font": {"size": 17, "color": INK},
        },
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "hoverlabel": {"align": "left"},
        "paper_bgcolor": PAPER,
        "plot_bgcolor": PAPER,
    }


def draw(chart: Chart, width: float = WIDTH) -> go.Figure:
    """Draw a chart as wide as its page; its caption is for the text around it.

    Args:
        chart: what to draw.
        width: pixels for which room is laid out: `WIDTH`, or `NARROW_WIDTH` with all panels below each other; traces
            are the same.
    """
    figure = go.Figure()
    rows = chart.rows if width == WIDTH else [[panel] for row in chart.rows for panel in row]
    heads = [max(head(panel, len(row), width / len(row)) for panel in row) for row in rows]
    bodies = [_PIXELS * height for height in row_heights(rows, WIDTH_IN * width / WIDTH)]
    feet = [_foot(row, width) for row in rows]
    layout = base_layout(plain(chart.title), width)
    title = 46.0 + 20.0 * layout["title"]["text"].count("<br>")
    total = title + sum(heads) + sum(bodies) + sum(feet)
    figure.update_layout(
        layout,
        title={"y": 1 - 22 / total, "yref": "container"},
        height=round(total),
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        barmode="overlay",
        hovermode="closest",
    )
    number, top = 0, title
    shared = [(len(row), column) for row in chart.rows for column in range(len(row))]
    firsts: dict[tuple[int, int], str] = {}
    for at, row in enumerate(rows):
        top += heads[at]
        for column, panel in enumerate(row):
            y = (1 - (top + bodies[at]) / total, 1 - top / total)
            left, right = column / len(row), (column + 1) / len(row)
            scale = _SCALE if has_scale(panel) else 0.0
            left_room = 8.0 if panel.map else min(_left_room(panel), 0.45 * width)
            x = (left + left_room / width, right - (_RIGHT + scale) / width)
            number += 1
            place = PanelPlace(figure, panel, number, x, y, total, len(row), width)
            place.draw_panel()
            if chart.share_x:
                first = firsts.setdefault(shared[number - 1], place.x_name)
                if first != place.x_name:
                    place.x_axis.matches = first
        top += bodies[at] + feet[at]
    return figure


def _left_room(panel: Panel) -> float:
    longest = max((len(name) for name in categories(panel, "y")), default=0)
    return max(LEFT, 24.0 + 7.2 * longest + (20.0 if panel.y_label else 0.0))


def _foot(row: Sequence[Panel], width: float) -> float:
    names = [name for panel in row for name in categories(panel, "x")]
    slanted = any(turned(panel, width / len(row)) for panel in row)
    label = 24.0 if any(panel.x_label for panel in row) else 4.0
    return label + (14.0 + 4.2 * max(map(len, names)) if slanted else 26.0)
