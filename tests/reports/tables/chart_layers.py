"""What a chart is made of, by kind."""

from typing import Any

import plotly.graph_objects as go

from deepracer_exp.reports.charts.figure import Annotation, Chart, Layer, Panel, Shape
from deepracer_exp.reports.charts.layout import draw
from deepracer_exp.reports.charts.style import WIDTH

KINDS = {
    "line": lambda one: isinstance(one, go.Scatter) and one.mode.startswith("lines") and one.fill is None,
    "points": lambda one: isinstance(one, go.Scatter) and one.mode == "markers",
    "band": lambda one: isinstance(one, go.Scatter) and one.fill == "toself",
    "bars": lambda one: isinstance(one, go.Bar),
    "cells": lambda one: isinstance(one, go.Heatmap),
    "mark": lambda one: isinstance(one, go.layout.Shape) and one.type == "line",
}


def as_plotly(layer: Layer) -> Any:
    """Return a layer as Plotly's own object, which refuses what plotly.js would pass over."""
    if isinstance(layer, Annotation):
        return go.layout.Annotation(layer)
    if isinstance(layer, Shape):
        return go.layout.Shape(layer)
    kinds = {"scatter": go.Scatter, "bar": go.Bar, "heatmap": go.Heatmap}
    return kinds[layer["type"]]({key: value for key, value in layer.items() if key != "type"})


def drawn(chart: Chart, width: float = WIDTH) -> go.Figure:
    """Return a chart drawn, as Plotly's own object."""
    return go.Figure(draw(chart, width))


def layers(chart: Chart | Panel | None, kind: str) -> list[Any]:
    """Return the layers of one kind of a chart or of a panel, in order, as Plotly's own objects."""
    assert chart is not None
    panels = [chart] if isinstance(chart, Panel) else [panel for row in chart.rows for panel in row]
    objects = [as_plotly(layer) for panel in panels for layer in panel.layers]
    return [layer for layer in objects if KINDS[kind](layer)]
