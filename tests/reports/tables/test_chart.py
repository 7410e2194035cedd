"""Charts, whatever is drawn in them."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path

from deepracer_exp.reports.charts.figure import (
    Chart,
    Layer,
    Panel,
    band,
    bars,
    colored_points,
    heatmap,
    line,
    mark,
    note,
    points,
)
from deepracer_exp.reports.charts.layout import draw
from deepracer_exp.reports.charts.maps import map_panel
from deepracer_exp.reports.charts.style import BLUE, GREEN, NARROW_WIDTH, ORANGE, VERMILION
from deepracer_exp.reports.pages.page import figure_json
from deepracer_exp.reports.tables.statistics import subsample

from .chart_layers import as_plotly, drawn
from .made_up import made_up_course

X = np.arange(20.0)
LAYERS: dict[str, Layer] = {
    "line": line(X, X**2, BLUE, "squares", dashed=True),
    "points": points(X, X, ORANGE, "some", symbol="star"),
    "coloured points": colored_points(X, X, X, "speed, m/s"),
    "band": band(X, X - 1, X + 1, GREEN, "spread"),
    "bars": bars(X, X + 1, BLUE, "counts"),
    "cells": heatmap(X, X, np.outer(X, X), "visits"),
    "written cells": heatmap([0, 1], [0], np.array([[1.0, 2.0]]), "per cent", written=True),
    "upright mark": mark(3.0, "best", VERMILION),
    "mark in the legend": mark(3.0, "best", VERMILION, in_legend=True),
    "horizontal mark": mark(3.0, "target", VERMILION, horizontal=True),
    "note": note((3.0, 4.0), "here"),
}


def chart(*rows: list[Panel], share_x: bool = False) -> Chart:
    return Chart(name="made_up", title="Made up", caption="Nothing. To see.", rows=rows, share_x=share_x)


@pytest.mark.parametrize("kind", LAYERS)
def test_every_kind_of_layer_is_drawn_once_on_the_axes_of_its_panel(kind: str) -> None:
    figure = drawn(chart([Panel(layers=[]), Panel(layers=[LAYERS[kind]])]))
    (layer,) = [*figure.data, *figure.layout.shapes, *figure.layout.annotations]
    axes = (layer.xaxis, layer.yaxis) if figure.data else (layer.xref, layer.yref)
    assert [axis.split()[0] for axis in axes] == ["x2", "y2"]


def test_the_table_holds_all_that_is_drawn() -> None:
    table = chart([Panel(title="all", layers=[*LAYERS.values()])]).table
    assert table.groupby("name")["y"].sum()["squares"] == (X**2).sum()
    assert table["value"].notna().sum() == len(X) + len(X) ** 2 + 2
    assert set(table["panel"]) == {"all"}


@pytest.mark.parametrize("counts", [(1,), (2,), (3, 2), (2, 1, 2)])
def test_every_panel_is_drawn(counts: tuple[int, ...]) -> None:
    rows = [[Panel(title=f"{count} {n}", layers=[LAYERS["line"]]) for n in range(count)] for count in counts]
    figure = drawn(chart(*rows))
    assert {trace.xaxis for trace in figure.data} == {"x", *(f"x{n}" for n in range(2, sum(counts) + 1))}
    assert len(figure.layout.annotations) == sum(counts)


def test_on_a_phone_the_same_traces_are_in_panels_below_each_other() -> None:
    two = chart([Panel(layers=[LAYERS["cells"]]), Panel(layers=[LAYERS["line"], LAYERS["coloured points"]])])
    desk, phone = drawn(two), drawn(two, NARROW_WIDTH)
    assert [trace.to_json() for trace in desk.data] == [trace.to_json() for trace in phone.data]
    assert phone.layout.yaxis2.domain[1] < phone.layout.yaxis.domain[0]
    assert desk.layout.yaxis2.domain == desk.layout.yaxis.domain


def test_legends_are_above_the_data_and_panels_do_not_overlap() -> None:
    names = [line(X, X + n, BLUE, f"a line with a long name, number {n}") for n in range(7)]
    panel = Panel(title="one", x_label="x", layers=[*names, *LAYERS.values()])
    layout = drawn(chart(*([panel] * 2 for _ in range(3)), share_x=True)).layout
    assert layout.legend.y > layout.yaxis.domain[1]
    assert layout.legend.orientation == "v"
    heights = [layout[f"yaxis{'' if n == 1 else n}"].domain for n in (1, 3, 5)]
    assert all(below[1] < above[0] for above, below in pairwise(heights))
    assert layout.xaxis.domain[1] < layout.xaxis2.domain[0]
    assert all(0 <= edge <= 1 for domain in heights for edge in domain)
    assert (layout.xaxis3.matches, layout.xaxis4.matches) == ("x", "x2")  # columns zoom together


def test_maps_have_the_same_scale_along_both_axes_and_are_as_high_as_their_course() -> None:
    maps = [map_panel(made_up_course(name), []) for name in ("reinvent_base", "Straight_track")]
    high, wide = (drawn(chart([panel])) for panel in maps)
    assert high.layout.yaxis.scaleanchor == "x"
    assert wide.layout.height < 0.8 * high.layout.height
    road = as_plotly(maps[0].layers[0])
    assert (road.path.count("M"), road.fillrule) == (2, "evenodd")  # the inside stays empty
    far = map_panel(made_up_course(), [points([100.0], [-50.0], BLUE)])
    assert far.x_range[1] > 100.0
    assert far.y_range[0] < -50.0


def test_a_band_is_interrupted_where_a_value_is_unknown() -> None:
    low = np.where(X == 9, np.nan, X)
    trace = as_plotly(band(X, low, low + 1, BLUE))
    gaps = np.flatnonzero(np.isnan(trace.x))
    assert len(gaps) == 1
    first = np.column_stack([trace.x[: gaps[0]], trace.y[: gaps[0]]])
    assert Path(first).contains_point((5.0, 5.5))
    assert first[:, 0].max() == 8.0
    assert len(band(X, X * np.nan, X, BLUE)["x"]) == 0


def test_numbers_are_stored_in_half_precision_and_not_as_text() -> None:
    many = points(np.arange(3000.0) / 7, np.arange(3000.0) / 3, BLUE)
    text = figure_json(draw(chart([Panel(layers=[many])])))
    assert json.loads(text)["data"][0]["x"]["dtype"] == "f4"
    assert len(text) < 2 * 3000 * 4 * 4 / 3 + 8000


def test_text_is_not_interpreted_as_markup() -> None:
    nasty = "<b>&1</b>"
    layers = [
        line(X, X, BLUE, nasty),
        note((1.0, 1.0), nasty),
        mark(1.0, nasty, BLUE),
        colored_points(X, X, X, nasty),
    ]
    panel = Panel(title=nasty, x_label=nasty, x_names=[nasty], layers=layers)
    figure = drawn(Chart(name="one", title=nasty, caption="", rows=[[panel]])).to_json()
    text = figure.encode().decode("unicode_escape")
    assert nasty not in text
    assert text.count("&lt;b&gt;&amp;1&lt;/b&gt;") >= 8


def test_names_along_an_axis_are_where_their_bars_are() -> None:
    figure = drawn(chart([Panel(layers=[bars([0, 1], [1.0, 2.0], BLUE)], x_names=["left", "right"])]))
    assert list(figure.layout.xaxis.tickvals) == list(figure.data[0].x)
    assert list(figure.layout.xaxis.ticktext) == ["left", "right"]


def test_zero_is_in_the_middle_of_diverging_colours() -> None:
    cells = heatmap(X, X, np.outer(X, -X), "", diverging=True)
    assert cells["zmin"] == -cells["zmax"] < 0


@given(st.integers(0, 30000), st.integers(2, 5000))
def test_a_subsample_keeps_both_ends_and_no_more_than_asked(count: int, most: int) -> None:
    kept = subsample(count, most)
    assert len(kept) == min(count, most)
    assert count == 0 or (kept[0] == 0 and (kept[-1] == count - 1))
