"""Laws of charts: whoever draws them draws all of them."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path

from deepracer_exp.analysis import chart_matplotlib, chart_plotly
from deepracer_exp.analysis.chart import (
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    Band,
    Bars,
    Cells,
    Chart,
    Layer,
    Line,
    Mark,
    Note,
    Panel,
    Points,
    Road,
    thinned,
)
from deepracer_exp.analysis.chart_layout import color_range, row_heights, word_places, wound

X = np.arange(20.0)
ANGLE = np.linspace(0, 2 * np.pi, 60, endpoint=False)
CIRCLE = np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])
ROAD = Road(rings=[2.4 * CIRCLE, 1.6 * CIRCLE], center=2.0 * CIRCLE)
LAYERS: dict[str, Layer] = {
    "line": Line(x=X, y=X**2, name="squares", color=BLUE, dashed=True),
    "points": Points(x=X, y=X, name="some", color=ORANGE, symbol="star"),
    "coloured points": Points(x=X, y=X, color=BLUE, values=X, scale="speed, m/s"),
    "band": Band(x=X, low=X - 1, high=X + 1, name="spread", color=GREEN),
    "bars": Bars(x=X, height=X + 1, name="counts", color=BLUE),
    "cells": Cells(x=X, y=X, values=np.outer(X, X), scale="visits"),
    "written cells": Cells(
        x=["a", "b"], y=["c"], values=np.array([[1.0, 2.0]]), scale="per cent", written=True
    ),
    "road": ROAD,
    "upright mark": Mark(at=3.0, label="best", color=VERMILION),
    "flat mark": Mark(at=3.0, label="target", horizontal=True, color=VERMILION),
    "note": Note(x=3.0, y=4.0, text="here"),
}


def chart(*rows: list[Panel], share_x: bool = False) -> Chart:
    return Chart(name="made_up", title="Made up", caption="Nothing. To see.", rows=rows, share_x=share_x)


def panels(figure: Figure) -> list[Axes]:
    """The axes that are no colour bars."""
    return [axes for axes in figure.axes if axes.get_subplotspec() is not None]


def marks_of(axes: Axes) -> int:
    parts = [*axes.lines, *axes.collections, *axes.patches, *axes.texts, *axes.child_axes]
    return len(parts)


@pytest.mark.parametrize("kind", LAYERS)
def test_both_draw_a_layer_of_every_kind(kind: str) -> None:
    with_it, without = (chart([Panel(layers=layers)]) for layers in ([LAYERS[kind]], []))
    assert marks_of(panels(chart_matplotlib.draw(with_it))[0]) > marks_of(
        panels(chart_matplotlib.draw(without))[0]
    )
    parts = [
        len(figure.data) + len(figure.layout.shapes) + len(figure.layout.annotations)
        for figure in map(chart_plotly.draw, (with_it, without))
    ]
    assert parts[0] > parts[1]


@pytest.mark.parametrize("counts", [(1,), (2,), (3, 2), (2, 1, 2)])
def test_both_draw_every_panel(counts: tuple[int, ...]) -> None:
    drawn = chart(
        *([Panel(title=f"{count} {n}", layers=[LAYERS["line"]]) for n in range(count)] for count in counts)
    )
    assert len(panels(chart_matplotlib.draw(drawn))) == sum(counts)
    figure = chart_plotly.draw(drawn)
    assert {trace.xaxis for trace in figure.data} == {"x", *(f"x{n}" for n in range(2, sum(counts) + 1))}
    assert len(figure.layout.annotations) == sum(counts)


def test_legends_and_titles_stand_above_the_data() -> None:
    names = [Line(x=X, y=X + n, name=f"a line with a long name, number {n}", color=BLUE) for n in range(7)]
    figure = chart_matplotlib.draw(
        chart([Panel(title="Left", layers=names), Panel(title="Right", layers=names)])
    )
    figure.draw_without_rendering()
    for axes in panels(figure):
        legend = axes.get_legend()
        assert legend is not None
        box, data = legend.get_window_extent(), axes.get_window_extent()
        assert box.y0 >= data.y1 - 1
        assert box.x1 <= figure.bbox.x1
        # A left title is the axes' second of three.
        title = axes._left_title.get_window_extent()  # type: ignore[attr-defined]
        assert title.y0 >= box.y1 - 4
    page = chart_plotly.draw(chart([Panel(layers=names), Panel(layers=names)]))
    assert page.layout.legend.y > page.layout.yaxis.domain[1]


def test_panels_of_a_page_do_not_overlap() -> None:
    page = chart_plotly.draw(
        chart(*([Panel(title="one", x_label="x", layers=[*LAYERS.values()])] * 2 for _ in range(3)))
    )
    bottoms = [page.layout[f"yaxis{'' if n == 1 else n}"].domain for n in (1, 3, 5)]
    assert all(below[1] < above[0] for above, below in pairwise(bottoms))
    assert page.layout.xaxis.domain[1] < page.layout.xaxis2.domain[0]
    assert all(0 <= edge <= 1 for domain in bottoms for edge in domain)


def test_nothing_is_cut_off_at_the_edge_of_the_paper() -> None:
    long = Panel(
        x_label="a long label, m", y_label="another one, s", title="T" * 40, layers=[*LAYERS.values()]
    )
    figure = chart_matplotlib.draw(chart([long, long]))
    figure.draw_without_rendering()
    box = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    assert box.x0 >= -0.01
    assert box.y0 >= -0.01
    assert box.x1 <= width + 0.01
    assert box.y1 <= height + 0.01


def test_maps_have_the_same_scale_along_both_axes() -> None:
    drawn = chart([Panel(map=True, layers=[ROAD, LAYERS["coloured points"]])])
    assert panels(chart_matplotlib.draw(drawn))[0].get_aspect() == 1.0
    assert chart_plotly.draw(drawn).layout.yaxis.scaleanchor == "x"


def test_the_inside_of_a_road_stays_empty() -> None:
    for rings in (
        [2.4 * CIRCLE, 1.6 * CIRCLE],
        [1.6 * CIRCLE, 2.4 * CIRCLE],
        [2.4 * CIRCLE, 1.6 * CIRCLE[::-1]],
    ):
        areas = [float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) for x, y in (ring.T for ring in wound(rings))]
        assert areas[0] * areas[1] < 0


def test_a_band_is_interrupted_where_a_value_is_unknown() -> None:
    low = np.where(X == 9, np.nan, X)
    trace = chart_plotly.draw(chart([Panel(layers=[Band(x=X, low=low, high=low + 1, color=BLUE)])])).data[0]
    gaps = np.flatnonzero(np.isnan(trace.x))
    assert len(gaps) == 1
    first = np.column_stack([trace.x[: gaps[0]], trace.y[: gaps[0]]])
    assert Path(first).contains_point((5.0, 5.5))
    assert first[:, 0].max() == 8.0


def test_numbers_go_to_the_page_in_half_precision_and_not_as_text() -> None:
    rich = chart([Panel(layers=[Points(x=np.arange(3000.0) / 7, y=np.arange(3000.0) / 3, color=BLUE)])])
    text = chart_plotly.draw(rich).to_json()
    assert json.loads(text)["data"][0]["x"]["dtype"] == "f4"
    assert len(text) < 2 * 3000 * 4 * 4 / 3 + 8000


def test_words_are_no_markup() -> None:
    evil = Panel(
        title="<b>1</b>",
        x_label="<i>2",
        layers=[Line(x=X, y=X, name="<a href='x'>3</a>", color=BLUE), Note(x=1.0, y=1.0, text="<b>4")],
    )
    page = chart_plotly.draw(chart([evil]))
    assert page.data[0].name == "&lt;a href='x'&gt;3&lt;/a&gt;"
    assert page.layout.xaxis.title.text == "&lt;i&gt;2"
    assert any(note.text == "&lt;b&gt;4" for note in page.layout.annotations)


def test_columns_that_share_x_zoom_together() -> None:
    two = [Panel(layers=[LAYERS["line"]]) for _ in range(2)]
    page = chart_plotly.draw(chart(two, two, share_x=True))
    assert (page.layout.xaxis3.matches, page.layout.xaxis4.matches) == ("x", "x2")
    first, second, third, _ = panels(chart_matplotlib.draw(chart(two, two, share_x=True)))
    assert first.get_shared_x_axes().joined(first, third)
    assert not first.get_shared_x_axes().joined(first, second)


def test_names_along_an_axis_stand_where_their_bars_stand() -> None:
    drawn = chart([Panel(layers=[Bars(x=["left", "right"], height=np.array([1.0, 2.0]), color=BLUE)])])
    page = chart_plotly.draw(drawn)
    assert list(page.layout.xaxis.tickvals) == list(page.data[0].x)
    assert list(page.layout.xaxis.ticktext) == ["left", "right"]
    axes = panels(chart_matplotlib.draw(drawn))[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["left", "right"]


def test_zero_is_in_the_middle_of_diverging_colours() -> None:
    low, high = color_range(Cells(x=X, y=X, values=np.outer(X, -X), scale="", diverging=True))
    assert low == -high < 0


@given(st.integers(0, 30000), st.integers(2, 5000))
def test_thinning_keeps_both_ends_and_no_more_than_asked(count: int, most: int) -> None:
    kept = thinned(count, most)
    assert len(kept) == min(count, most)
    assert count == 0 or (kept[0] == 0 and (kept[-1] == count - 1))


@given(st.lists(st.floats(0, 100), min_size=1, max_size=3, unique=True))
def test_no_word_of_any_three_marks_covers_another(at: list[float]) -> None:
    places = word_places(sorted(at), 0.0, 100.0, 3.0)
    boxes = [
        (mark - 3.0, mark, level) if side == "left" else (mark, mark + 3.0, level)
        for mark, (side, level) in zip(sorted(at), places, strict=True)
    ]
    assert not any(
        a[2] == b[2] and a[0] < b[1] and b[0] < a[1] for n, a in enumerate(boxes) for b in boxes[:n]
    )


def test_a_map_is_as_high_as_its_course() -> None:
    wide = Road(rings=[CIRCLE * [6.0, 2.0]], center=CIRCLE * [5.0, 1.5])
    high = row_heights(chart([Panel(map=True, layers=[ROAD])]).rows)[0]
    assert row_heights(chart([Panel(map=True, layers=[wide])]).rows)[0] < 0.7 * high
