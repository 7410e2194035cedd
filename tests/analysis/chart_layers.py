"""What a chart is made of, by kind."""

from typing import Any

import plotly.graph_objects as go

from deepracer_exp.analysis.charts.figure import Chart, Panel

KINDS = {
    "line": lambda one: isinstance(one, go.Scatter) and one.mode.startswith("lines") and one.fill is None,
    "points": lambda one: isinstance(one, go.Scatter) and one.mode == "markers",
    "band": lambda one: isinstance(one, go.Scatter) and one.fill == "toself",
    "bars": lambda one: isinstance(one, go.Bar),
    "cells": lambda one: isinstance(one, go.Heatmap),
    "mark": lambda one: isinstance(one, go.layout.Shape) and one.type == "line",
}


def layers(chart: Chart | Panel | None, kind: str) -> list[Any]:
    """Return the layers of one kind of a chart or of a panel, in order."""
    assert chart is not None
    panels = [chart] if isinstance(chart, Panel) else [panel for row in chart.rows for panel in row]
    return [layer for panel in panels for layer in panel.layers if KINDS[kind](layer)]
