"""The pictures of what was searched: each value against what came of it."""

import math
from collections.abc import Sequence
from typing import Any

import plotly.graph_objects as go
from optuna.trial import FrozenTrial, TrialState
from plotly.subplots import make_subplots

from .figures import Parameters, ValueAxis, by_fate, log_axis, marks, short, styled, thinned
from .labels import MEASURES, NONE, number

_COLUMNS = 4
_MOST_POINTS = 6000  # of all slices together


def slices(
    objectives: Sequence[str], trials: Sequence[FrozenTrial], parameters: Parameters
) -> go.Figure | None:
    """Draw each parameter against each objective, a point a trial."""
    columns = min(_COLUMNS, len(parameters.shown))
    lines = math.ceil(len(parameters.shown) / columns)
    rows = lines * len(objectives)
    figure = make_subplots(
        rows=rows, cols=columns, horizontal_spacing=0.22 / columns / 1.6, vertical_spacing=0.3 / max(rows, 2)
    )
    seen: set[str] = set()
    some_trials = thinned(trials, max(2, _MOST_POINTS // (len(objectives) * len(parameters.shown))))
    for at, objective in enumerate(objectives):
        axis = ValueAxis(objective, trials, objectives)
        if not axis.values:
            return None
        for place, key in enumerate(parameters.shown):
            row, column = at * lines + place // columns + 1, place % columns + 1
            known = [one for one in some_trials if key in one.params and one.number in axis.values]
            for fate, some in by_fate(known).items():
                x = [parameters.shown_value(key, trial.params[key]) for trial in some]
                points = marks(some, fate, x, list(map(axis.place, some)))
                points.update(
                    customdata=[[trial.number, short(axis.values[trial.number])] for trial in some],
                    marker={"size": 7},
                    hovertemplate=f"<b>Trial %{{customdata[0]}}</b><br>{parameters.labels[key]} %{{x}}<br>"
                    f"{axis.measure.words} %{{customdata[1]}} {axis.measure.unit}<extra></extra>",
                    showlegend=fate not in seen,
                )
                seen.add(fate)
                figure.add_trace(points, row=row, col=column)
            figure.update_xaxes(_parameter_axis(parameters, key), row=row, col=column)
            layout = axis.layout() if column == 1 else axis.layout() | {"title": {"text": ""}}
            figure.update_yaxes(layout, row=row, col=column)
    return styled(figure, "Each parameter against what came of it", 130 + 270 * rows)


def parallel(
    objectives: Sequence[str], trials: Sequence[FrozenTrial], parameters: Parameters
) -> go.Figure | None:
    """Draw every trial that has a value as a line through its parameters, coloured by what came of it."""
    results = [ValueAxis(objective, trials, objectives) for objective in objectives]
    known = [trial for trial in trials if all(trial.number in axis.values for axis in results)]
    if len(known) < 2:
        return None
    axes = [_objective_line(axis, known) for axis in results]
    axes += [_parameter_line(parameters, key, known) for key in parameters.shown]
    first = axes[0]
    bar = {"title": {"text": first["label"], "side": "right"}, "thickness": 14}
    bar |= {"tickvals": first["tickvals"], "ticktext": first["ticktext"]}
    lines = go.Parcoords(
        dimensions=axes,
        line={
            "color": first["values"],
            "colorscale": "Viridis",
            "reversescale": not MEASURES[objectives[0]].minimize,
            "showscale": True,
            "colorbar": bar,
        },
        labelfont={"size": 13},
        tickfont={"size": 12},
        labelangle=-12 if len(axes) > 7 else 0,
        unselected={"line": {"opacity": 0.06}},
    )
    pruned = any(trial.state != TrialState.COMPLETE for trial in known)
    title = "Every trial a line: drag along an axis to choose" + " (pruned ones with what they had)" * pruned
    figure = styled(go.Figure(lines), title, 480, legend=False)
    figure.update_layout(margin={"l": 90, "r": 40, "t": 130 if len(axes) > 7 else 110, "b": 30})
    return figure


def _parameter_axis(parameters: Parameters, key: str) -> dict[str, Any]:
    """Return the settings of an axis along a parameter."""
    axis: dict[str, Any] = {"title": {"text": parameters.labels[key], "standoff": 8}, "tickangle": 0}
    choices = parameters.choices(key)
    if choices is not None:
        # As categories: the text of a number would be taken for the number.
        axis |= {"type": "category", "categoryorder": "array", "categoryarray": choices}
        return axis | {"range": [-0.5, len(choices) - 0.5]}
    low, high = parameters.room(key)
    if parameters.is_log(key):
        return axis | log_axis(low, high)
    return axis | {"nticks": 5, "range": [low - 0.04 * (high - low), high + 0.04 * (high - low)]}


def _objective_line(axis: ValueAxis, trials: Sequence[FrozenTrial]) -> dict[str, Any]:
    places = list(map(axis.place, trials))
    return {"label": axis.measure.label, "values": places, "range": list(axis.ends), **axis.ticks()}


def _parameter_line(parameters: Parameters, key: str, trials: Sequence[FrozenTrial]) -> dict[str, Any]:
    """Return the axis of a parameter; a trial without it stands at a place of its own below."""
    label = parameters.labels[key]
    missing = any(key not in trial.params for trial in trials)
    line: dict[str, Any] = {"label": label}
    choices = parameters.choices(key)
    if choices is not None:
        ticks = [NONE, *choices] if missing else choices
        chosen = [
            parameters.shown_value(key, one.params[key]) if key in one.params else NONE for one in trials
        ]
        line["values"] = [ticks.index(one) for one in chosen]
        return line | {"tickvals": list(range(len(ticks))), "ticktext": ticks}
    low, high = parameters.room(key)
    numbers = [float(trial.params[key]) if key in trial.params else None for trial in trials]
    if parameters.is_log(key):
        line |= _logarithmic([one or low for one in numbers], log_axis(low, high)["tickvals"], low, high)
    else:
        ends = [low + part * (high - low) / 4 for part in range(5)]
        line |= {"values": [low if one is None else short(one) for one in numbers], "range": [low, high]}
        line |= {"tickvals": ends, "ticktext": [number(end) for end in ends]}
    if missing:
        bottom, top = line["range"]
        below = bottom - 0.12 * (top - bottom)
        pairs = zip(line["values"], numbers, strict=True)
        line["values"] = [below if one is None else value for value, one in pairs]
        line |= {"range": [below, top], "tickvals": [below, *line["tickvals"]]}
        line["ticktext"] = [NONE, *line["ticktext"]]
    return line


def _logarithmic(values: Sequence[float], ticks: Sequence[float], low: float, high: float) -> dict[str, Any]:
    """Return values, ticks and range of an axis that shows logarithms; parallel coordinates have no such axis."""
    inside = [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
    return {
        "values": [round(math.log10(value), 4) for value in values],
        "range": [math.log10(low), math.log10(high)],
        "tickvals": [math.log10(tick) for tick in inside],
        "ticktext": [number(tick) for tick in inside],
    }
