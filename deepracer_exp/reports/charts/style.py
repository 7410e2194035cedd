"""The colours and the base layout that all figures on a page share."""

import html
import textwrap
from typing import Any, TypeAlias

BLUE, ORANGE, GREEN, VERMILION = "#0072b2", "#e69f00", "#009e73", "#d55e00"
PURPLE, SKY, YELLOW, BLACK = "#cc79a7", "#56b4e9", "#f0e442", "#000000"
CATEGORIES = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, BLACK, YELLOW)
"""Colours that colour-blind readers can distinguish (Okabe and Ito, 2008)."""
INK, FAINT, PALE, PAPER = "#22262b", "#6b727d", "#b9bfc8", "#ffffff"
ROAD_FILL, ROAD_EDGE, ROAD_CENTER, GRID, SPINE = "#e6e9ed", "#8d949e", "#a9b0b9", "#e9ecef", "#cdd2d8"
VEIL = "rgba(255,255,255,0.7)"
"""Behind text that stands on data."""
DIVERGING = (
    *("#7f3b08", "#b35806", "#e08214", "#fdb863", "#f7f7f7"),
    *("#b2abd2", "#8073ac", "#542788", "#2d004b"),
)
"""PuOr (ColorBrewer): readers who do not see red or green can distinguish its ends."""
_DARK_DIVERGING = (
    *("#ffb45c", "#e0893a", "#a8632b", "#6b4a35", "#3a3f46"),
    *("#57507f", "#7d70c0", "#a394ea", "#cabfff"),
)
SCALE = (
    *("#440154", "#482878", "#3e4a89", "#31688e", "#26828e"),
    *("#1f9e89", "#35b779", "#6dcd59", "#b4de2c", "#dde318"),
)
"""Viridis without its palest twentieth, which is hard to see on a road."""
_DARK_SCALE = (
    *("#8464c9", "#7a7bd6", "#6a92d8", "#56a6d2", "#45b8c4"),
    *("#41c7ae", "#5bd48f", "#86de6c", "#c0e750", "#eef06a"),
)
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
    **dict(zip(SCALE, _DARK_SCALE, strict=True)),
    **dict(zip(DIVERGING, _DARK_DIVERGING, strict=True)),
}
"""Replacements for the colours of a figure on a dark page; all others can be seen on both."""
WIDTH, NARROW_WIDTH = 1040.0, 400.0
"""Pixels for which figures are laid out, on a desk and on a phone."""
Figure: TypeAlias = dict[str, Any]
"""`data`, the traces, and `layout`, as plotly.js reads them; numbers of traces are arrays or lists."""
_TITLE_LETTER = 11.3
"""Mean width of a letter of the title, pixels."""


def base_layout(title: str, width: float = WIDTH) -> dict[str, Any]:
    """Return the common layout of all figures; the title is broken into lines that fit the width."""
    letters = round(width / _TITLE_LETTER)
    lines = [line for part in title.split("\n") for line in textwrap.wrap(part, letters) or [""]]
    return {
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


def escaped(text: str) -> str:
    """Return a text for Plotly, which interprets tags and entities as HTML does."""
    return html.escape(text, quote=False).replace("\n", "<br>")
