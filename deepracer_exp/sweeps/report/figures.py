"""Figures of a study, which Optuna draws, in the style of all pages."""

import json
import textwrap
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.reports.charts.style import FAINT, GRID, NARROW_WIDTH, SPINE, Figure, base_layout
from deepracer_exp.sweeps.search.objectives import MEASURES, objectives_of

if TYPE_CHECKING:
    import plotly.graph_objects as go

FEWEST_COMPLETE = 20
"""Fewest complete trials for a meaningful importance: the best quarter needs five trials."""
_BEST_SHARE = 0.25
"""Share of the trials whose parameters importance compares with all."""
_HEIGHT = 440
_PANEL_PX = 200
"""Least width of a panel, or of the room for an axis of parallel coordinates."""
_LETTERS = 20
"""Most letters in a line of the name of a colour bar or an axis."""
_FAR, _NEAR = 5.0, 0.25
"""A trial is off the axis if it is farther from the best than this many times the median is, and worse than the best
by more than this share of it."""

Target = Callable[[FrozenTrial], Any]


def figures(study: optuna.Study) -> dict[str, Figure]:
    """Draw a study's figures, each only if there is enough to show.

    Returns:
        By name: `history`, `importance`, `slice`, `parallel`, and with several objectives each of these for every
        objective, such as `slice-lap_time`, and `pareto` for every pair, such as `pareto-lap_time-completion`.
    """
    with warnings.catch_warnings():
        # Optuna says of any target that low values are considered good; ours are signed.
        warnings.simplefilter("ignore", UserWarning)
        return {name: _styled(figure, title) for name, title, figure in _drawn(study)}


def usual_range(values: Sequence[float], minimize: bool) -> tuple[float, float]:
    """Return the ends of an axis that resolves the better trials; far worse ones lie off it.

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


def importances(study: optuna.Study) -> dict[str, float]:
    """Return the importance of each searched key for the first objective, shares of 1, the largest first.

    Empty where too few trials are complete, or one key is searched.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(complete) < FEWEST_COMPLETE or len({key for trial in complete for key in trial.params}) < 2:
        return {}
    objectives = objectives_of(study)
    sign = 1.0 if MEASURES[objectives[0]].minimize else -1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return optuna.importance.get_param_importances(
            study, evaluator=_evaluator(), target=None if len(objectives) == 1 else _value(0, sign)
        )


def _evaluator() -> optuna.importance.PedAnovaImportanceEvaluator:
    return optuna.importance.PedAnovaImportanceEvaluator(target_quantile=_BEST_SHARE)


def _drawn(study: optuna.Study) -> "Iterator[tuple[str, str, go.Figure]]":
    # It imports scikit-learn and plotly, which take seconds.
    from optuna import visualization

    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete:
        return
    parameters = {key for trial in complete for key in trial.params}
    objectives = objectives_of(study)
    is_one = len(objectives) == 1
    ranges = [
        usual_range([trial.values[index] for trial in complete], MEASURES[name].minimize)
        for index, name in enumerate(objectives)
    ]
    for index, objective in enumerate(objectives):
        words, suffix = MEASURES[objective].label, "" if is_one else f"-{objective}"
        target = None if is_one else _value(index, 1.0)
        history = visualization.plot_optimization_history(study, target=target, target_name=words)
        yield (
            f"history{suffix}",
            f"Complete trials: {words}",
            history.update_yaxes(range=ranges[index], title=None),
        )
        if len(complete) >= FEWEST_COMPLETE and len(parameters) > 1:
            cost = None if is_one else _value(index, 1.0 if MEASURES[objective].minimize else -1.0)
            yield (
                f"importance{suffix}",
                f"Which parameters mattered most: {words}",
                visualization.plot_param_importances(
                    study, evaluator=_evaluator(), target=cost, target_name=words
                ).update_yaxes(title=None),
            )
        if parameters:
            slices = visualization.plot_slice(study, target=target, target_name=words)
            yield (
                f"slice{suffix}",
                f"Each parameter: {words}",
                slices.update_yaxes(range=ranges[index], title=None),
            )
        if len(parameters) > 1 and len(complete) > 1:
            yield (
                f"parallel{suffix}",
                f"Every complete trial a line: {words}",
                visualization.plot_parallel_coordinate(study, target=target, target_name=words),
            )
    for pair in combinations(range(len(objectives)), 2):
        names = [MEASURES[objectives[index]].label for index in pair]
        front = visualization.plot_pareto_front(
            study,
            targets=_values(pair),
            target_names=names,
        )
        yield (
            f"pareto-{'-'.join(objectives[index] for index in pair)}",
            "Pareto front: no other trial is better in every objective",
            # Of a thousand trials with all that is noted of them, the words would be three megabytes.
            front.update_traces(
                text=None, hovertemplate="trial %{marker.color}: %{x:.4g}, %{y:.4g}<extra></extra>"
            )
            .update_xaxes(range=ranges[pair[0]])
            .update_yaxes(range=ranges[pair[1]]),
        )


def _values(indices: Sequence[int]) -> Target:
    return lambda trial: [trial.values[index] for index in indices]


def _value(index: int, sign: float) -> Target:
    return lambda trial: sign * trial.values[index]


def _styled(figure: "go.Figure", title: str) -> Figure:
    figure.update_layout(template="none", height=_HEIGHT, margin={"t": 90})
    for update in (figure.update_xaxes, figure.update_yaxes):
        update(gridcolor=GRID, zeroline=False, automargin=True)
    drawn: Figure = json.loads(figure.to_json())
    for trace in drawn["data"]:
        bar = trace.get("marker", {}).get("colorbar")
        if bar is not None:  # a title in one line leaves no room for the plot on a phone
            bar["title"] = {"text": _in_lines(bar["title"]["text"])}
    layout = drawn["layout"]
    for note in layout.get("annotations", ()):
        note["font"] = {"size": 11, "color": FAINT}
    for line in layout.get("shapes", ()):
        line["line"]["color"] = SPINE
    # Parallel coordinates have one axis, with a tick for each parameter.
    names = [_in_lines(name) for name in layout["xaxis"].get("ticktext", ())]
    if names:
        layout["xaxis"] |= {"ticktext": names, "tickangle": 0}
    panels = len(names) or sum(name.startswith("xaxis") for name in layout)
    least_px = _PANEL_PX * panels if panels > 1 else 0
    layout |= base_layout(title) | {"meta": {"title": title, "least_width": least_px}}
    return drawn


def _in_lines(name: str) -> str:
    return "<br>".join(textwrap.wrap(name, _LETTERS))


def narrowed(figure: Figure) -> Figure:
    """Return a figure with a layout for a narrow screen: its title in several lines, its legend below."""
    layout = figure["layout"]
    narrow = layout | base_layout(layout["meta"]["title"], NARROW_WIDTH)
    return figure | {"layout": narrow | {"legend": {"orientation": "h", "y": -0.3}}}
