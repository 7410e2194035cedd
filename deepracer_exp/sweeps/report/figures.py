"""Figures of a study as plain data, as plotly.js draws them: Plotly's own objects cost seconds a page."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, combinations
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import CategoricalDistribution
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.analysis.charts.style import BLUE, ORANGE, PALE, SCALE, Figure
from deepracer_exp.errors import BadInput
from deepracer_exp.lean_imports import not_imported
from deepracer_exp.runs.files import METRICS, read_metrics
from deepracer_exp.sweeps.search.objectives import MEASURES, NONE, objectives_of
from deepracer_exp.sweeps.trial import Trial

from .best import best_trial
from .figure_layout import COLUMNS, LONGEST_CHOICE, PANEL, Axis, Trace, arrange_panels, decades, plain, styled
from .labels import ENDINGS, ending_of, ending_words, parameter, short_keys

FEWEST_COMPLETE = 20
"""Complete trials below which importance is chance: the best quarter would be fewer than five trials."""
_BEST_SHARE = 0.25
"""Share of the trials that importance compares with all."""
_MOST_PARAMETERS = 12
_FAR, _NEAR = 5.0, 0.25
"""A trial is off the axis if it is farther from the best than this many times the median is, and worse than the best
by more than this share of it."""
_MOST_POINTS, _FEWEST_POINTS = 15_000, 12
"""Most points of all entropy curves together (0.3 MB of the page), and fewest of one curve."""
_COLORS = [[index / (len(SCALE) - 1), color] for index, color in enumerate(SCALE)]

Target = Callable[[FrozenTrial], float]


def figures(study: optuna.Study) -> dict[str, Figure]:
    """Draw a study's figures, each only if there is enough to show.

    Returns:
        By name: `history`, `pareto` (several objectives), `importance`, `slice`, `parallel`, `entropy`. With several
        objectives `history`, `importance` and `slice` are one each, such as `slice-lap_time`, and `pareto` one per
        pair.
    """
    objectives = objectives_of(study)
    trials = study.get_trials(deepcopy=False)
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    drawn: dict[str, Figure] = {}
    if complete:
        keys = short_keys(sorted({key for trial in complete for key in trial.params}))
        shown = list(keys)[:_MOST_PARAMETERS]
        for index, objective in enumerate(objectives):
            several = len(objectives) > 1
            name, title = (f"-{objective}", f": {MEASURES[objective].words}") if several else ("", "")
            axis = _value_axis(complete, objective, index)
            drawn[f"history{name}"] = _history(trials, objective, index, axis, title, best=not several)
            if len(complete) >= FEWEST_COMPLETE and len(keys) > 1:
                # PED-ANOVA considers low values good.
                sign = 1.0 if MEASURES[objective].minimize else -1.0
                importances = _importances(study, _target(index, sign) if several else None)
                if any(importances.values()):
                    drawn[f"importance{name}"] = _importance(importances, keys, title)
                if index == 0:
                    shown = sorted(keys, key=importances.__getitem__, reverse=True)[:_MOST_PARAMETERS]
            if keys:
                drawn[f"slice{name}"] = _slices(complete, shown, keys, index, axis, title)
        for pair in combinations(range(len(objectives)), 2):
            names = [objectives[index] for index in pair] if len(objectives) > 2 else []
            drawn["-".join(["pareto", *names])] = _pareto(study, complete, objectives, pair)
        if keys and len(complete) > 1:
            drawn["parallel"] = _parallel(complete, shown, keys, objectives)
    entropy = _entropy_curves(study, trials)
    return drawn if entropy is None else drawn | {"entropy": entropy}


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


def _target(index: int, sign: float) -> Target:
    return lambda trial: sign * trial.values[index]


def _value_axis(complete: Sequence[FrozenTrial], objective: str, index: int) -> Axis:
    measure = MEASURES[objective]
    values = [trial.values[index] for trial in complete]
    return {"title": measure.label, "range": usual_range(values, measure.minimize)}


def _history(
    trials: Sequence[FrozenTrial], objective: str, index: int, axis: Axis, title: str, *, best: bool
) -> Figure:
    """Draw the values of the complete trials by their numbers; with `best` the best so far, too."""
    measure = MEASURES[objective]
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    numbers, values = [trial.number for trial in complete], [trial.values[index] for trial in complete]
    traces = [_points(numbers, values, BLUE, measure.title)]
    if best:
        # On to the last trial, which need not be complete.
        so_far = list(accumulate(values, min if measure.minimize else max))
        line = {"color": ORANGE, "shape": "hv"}
        x, y = [*numbers, trials[-1].number], [*so_far, so_far[-1]]
        traces.append(
            {"type": "scatter", "mode": "lines", "x": x, "y": y, "name": "best so far", "line": line}
        )
    # With few trials, Plotly would put ticks between them.
    every = 1 if len(trials) <= 10 else None
    axes = {"xaxis": {"title": "trial", "tickformat": "d", "dtick": every}, "yaxis": axis}
    return styled(traces, f"Values of the complete trials{title}", 440, axes)


def _points(x: Sequence[float], y: Sequence[float], color: str, name: str) -> Trace:
    return {"type": "scatter", "mode": "markers", "x": x, "y": y, "name": name, "marker": {"color": color}}


def _pareto(
    study: optuna.Study, complete: Sequence[FrozenTrial], objectives: Sequence[str], pair: tuple[int, int]
) -> Figure:
    """Draw the complete trials in the plane of two objectives, those of the front in another colour."""
    front = {trial.number for trial in study.best_trials}
    traces = []
    for name, color, is_best in (("other trials", PALE, False), ("Pareto front", BLUE, True)):
        some = [trial for trial in complete if (trial.number in front) == is_best]
        x, y = ([trial.values[index] for trial in some] for index in pair)
        text = {
            "text": [_words(trial, objectives) for trial in some],
            "hovertemplate": "%{text}<extra></extra>",
        }
        traces.append(_points(x, y, color, name) | text)
        traces[-1]["marker"] |= {"size": 8}
    axes = {
        name: _value_axis(complete, objectives[index], index)
        for name, index in zip(("xaxis", "yaxis"), pair, strict=True)
    }
    return styled(traces, "Pareto front: no other trial is better in every objective", 480, axes)


def _words(trial: FrozenTrial, objectives: Sequence[str]) -> str:
    """Return a trial's number, values and parameters, a line each."""
    values = zip((MEASURES[name].label for name in objectives), trial.values, strict=True)
    lines = [f"{name}: {parameter(value)}" for name, value in (*values, *trial.params.items())]
    return "<br>".join([f"<b>Trial {trial.number}</b>", *map(plain, lines)])


def _importances(study: optuna.Study, target: Target | None) -> dict[str, float]:
    """Return the share of each parameter in what makes the best quarter differ (PED-ANOVA, arXiv 2304.10255)."""
    # Optuna's other two methods import scikit-learn, which takes more time than all of the page.
    with not_imported("sklearn"):
        from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # for any target: that low values are considered good
        evaluator = PedAnovaImportanceEvaluator(target_quantile=_BEST_SHARE)
        return get_param_importances(study, evaluator=evaluator, target=target)


def _importance(importances: Mapping[str, float], keys: Mapping[str, str], title: str) -> Figure:
    """Draw importances as bars, the highest first."""
    ranked = sorted(importances, key=importances.__getitem__)
    x = [importances[key] for key in ranked]
    bars = {
        **{"type": "bar", "orientation": "h", "cliponaxis": False, "textposition": "outside"},
        **{"x": x, "y": [plain(keys[key], 40) for key in ranked]},
        "text": [f"{value:.0%}" if value >= 0.01 else "<1%" for value in x],
        "hovertemplate": "%{y}: %{x:.0%}<extra></extra>",
    }
    axes: dict[str, Axis] = {
        # Room for the figures beside the bars.
        "xaxis": {"title": "importance", "tickformat": ".0%", "range": (0, 1.2 * max(x))},
        "yaxis": {"automargin": True, "ticksuffix": "  "},
    }
    return styled([bars], f"Which parameters mattered most{title}", 150 + 34 * len(keys), axes, legend=False)


def _slices(
    complete: Sequence[FrozenTrial],
    shown: Sequence[str],
    keys: Mapping[str, str],
    index: int,
    axis: Axis,
    title: str,
) -> Figure:
    """Draw the values of the complete trials against each parameter, coloured by their numbers."""
    traces, axes = [], {}
    for place, key in enumerate(sorted(shown)):
        number = str(place + 1) if place else ""
        some = [trial for trial in complete if key in trial.params]
        distribution: Any = some[0].distributions[key]
        x: list[Any] = [trial.params[key] for trial in some]
        x_axis = {"title": plain(keys[key], 40), "standoff": 6, "anchor": f"y{number}", "nticks": 4}
        x_axis |= {"tickangle": 0, "exponentformat": "power", "tickfont": {"size": 11}}
        if isinstance(distribution, CategoricalDistribution):
            x, labels = list(map(repr, x)), list(map(repr, distribution.choices))
            x_axis |= {"type": "category", "categoryorder": "array", "categoryarray": labels}
        elif distribution.log:
            x_axis |= {"type": "log", **decades(x)}
        bar = {"title": {"text": "Trial"}, "x": 1.0, "xpad": 40}
        color = {"color": [trial.number for trial in some], "colorscale": _COLORS, "showscale": place == 0}
        traces.append(
            {
                **{"type": "scatter", "mode": "markers", "showlegend": False},
                **{"x": x, "y": [trial.values[index] for trial in some]},
                **{"xaxis": f"x{number}", "yaxis": f"y{number}"},
                "marker": {"size": 7, **color, "colorbar": bar},
            }
        )
        axes[f"xaxis{number}"] = x_axis
        axes[f"yaxis{number}"] = axis | {"anchor": f"x{number}", "matches": "y" if place else None}
        if place % COLUMNS:
            axes[f"yaxis{number}"]["title"] = ""
    figure = styled(
        *(traces, f"Each parameter against the value{title}", PANEL, axes), legend=False, margin={"r": 90}
    )
    arrange_panels(figure)
    return figure


def _parallel(
    complete: Sequence[FrozenTrial], shown: Sequence[str], keys: Mapping[str, str], objectives: Sequence[str]
) -> Figure:
    """Draw every complete trial as a line through its parameters, coloured by its first objective."""
    axes = []
    for index, objective in enumerate(objectives):
        low, high = _value_axis(complete, objective, index)["range"]
        values = [_short(min(max(trial.values[index], low), high)) for trial in complete]
        axes.append({"label": MEASURES[objective].label, "values": values, "range": (low, high)})
    axes += [_parameter_axis(key, keys[key], complete) for key in shown]
    crowded = len(axes) > 7
    lines = {
        "type": "parcoords",
        "dimensions": axes,
        "line": {
            "color": axes[0]["values"],
            "colorscale": _COLORS,
            "reversescale": not MEASURES[objectives[0]].minimize,
            "showscale": True,
            "colorbar": {"title": {"text": axes[0]["label"], "side": "right"}, "thickness": 14},
        },
        "labelangle": -12 if crowded else 0,
        "tickfont": {"size": 10},
        "rangefont": {"size": 1, "color": "rgba(0,0,0,0)"},  # the ends are among the ticks
        "unselected": {"line": {"opacity": 0.06}},
    }
    margin = {"l": 90, "r": 40, "t": 130 if crowded else 110, "b": 30}
    return styled(
        [lines], "Every complete trial a line: drag along an axis to choose", 480, legend=False, margin=margin
    )


def _parameter_axis(key: str, label: str, trials: Sequence[FrozenTrial]) -> dict[str, Any]:
    """Return an axis of parallel coordinates; a trial without the parameter crosses it at a dash."""
    distribution: Any = next(trial.distributions[key] for trial in trials if key in trial.params)
    params = [trial.params.get(key) for trial in trials]
    lacking = [NONE] * (None in params)
    axis: dict[str, Any] = {"label": plain(label, 40)}
    if isinstance(distribution, CategoricalDistribution):
        choices = [choice for choice in distribution.choices if choice in params]
        ticks = lacking + [plain(choice, LONGEST_CHOICE) for choice in choices]
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


def _entropy_curves(study: optuna.Study, trials: Sequence[FrozenTrial]) -> Figure | None:
    """Draw the entropy of every trial's policy during training, coloured by the trial's ending."""
    folder = Path(study.user_attrs.get("runs_dir", "runs")) / study.study_name
    rows = {trial.number: runs for trial in trials if (runs := _rows(folder, trial))}
    if not rows:
        return None
    every = [row for runs in rows.values() for run in runs for row in run]
    column = "entropy_share" if any(row.get("entropy_share") is not None for row in every) else "entropy"
    drawn = [trial for trial in trials if trial.number in rows]
    traces = []
    for ending, style in ENDINGS.items():
        numbers = [trial.number for trial in drawn if ending_of(trial) == ending]
        if numbers:
            some = {number: rows[number] for number in numbers}
            line = {"color": style.color, "dash": style.dash, "width": 1.3}
            most = max(_FEWEST_POINTS, _MOST_POINTS // sum(map(len, rows.values())))
            curves = {"name": ending_words(ending), "line": line, "opacity": 0.75}
            traces.append(_curves(some, column, most) | curves)
    if any(trial.state == TrialState.COMPLETE for trial in trials):
        best = best_trial(study)
        if best.number in rows:
            line = {"color": ENDINGS[ending_of(best)].color, "width": 4.5}
            curves = _curves({best.number: rows[best.number]}, column, _MOST_POINTS)
            traces.append(curves | {"name": f"best: trial {best.number}", "line": line})
    y_axis: Axis = {"title": "entropy, nats"}
    if column == "entropy_share":
        y_axis = {"title": "entropy, share of a random policy's", "tickformat": ".0%"}
    axes = {"xaxis": {"title": "control steps", "rangemode": "tozero"}, "yaxis": y_axis}
    return styled(traces, "Entropy of the policies, by ending of their trials", 460, axes)


def _curves(rows: Mapping[int, list[list[dict[str, Any]]]], column: str, most: int) -> Trace:
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
    curve = {"type": "scatter", "mode": "lines", "x": x, "y": y}
    return curve | {"customdata": numbers, "hovertemplate": hover}


def _rows(folder: Path, trial: FrozenTrial) -> list[list[dict[str, Any]]]:
    """Return the rows of a trial's runs in the folder of a study, without runs whose files are gone or incomplete."""
    by_run = []
    for run in Trial.of(trial).runs:
        try:
            rows = read_metrics(run.folder(folder) / METRICS)
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


def _short(value: float) -> float:
    """Return a value with only the digits that can be seen, because a page has tens of thousands of values."""
    return float(f"{value:.5g}")
