"""Figures of a study: Optuna's own plots in the style of the analysis pages, and two that Optuna does not draw.

Ours are the entropy of all trials by ending, and parallel coordinates: Optuna draws those without axes to drag along
and with one trace per trial, which is slow for hundreds.
"""

import html
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import optuna
import plotly.graph_objects as go
from optuna.distributions import CategoricalDistribution
from optuna.importance import PedAnovaImportanceEvaluator
from optuna.trial import FrozenTrial, TrialState
from optuna.visualization import (
    plot_optimization_history,
    plot_param_importances,
    plot_pareto_front,
    plot_slice,
)

from deepracer_exp.analysis.charts.style import CATEGORIES, GRID, NARROW_WIDTH, SPINE, base_layout
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.files import METRICS, read_metrics
from deepracer_exp.sweeps.search.objectives import MEASURES, NONE, objectives_of
from deepracer_exp.sweeps.trial import Trial

from .best import best_trial
from .labels import ENDINGS, ending_of, ending_words, parameter, short_keys

FEWEST_COMPLETE = 20
"""Complete trials below which importance is chance: the best quarter would be fewer than five trials."""
_EVALUATOR = PedAnovaImportanceEvaluator(target_quantile=0.25)
_MOST_PARAMETERS = 12
_COLUMNS = 3
_PANEL, _GAP = 210.0, 62.0
"""Height of a panel and the distance between two of them, pixels."""
_FAR, _NEAR = 5.0, 0.25
"""A trial is off the axis if it is farther from the best than this many times the median is, and worse than the best
by more than this share of it."""
_PER_AXIS, _LONGEST_CHOICE = 120, 16
"""Pixels from one parallel axis to the next, and the characters of a choice that fit between them."""
_PANEL_WIDTH, _NARROW_PANEL_WIDTH = 260.0, 160.0
"""Least width of a panel on a wide and on a narrow screen, pixels."""
_CHARACTER, _LINE = 6.3, 13.0
"""Width of a character and height of a line of the labels below a panel, pixels."""
_FEWEST_UPRIGHT = 9
"""Characters that must fit below each choice for its name to be written upright; else it is turned."""
_MOST_POINTS, _FEWEST_POINTS = 15_000, 12
"""Most points of all entropy curves together (0.3 MB of the page), and fewest of one curve."""

Target = Callable[[FrozenTrial], float]


def figures(study: optuna.Study) -> dict[str, go.Figure]:
    """Draw a study's figures, each only if there is enough to show.

    Returns:
        By name: `history`, `pareto` (several objectives), `importance`, `slice`, `parallel`, `entropy`. With several
        objectives `history`, `importance` and `slice` are one each, such as `slice-lap_time`, and `pareto` one per
        pair.
    """
    objectives = objectives_of(study)
    trials = study.get_trials(deepcopy=False)
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    drawn: dict[str, go.Figure] = {}
    if complete:
        keys = short_keys(sorted({key for trial in complete for key in trial.params}))
        shown = list(keys)[:_MOST_PARAMETERS]
        for index, objective in enumerate(objectives):
            several = len(objectives) > 1
            name, title = (f"-{objective}", f": {MEASURES[objective].words}") if several else ("", "")
            axis = _value_axis(complete, objective, index)
            drawn[f"history{name}"] = _history(
                study, objective, _target(index) if several else None, axis, title
            )
            if len(complete) >= FEWEST_COMPLETE and len(keys) > 1:
                # PED-ANOVA considers low values good.
                sign = 1.0 if MEASURES[objective].minimize else -1.0
                importance, ranked = _importance(
                    study, keys, _target(index, sign) if several else None, title
                )
                if importance is not None:
                    drawn[f"importance{name}"] = importance
                shown = ranked[:_MOST_PARAMETERS] if index == 0 else shown
            if keys:
                drawn[f"slice{name}"] = _slices(study, shown, keys, _target(index), objective, axis, title)
        for pair in combinations(range(len(objectives)), 2):
            names = [objectives[index] for index in pair] if len(objectives) > 2 else []
            drawn["-".join(["pareto", *names])] = _pareto(study, complete, objectives, pair)
        if keys and len(complete) > 1:
            drawn["parallel"] = _parallel(complete, shown, keys, objectives)
    entropy = _entropy_curves(study, trials)
    return drawn if entropy is None else drawn | {"entropy": entropy}


def narrowed(figure: go.Figure) -> go.Figure:
    """Return a figure with a layout for a narrow screen: its panels below each other, the legend below them."""
    layout, narrow = figure.layout, go.Figure(layout=figure.layout)
    narrow.update_layout(base_layout(layout.meta["title"], NARROW_WIDTH))
    head = layout.margin.t + 20.0 * narrow.layout.title.text.count("<br>")
    names = {trace.name for trace in figure.data if trace.name} if layout.showlegend else ()
    foot = layout.margin.b + 22.0 * len(names)
    body = layout.height - layout.margin.t - layout.margin.b
    narrow.for_each_xaxis(lambda axis: _label_choices(axis, _NARROW_PANEL_WIDTH), {"type": "category"})
    if len(_panels(figure)) > 1:
        body = _arrange(narrow, _panels(figure), 1)
    return narrow.update_layout(
        height=round(head + body + foot),
        margin={"l": 62, "r": 12, "t": head, "b": foot},
        legend={"orientation": "h", "x": 0, "y": -layout.margin.b / body, "yanchor": "top"},
    )


def least_width(figure: go.Figure) -> int:
    """Return the pixels below which a figure cannot be read: each parallel axis needs room for its values."""
    return max(
        (_PER_AXIS * len(trace.dimensions) for trace in figure.data if trace.type == "parcoords"), default=0
    )


def usual_range(values: Sequence[float], minimize: bool) -> tuple[float, float]:
    """Return the ends of an axis that shows the better trials well; far worse ones lie off it.

    A trial without a lap has ten times the seconds of one with laps, beside which all laps would look the same.
    """
    sign = 1.0 if minimize else -1.0
    costs = sorted(sign * value for value in values)
    best, median = costs[0], costs[max((len(costs) - 1) // 2, min(1, len(costs) - 1))]
    edge = max(median + _FAR * (median - best), best + _NEAR * abs(best))
    worst = max(cost for cost in costs if cost <= edge)
    margin = 0.06 * (worst - best) or 0.5
    low, high = sorted((sign * (best - margin), sign * (worst + margin)))
    return low, high


def _target(index: int, sign: float = 1.0) -> Target:
    return lambda trial: sign * trial.values[index]


def _styled(figure: go.Figure, title: str, height: float, *, legend: bool = True) -> go.Figure:
    """Apply the style that all figures share."""
    figure.update_layout(
        base_layout(title),
        template="none",
        meta={"title": title},
        height=round(height),
        width=None,
        margin={"l": 70, "r": 20, "t": 60, "b": 60},
        showlegend=legend,
        legend={"itemsizing": "constant", "font": {"size": 13}},
        colorway=CATEGORIES,
    )
    axes = {"gridcolor": GRID, "zeroline": False, "linecolor": SPINE, "title": {"font": {"size": 13}}}
    return figure.update_xaxes(**axes).update_yaxes(**axes)


def _value_axis(complete: Sequence[FrozenTrial], objective: str, index: int) -> dict[str, Any]:
    measure = MEASURES[objective]
    values = [trial.values[index] for trial in complete]
    return {"title_text": measure.label, "range": usual_range(values, measure.minimize)}


def _panels(figure: go.Figure) -> list[str]:
    """Return the numbers of a figure's pairs of axes, as Plotly names them: "", "2", "3", ..."""
    used = {(trace.yaxis or "y")[1:] for trace in figure.data if "yaxis" in trace}
    return sorted(used, key=lambda number: int(number or 1))


def _arrange(figure: go.Figure, panels: Sequence[str], columns: int) -> float:
    """Arrange panels in a grid; return its height, pixels."""
    gap = _label_height(figure)
    body = math.ceil(len(panels) / columns) * (_PANEL + gap) - gap
    for index, number in enumerate(panels):
        row, column = divmod(index, columns)
        top = 1 - row * (_PANEL + gap) / body
        domain = column / columns + 0.03 * (column > 0), (column + 1) / columns - 0.01 * (columns > 1)
        rows = {"domain": (max(0.0, top - _PANEL / body), top), "showticklabels": column == 0}
        figure.layout[f"yaxis{number}"].update(rows)
        figure.layout[f"xaxis{number}"].update(domain=domain)
    return body


def _label_height(figure: go.Figure) -> float:
    """Return the pixels that the tick labels and titles below a panel take, the most of all panels."""
    texts = [axis.ticktext or () for axis in figure.select_xaxes()]
    lines = max((text.count("<br>") for some in texts for text in some), default=0)
    turned = any(axis.tickangle == -90 for axis in figure.select_xaxes())
    return _GAP + max(_LINE * lines, _CHARACTER * _LONGEST_CHOICE - _LINE if turned else 0.0)


def _label_choices(axis: go.layout.XAxis, panel_width: float) -> None:
    """Write the choices of a parameter below their places so that no two of them meet."""
    choices = [value.strip("'") for value in axis.categoryarray]
    width = int(panel_width / len(choices) / _CHARACTER)
    upright = width >= min(_FEWEST_UPRIGHT, max(map(len, choices)))
    texts = [wrapped(choice, width) if upright else _plain(choice, _LONGEST_CHOICE) for choice in choices]
    axis.update(range=[-0.5, len(choices) - 0.5], tickvals=axis.categoryarray, ticktext=texts)
    axis.update(tickangle=0 if upright else -90)


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


def _decades(values: Sequence[float]) -> dict[str, Any]:
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


def _history(
    study: optuna.Study, objective: str, target: Target | None, axis: Mapping[str, Any], title: str
) -> go.Figure:
    figure = plot_optimization_history(study, target=target, target_name=MEASURES[objective].title)
    _styled(figure, f"Values of the complete trials{title}", 440)
    # With few trials, Plotly would put ticks between them.
    every = 1 if len(study.trials) <= 10 else None
    return figure.update_xaxes(title_text="trial", tickformat="d", dtick=every).update_yaxes(**axis)


def _pareto(
    study: optuna.Study, complete: Sequence[FrozenTrial], objectives: Sequence[str], pair: tuple[int, int]
) -> go.Figure:
    names = [objectives[index] for index in pair]
    figure = plot_pareto_front(
        study,
        targets=lambda trial: [trial.values[index] for index in pair],
        target_names=[MEASURES[name].label for name in names],
    )
    _styled(figure, "Pareto front: no other trial is better in every objective", 480)
    figure.update_xaxes(**_value_axis(complete, names[0], pair[0]))
    return figure.update_yaxes(**_value_axis(complete, names[1], pair[1]))


def _importance(
    study: optuna.Study, keys: Mapping[str, str], target: Target | None, title: str
) -> tuple[go.Figure | None, list[str]]:
    """Return the bars, None if all trials have the same values, and the keys, the most important first."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # for any target: that low values are considered good
        figure = plot_param_importances(study, evaluator=_EVALUATOR, target=target)
    (bars,) = figure.data
    ranked = sorted(keys, key=dict(zip(bars.y, bars.x, strict=True)).__getitem__, reverse=True)
    bars.update(y=[_plain(keys[key], 40) for key in bars.y], hovertemplate="%{y}: %{x:.0%}<extra></extra>")
    _styled(figure, f"Which parameters mattered most{title}", 150 + 34 * len(keys), legend=False)
    # Room for the figures beside the bars.
    figure.update_xaxes(title_text="importance", tickformat=".0%", range=(0, 1.2 * max(*bars.x, 1e-9)))
    figure.update_yaxes(title_text="", automargin=True, ticksuffix="  ")
    return figure if any(bars.x) else None, ranked


def _slices(
    study: optuna.Study,
    shown: Sequence[str],
    keys: Mapping[str, str],
    target: Target,
    objective: str,
    axis: Mapping[str, Any],
    title: str,
) -> go.Figure:
    figure = plot_slice(study, list(shown), target=target, target_name=MEASURES[objective].title)
    panels = _panels(figure)
    _styled(figure, f"Each parameter against the value{title}", _PANEL, legend=False)
    figure.update_traces(marker={"size": 7, "colorscale": "Viridis", "line": {"width": 0}})
    figure.update_xaxes(tickangle=0, nticks=4, exponentformat="power", title_standoff=6, tickfont_size=11)
    figure.for_each_xaxis(lambda axis: _label_choices(axis, _PANEL_WIDTH), {"type": "category"})
    for trace in figure.data:
        x_axis = figure.layout[f"xaxis{(trace.xaxis or 'x')[1:]}"]
        if x_axis.type == "log":
            x_axis.update(_decades(trace.x))
    figure.for_each_xaxis(lambda each: each.title.update(text=_plain(keys[each.title.text], 40)))
    body = _arrange(figure, panels, min(_COLUMNS, len(panels)))
    figure.update_layout(
        height=round(body + 60 + _label_height(figure)), margin={"r": 90, "b": _label_height(figure)}
    )
    figure.update_yaxes({**axis, "title_text": ""})
    for number in panels[::_COLUMNS]:
        figure.layout[f"yaxis{number}"].title.text = MEASURES[objective].label
    return figure


def _parallel(
    complete: Sequence[FrozenTrial], shown: Sequence[str], keys: Mapping[str, str], objectives: Sequence[str]
) -> go.Figure:
    """Draw every complete trial as a line through its parameters, coloured by its first objective."""
    axes = []
    for index, objective in enumerate(objectives):
        low, high = _value_axis(complete, objective, index)["range"]
        values = [_short(min(max(trial.values[index], low), high)) for trial in complete]
        axes.append({"label": MEASURES[objective].label, "values": values, "range": (low, high)})
    axes += [_parameter_axis(key, keys[key], complete) for key in shown]
    crowded = len(axes) > 7
    lines = go.Parcoords(
        dimensions=axes,
        line={
            "color": axes[0]["values"],
            "colorscale": "Viridis",
            "reversescale": not MEASURES[objectives[0]].minimize,
            "showscale": True,
            "colorbar": {"title": {"text": axes[0]["label"], "side": "right"}, "thickness": 14},
        },
        labelangle=-12 if crowded else 0,
        tickfont={"size": 10},
        rangefont={"size": 1, "color": "rgba(0,0,0,0)"},  # the ends are among the ticks
        unselected={"line": {"opacity": 0.06}},
    )
    figure = _styled(go.Figure(lines), "Every complete trial a line: drag along an axis to choose", 480)
    return figure.update_layout(margin={"l": 90, "r": 40, "t": 130 if crowded else 110, "b": 30})


def _parameter_axis(key: str, label: str, trials: Sequence[FrozenTrial]) -> dict[str, Any]:
    """Return an axis of parallel coordinates; a trial without the parameter crosses it at a dash."""
    distribution: Any = next(trial.distributions[key] for trial in trials if key in trial.params)
    params = [trial.params.get(key) for trial in trials]
    lacking = [NONE] * (None in params)
    axis: dict[str, Any] = {"label": _plain(label, 40)}
    if isinstance(distribution, CategoricalDistribution):
        choices = [choice for choice in distribution.choices if choice in params]
        ticks = lacking + [_plain(choice, _LONGEST_CHOICE) for choice in choices]
        places = [0 if value is None else len(lacking) + choices.index(value) for value in params]
        return axis | {"values": places, "tickvals": list(range(len(ticks))), "ticktext": ticks}
    scale: Callable[[float], float] = math.log10 if distribution.log else float
    low, high = scale(distribution.low), scale(distribution.high)
    ends = [low + part * (high - low) / 4 for part in range(5)]
    texts = [parameter(10**end if distribution.log else end) for end in ends]
    below = low - 0.12 * (high - low or 1.0)
    axis["values"] = [below if value is None else _short(scale(value)) for value in params]
    top = high if high > low else low + 1.0
    if lacking:
        return axis | {"range": (below, top), "tickvals": [below, *ends], "ticktext": [NONE, *texts]}
    return axis | {"range": (low, top), "tickvals": ends, "ticktext": texts}


def _entropy_curves(study: optuna.Study, trials: Sequence[FrozenTrial]) -> go.Figure | None:
    """Draw the entropy of every trial's policy during training, coloured by the trial's ending."""
    rows = {trial.number: runs for trial in trials if (runs := _rows(study, trial))}
    if not rows:
        return None
    every = [row for runs in rows.values() for run in runs for row in run]
    column = "entropy_share" if any(row.get("entropy_share") is not None for row in every) else "entropy"
    drawn = [trial for trial in trials if trial.number in rows]
    figure = go.Figure()
    for ending, style in ENDINGS.items():
        numbers = [trial.number for trial in drawn if ending_of(trial) == ending]
        if numbers:
            some = {number: rows[number] for number in numbers}
            line = {"color": style.color, "dash": style.dash, "width": 1.3}
            most = max(_FEWEST_POINTS, _MOST_POINTS // sum(map(len, rows.values())))
            curves = _curves(some, column, most)
            figure.add_trace(curves.update(name=ending_words(ending), line=line, opacity=0.75))
    if any(trial.state == TrialState.COMPLETE for trial in trials):
        best = best_trial(study)
        if best.number in rows:
            line = {"color": ENDINGS[ending_of(best)].color, "width": 4.5}
            curves = _curves({best.number: rows[best.number]}, column, _MOST_POINTS)
            figure.add_trace(curves.update(name=f"best: trial {best.number}", line=line))
    _styled(figure, "Entropy of the policies, by ending of their trials", 460)
    figure.update_xaxes(title_text="control steps", rangemode="tozero")
    if column == "entropy_share":
        return figure.update_yaxes(title_text="entropy, share of a random policy's", tickformat=".0%")
    return figure.update_yaxes(title_text="entropy, nats")


def _curves(rows: Mapping[int, list[list[dict[str, Any]]]], column: str, most: int) -> go.Scatter:
    """Return the curves of trials as one trace with gaps between them, since hundreds of traces would be slow."""
    x: list[int | None] = []
    y: list[float | None] = []
    numbers: list[int] = []
    for number, runs in rows.items():
        for run in runs:
            measured = [row for row in run if row.get(column) is not None and math.isfinite(row[column])]
            some = thinned(measured, most)
            x += [*(int(row["env_steps"]) for row in some), None]
            y += [*(round(row[column], 4) for row in some), None]
            numbers += [number] * (len(some) + 1)
    hover = "<b>Trial %{customdata}</b><br>%{x:.3s} steps: %{y:.3f}<extra></extra>"
    return go.Scatter(x=x, y=y, mode="lines", customdata=numbers, hovertemplate=hover)


def _rows(study: optuna.Study, trial: FrozenTrial) -> list[list[dict[str, Any]]]:
    """Return the rows of a trial's runs, without runs whose files are gone or incomplete."""
    base = Path(study.user_attrs.get("runs_dir", "runs")) / study.study_name
    by_run = []
    for run in Trial.of(trial).runs:
        try:
            rows = read_metrics(run.folder(base) / METRICS)
        except BadInput:
            continue
        if rows := [row for row in rows if isinstance(row.get("env_steps"), int)]:
            by_run.append(rows)
    return by_run


def thinned(rows: Sequence[Any], most: int) -> list[Any]:
    """Return at most `most` rows at even distances, the first and the last among them."""
    if len(rows) <= most:
        return list(rows)
    return [rows[round(k * (len(rows) - 1) / (most - 1))] for k in range(most)]


def _plain(text: object, longest: int = 90) -> str:
    """Return a text escaped for Plotly, which reads tags and entities as HTML."""
    cut = str(text) if len(str(text)) <= longest else f"{str(text)[: longest - 1]}…"
    return html.escape(cut, quote=False)


def _short(value: float) -> float:
    """Return a value with only the digits that can be seen, because a page has tens of thousands of values."""
    return float(f"{value:.5g}")
