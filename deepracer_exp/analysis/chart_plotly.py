"""Charts on a page: to hover over and to zoom into."""

from collections.abc import Sequence

import plotly.graph_objects as go

from .chart import INK, Chart, Panel
from .chart_layout import categories, has_scale, row_heights
from .chart_plotly_panel import LEFT, WIDTH, PanelPlace, head, plain, turned

_PIXELS = 84.0
"""Of an inch of the figure on paper."""
_RIGHT, _SCALE = 14.0, 86.0


def draw(chart: Chart) -> go.Figure:
    """Draw a chart as wide as its page; its caption is for the text around it."""
    figure = go.Figure()
    heads = [max(head(panel, len(row)) for panel in row) for row in chart.rows]
    bodies = [_PIXELS * height for height in row_heights(chart)]
    feet = [_foot(row) for row in chart.rows]
    title = 46.0 + 20.0 * chart.title.count("\n")
    total = title + sum(heads) + sum(bodies) + sum(feet)
    figure.update_layout(
        template="none",
        title={
            "text": f"<b>{plain(chart.title)}</b>",
            "x": 0.0,
            "xref": "container",
            "y": 1 - 22 / total,
            "yref": "container",
            "xanchor": "left",
            "font": {"size": 17, "color": INK},
        },
        font={"family": "system-ui, sans-serif", "size": 13, "color": INK},
        height=round(total),
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        barmode="overlay",
        hovermode="closest",
        hoverlabel={"align": "left"},
        paper_bgcolor="white",
        plot_bgcolor="white",
    )
    number, top = 0, title
    firsts: dict[tuple[int, int], str] = {}
    for at, row in enumerate(chart.rows):
        top += heads[at]
        for column, panel in enumerate(row):
            number += 1
            y = (1 - (top + bodies[at]) / total, 1 - top / total)
            left, right = column / len(row), (column + 1) / len(row)
            scale = _SCALE if has_scale(panel) else 0.0
            left_room = 8.0 if panel.map else _left_room(panel)
            x = (left + left_room / WIDTH, right - (_RIGHT + scale) / WIDTH)
            place = PanelPlace(figure, panel, number, x, y, total, column=(left, right))
            place.draw_panel()
            if chart.share_x:
                first = firsts.setdefault((len(row), column), place.x_name)
                if first != place.x_name:
                    place.x_axis.matches = first
        top += bodies[at] + feet[at]
    return figure


def _left_room(panel: Panel) -> float:
    longest = max((len(name) for name in categories(panel, "y")), default=0)
    return max(LEFT, 24.0 + 7.2 * longest + (20.0 if panel.y_label else 0.0))


def _foot(row: Sequence[Panel]) -> float:
    names = [name for panel in row for name in categories(panel, "x")]
    slanted = any(turned(panel, len(row)) for panel in row)
    label = 24.0 if any(panel.x_label for panel in row) else 4.0
    return label + (14.0 + 4.2 * max(map(len, names)) if slanted else 26.0)
