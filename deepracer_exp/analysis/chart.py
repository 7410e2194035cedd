"""Charts as data: drawn by matplotlib for paper, by plotly for the page."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Values = NDArray[np.float64]
BLUE, ORANGE, GREEN, VERMILION = "#0072b2", "#e69f00", "#009e73", "#d55e00"
PURPLE, SKY, YELLOW, BLACK = "#cc79a7", "#56b4e9", "#f0e442", "#000000"
CATEGORIES = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, BLACK, YELLOW)
"""Colours that colour-blind readers tell apart (Okabe and Ito, 2008)."""
INK, FAINT, PALE, PAPER = "#22262b", "#6b727d", "#b9bfc8", "#ffffff"
MOST_POINTS = 5000
"""Points beyond which a page becomes slow: a figure shows a part of them and says so."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """A line through points; NaN interrupts it."""

    x: Values
    y: Values
    name: str | None = None
    """In the legend; None: not there."""
    color: str
    dashed: bool = False
    width: float = 1.6
    steps: bool = False
    """Constant from point to point."""
    hover: Sequence[str] | None = None
    """Text of each point on the page."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """Points of one colour, or coloured by values."""

    x: Values
    y: Values
    name: str | None = None
    color: str
    """Of all points where there are no `values`."""
    values: Values | None = None
    scale: str | None = None
    """What the values are, with unit: the label of the colour bar."""
    value_range: tuple[float, float] | None = None
    """Values of the first and the last colour; None: those between the percentiles 1 and 99."""
    size: float = 5.0
    """Diameter in points of 1/72 inch."""
    symbol: str = "circle"
    """circle, cross, diamond, triangle or star."""
    hover: Sequence[str] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Band:
    """The area between two lines."""

    x: Values
    low: Values
    high: Values
    name: str | None = None
    color: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Bars:
    """Bars from `base` upwards."""

    x: Values | Sequence[str]
    height: Values
    base: Values | None = None
    name: str | None = None
    color: str
    width: float | None = None
    """In units of x; None: most of the room."""
    hover: Sequence[str] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Cells:
    """A heat map: one value a cell, NaN: nothing there."""

    x: Values | Sequence[str]
    """Centres, (n,)."""
    y: Values | Sequence[str]
    """Centres, (m,)."""
    values: Values
    """(m, n)."""
    scale: str
    """What the values are, with unit."""
    written: bool = False
    """Whether each value is written into its cell."""
    diverging: bool = False
    """Whether zero has a meaning between two colours."""
    value_range: tuple[float, float] | None = None
    """Values of the first and the last colour; None: those between the percentiles 1 and 99, or all written."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Road:
    """The course behind what is drawn on it."""

    rings: Sequence[Values]
    """Borders, each (n, 2), m; the area between them is the road."""
    center: Values
    """(n, 2), m."""


@dataclass(frozen=True, kw_only=True)
class Mark:
    """A straight line across the panel, with a word."""

    at: float
    label: str
    """Short; empty: the line alone."""
    horizontal: bool = False
    color: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Note:
    """A word at a place."""

    x: float
    y: float
    text: str


Layer = Line | Points | Band | Bars | Cells | Road | Mark | Note


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """One pair of axes."""

    layers: Sequence[Layer]
    x_label: str = ""
    y_label: str = ""
    title: str = ""
    map: bool = False
    """Both axes in m, in the same scale; their numbers are not written."""
    x_names: Sequence[str] = ()
    """Written at 0, 1, 2 and so on instead of numbers."""
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """One figure."""

    name: str
    """Slug, as in file names and links."""
    title: str
    caption: str
    """Two sentences on what to see."""
    rows: Sequence[Sequence[Panel]]
    """Panels row by row."""
    share_x: bool = False
    """Whether the panels of a column zoom together along x."""
    table: pd.DataFrame = field(default_factory=pd.DataFrame)
    """What is drawn."""


def thinned(count: int, most: int = MOST_POINTS) -> NDArray[np.intp]:
    """Return the indices of at most so many of `count` rows, at even distances, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.intp))
