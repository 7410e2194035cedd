"""The pictures of a study: how its search went, what mattered, and how the trials' entropy did."""

import html
import math
import random
from collections.abc import Callable, Sequence
from itertools import accumulate, combinations
from typing import Any

import optuna
import plotly.graph_objects as go
from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.trial import FrozenTrial, TrialState
from plotly.subplots import make_subplots

from deepracer_exp.analysis.chart import FAINT, INK
from deepracer_exp.analysis.chart_layout import GRID, SPINE
from deepracer_exp.analysis.chart_plotly import base_layout
from deepracer_exp.analysis.chart_plotly_panel import NARROW_WIDTH

from .fates import FATES, fate_of, words
from .labels import MEASURES, number, objectives_of, short_keys, shown

FEWEST_COMPLETE = 20
"""Complete trials below which a parameter's importance is chance: the best quarter would be less than five trials."""
_RESAMPLES = 40
_FAR = 5.0
"""Times the distance from the best to the median, from which on worse trials stand at the edge of an axis."""
_NEAR = 0.25
"""Share of the best value that a trial may be worse by without standing at the edge."""
_MOST_PARAMETERS = 12
_PANEL, _GAP = 210.0, 62.0
"""Height of a panel on a narrow screen and the room between two of them, pixels."""
_STEPS = tuple(step * 10.0**decade for decade in range(-3, 6) for step in (1, 2, 5))


def figures(study: optuna.Study) -> dict[str, go.Figure]:
    """Draw a study's pictures, each of them only if there is enough to show.

    Returns:
        By name: `history`, `pareto` (several objectives), `importance`, `slice`, `parallel`, `entropy`.

    Raises:
        BadInput: the study was not made by a sweep.
    """
    # They draw with what is defined here.
    from .entropy_figure import entropy_curves
    from .parameter_figures import parallel, slices

    objectives = objectives_of(study)
    trials = study.get_trials(deepcopy=False)
    drawn: dict[str, go.Figure | None] = {
        "history": history(objectives, trials),
        "pareto": pareto(study, objectives, trials) if len(objectives) > 1 else None,
        "importance": None,
        "slice": None,
        "parallel": None,
        "entropy": entropy_curves(study, trials),
    }
    if parameters := Parameters(study, trials):
        drawn["importance"] = importance_bars(parameters)
        drawn["slice"] = slices(objectives, trials, parameters)
        drawn["parallel"] = parallel(objectives, trials, parameters)
    return {name: figure for name, figure in drawn.items() if figure is not None}


def value_of(trial: FrozenTrial, objectives: Sequence[str], at: int) -> float | None:
    """Return a trial's value of one objective: of a pruned one the last it had, None if it has none."""
    value: float | None = None
    if trial.state == TrialState.COMPLETE:
        value = trial.values[at]
    elif trial.state == TrialState.PRUNED and len(objectives) == 1 and trial.intermediate_values:
        value = trial.intermediate_values[max(trial.intermediate_values)]
    return value if value is not None and math.isfinite(value) else None


def plain(text: object, longest: int = 90) -> str:
    """Return a text for Plotly, which takes tags and entities for what they are in HTML."""
    cut = str(text) if len(str(text)) <= longest else f"{str(text)[: longest - 1]}…"
    return html.escape(cut, quote=False)


def short(value: float) -> float:
    """Return a value with as many digits as anybody can see: a page has tens of thousands of them."""
    return float(f"{value:.5g}")


def thinned(rows: Sequence[Any], most: int) -> list[Any]:
    """Return at most so many rows at even distances, the first and the last among them."""
    if len(rows) <= most:
        return list(rows)
    return [rows[round(at * (len(rows) - 1) / (most - 1))] for at in range(most)]


def styled(figure: go.Figure, title: str, height: int, *, legend: bool = True) -> go.Figure:
    """Give a figure the look that all share."""
    figure.update_layout(
        base_layout(title),
        meta={"title": title},
        height=height,
        margin={"l": 70, "r": 20, "t": 60, "b": 60},
        showlegend=legend,
        legend={"itemsizing": "constant", "font": {"size": 13}},
    )
    axes = {"gridcolor": GRID, "zeroline": False, "linecolor": SPINE, "title": {"font": {"size": 13}}}
    figure.update_xaxes(**axes)
    figure.update_yaxes(**axes)
    return figure


def narrowed(figure: go.Figure) -> go.Figure:
    """Return a figure with a layout for a narrow screen: its panels below each other, the legend below them."""
    used = {trace.yaxis or "y" for trace in figure.data if "yaxis" in trace}
    panels = sorted((axis for axis in used), key=lambda axis: int(axis[1:] or 1))
    layout, narrow = figure.layout, go.Figure(layout=figure.layout)
    narrow.update_layout(base_layout(layout.meta["title"], NARROW_WIDTH))
    head = layout.margin.t + 20.0 * narrow.layout.title.text.count("<br>")
    names = {trace.name for trace in figure.data if trace.name} if layout.showlegend else ()
    foot = layout.margin.b + 22.0 * len(names)
    bodies = (
        len(panels) * (_PANEL + _GAP) - _GAP if panels else layout.height - layout.margin.t - layout.margin.b
    )
    if len(panels) > 1:
        for at, axis in enumerate(panels):
            top = 1 - at * (_PANEL + _GAP) / bodies
            narrow.layout[f"yaxis{axis[1:]}"].domain = (max(0.0, top - _PANEL / bodies), top)
            narrow.layout[f"xaxis{axis[1:]}"].domain = (0.0, 1.0)
    narrow.update_layout(
        height=round(head + bodies + foot),
        margin={"l": 62, "r": 12, "t": head, "b": foot},
        legend={"orientation": "h", "x": 0, "y": -layout.margin.b / bodies, "yanchor": "top"},
    )
    return narrow


def least_width(figure: go.Figure) -> int:
    """Return the pixels below which a figure cannot be read: each of many parallel axes needs room for its values."""
    return max((95 * len(trace.dimensions) for trace in figure.data if trace.type == "parcoords"), default=0)


def usual_range(complete: Sequence[float], values: Sequence[float], minimize: bool) -> tuple[float, float]:
    """Return the ends of an axis that trials far worse than the better half do not squeeze: these stand at its edge.

    A trial without a lap comes to ten times the seconds of one with laps, beside which all laps look the same.

    Args:
        complete: what the complete trials came to, whose better half says what is usual.
        values: what all trials came to, one at least.
        minimize: whether less is better.
    """
    sign = 1.0 if minimize else -1.0
    costs = sorted(sign * value for value in values)
    judged = sorted(sign * value for value in complete) or costs
    best, median = judged[0], judged[max((len(judged) - 1) // 2, min(1, len(judged) - 1))]
    edge = max(median + _FAR * (median - best), best + _NEAR * abs(best))
    inside = [cost for cost in costs if cost <= edge]
    # A tenth more than the usual ones, so that the edge is not where the worst of them is.
    worst = inside[-1] if len(inside) == len(costs) else inside[-1] + 0.1 * (inside[-1] - costs[0])
    ends = sorted((sign * costs[0], sign * worst))
    return ends[0], ends[1]


class ValueAxis:
    """An axis of an objective; what lies beyond its end is drawn at its edge."""

    def __init__(self, objective: str, trials: Sequence[FrozenTrial], objectives: Sequence[str]) -> None:
        """Look at the values of all trials."""
        at = objectives.index(objective)
        self.name, self.measure = objective, MEASURES[objective]
        found = {trial.number: value_of(trial, objectives, at) for trial in trials}
        self.values = {trial: value for trial, value in found.items() if value is not None}
        """By the number of the trial, those that have one."""
        complete = [trial.values[at] for trial in trials if trial.state == TrialState.COMPLETE]
        minimize = self.measure.minimize
        low, high = usual_range(complete, list(self.values.values()), minimize) if self.values else (0.0, 0.0)
        self.ends = (low, high) if high > low else (low - 0.5, high + 0.5)
        """The lowest and highest place."""
        self.beyond = [value for value in self.values.values() if not self.ends[0] <= value <= self.ends[1]]
        """Values that stand at its edge."""

    def place(self, trial: FrozenTrial) -> float:
        """Return where a trial is drawn."""
        low, high = self.ends
        return short(min(max(self.values[trial.number], low), high))

    def ticks(self) -> dict[str, Any]:
        """Return values and texts of ticks; where trials stand at its edge the tick there says so."""
        low, high = self.ends
        step = next(s for s in _STEPS if (high - low) / s <= 6)
        numbers = [step * at for at in range(math.ceil(low / step), math.floor(high / step) + 1)]
        texts = [f"{one:.10g}" for one in numbers]
        if self.beyond:
            edge, sign = (high, "≥") if self.measure.minimize else (low, "≤")
            kept = [at for at, one in enumerate(numbers) if abs(edge - one) > 0.5 * step]
            numbers, texts = [numbers[at] for at in kept], [texts[at] for at in kept]
            numbers.append(edge)
            texts.append(f"{sign} {edge:.4g}")
        return {"tickvals": numbers, "ticktext": texts}

    def beyond_words(self) -> str:
        """Return what stands at the edge: ``2 trials at the edge lie beyond it: 226.00 s to 230.00 s``."""
        ends = dict.fromkeys(shown(self.name, one) for one in (min(self.beyond), max(self.beyond)))
        plural = "s" * (len(self.beyond) > 1)
        return f"{len(self.beyond)} trial{plural} at the edge lie{'' if plural else 's'} beyond it: {' to '.join(ends)}"

    def layout(self) -> dict[str, Any]:
        """Return the settings of the axis."""
        low, high = self.ends
        margin = 0.06 * (high - low)
        return {"title": {"text": self.measure.label}, "range": [low - margin, high + margin], **self.ticks()}


def log_axis(low: float, high: float) -> dict[str, Any]:
    """Return the settings of a logarithmic axis with whole numbers at its ticks."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 5) if high / low < 50 else (1,)
    ticks = [step * 10.0**decade for decade in decades for step in steps]
    if sum(low <= tick <= high for tick in ticks) < 2:
        ticks = [low, high]
    margin = 0.04 * math.log10(high / low)
    return {
        "type": "log",
        "tickvals": ticks,
        "ticktext": [number(tick) for tick in ticks],
        "range": [math.log10(low) - margin, math.log10(high) + margin],
    }


def by_fate(trials: Sequence[FrozenTrial]) -> dict[str, list[FrozenTrial]]:
    """Return trials by their fate, in the order of FATES."""
    groups = {fate: [trial for trial in trials if fate_of(trial) == fate] for fate in FATES}
    return {fate: found for fate, found in groups.items() if found}


_MOST_REASONS = 300  # that a pointing reader is told; the table has them
HOVER = "<b>Trial %{customdata[0]}</b><br>%{customdata[1]}<br>%{customdata[2]}<extra></extra>"


def told(trials: Sequence[FrozenTrial], objectives: Sequence[str]) -> list[list[Any]]:
    """Return what a reader who points at a trial is told: its number, its values, why it ended."""
    lines = []
    for trial in trials:
        values = [value_of(trial, objectives, at) for at in range(len(objectives))]
        pairs = zip(objectives, values, strict=True)
        known = [f"{MEASURES[name].words} {shown(name, value)}" for name, value in pairs if value is not None]
        if trial.user_attrs.get("lap_time_s") is None:
            known.append("no complete lap")
        reason = trial.user_attrs.get("reason") if len(trials) <= _MOST_REASONS else None
        lines.append([trial.number, ", ".join(known), plain(reason or words(fate_of(trial)))])
    return lines


def marks(trials: Sequence[FrozenTrial], fate: str, x: Sequence[Any], y: Sequence[Any]) -> go.Scatter:
    """Return points of trials of one fate."""
    look = FATES[fate]
    marker = {"color": look.color, "symbol": look.symbol, "size": 9, "opacity": 0.85}
    return go.Scatter(x=x, y=y, mode="markers", name=words(fate), legendgroup=fate, marker=marker)


def history(objectives: Sequence[str], trials: Sequence[FrozenTrial]) -> go.Figure | None:
    """Draw what each trial came to, and the best until then."""
    figure = make_subplots(rows=len(objectives), shared_xaxes=True, vertical_spacing=0.07)
    seen: set[str] = set()
    for row, objective in enumerate(objectives, 1):
        axis = ValueAxis(objective, trials, objectives)
        known = [trial for trial in trials if trial.number in axis.values]
        if not known:
            return None
        for fate, some in by_fate(known).items():
            points = marks(some, fate, [trial.number for trial in some], list(map(axis.place, some)))
            points.update(hovertemplate=HOVER, customdata=told(some, objectives), showlegend=fate not in seen)
            seen.add(fate)
            figure.add_trace(points, row=row, col=1)
        complete = [trial for trial in known if trial.state == TrialState.COMPLETE]
        better: Callable[[float, float], float] = min if axis.measure.minimize else max
        line = go.Scatter(
            x=[trial.number for trial in complete], y=list(accumulate(map(axis.place, complete), better)),
            mode="lines", name="best so far", legendgroup="best", hoverinfo="skip", showlegend=row == 1,
            line={"color": INK, "width": 1.6, "shape": "hv"},
        )  # fmt: skip
        figure.add_trace(line, row=row, col=1)
        figure.update_yaxes(axis.layout(), row=row, col=1)
        if axis.beyond:
            figure.add_annotation(
                text=axis.beyond_words(), x=1, xref="x domain", xanchor="right", y=1 if axis.measure.minimize else 0,
                yref="y domain", yanchor="bottom" if axis.measure.minimize else "top", showarrow=False,
                font={"size": 12, "color": FAINT}, row=row, col=1,
            )  # fmt: skip
    figure.update_xaxes(tickformat="d", nticks=min(12, len(trials) + 1))
    figure.update_xaxes(title_text="trial", row=len(objectives), col=1)
    title = "What the trials came to" + " (pruned ones: what they had by then)" * (len(objectives) == 1)
    return styled(figure, title, 160 + 280 * len(objectives))


def pareto(study: optuna.Study, objectives: Sequence[str], trials: Sequence[FrozenTrial]) -> go.Figure | None:
    """Draw the complete trials by each two objectives, with those that no other beats in both in a ring."""
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    if not complete:
        return None
    front = {trial.number for trial in study.best_trials}
    pairs = list(combinations(objectives, 2))
    figure = make_subplots(cols=len(pairs), horizontal_spacing=0.08)
    for column, names in enumerate(pairs, 1):
        first, second = (ValueAxis(name, complete, objectives) for name in names)
        for fate, some in by_fate(complete).items():
            points = marks(some, fate, list(map(first.place, some)), list(map(second.place, some)))
            points.update(hovertemplate=HOVER, customdata=told(some, objectives), showlegend=column == 1)
            figure.add_trace(points, row=1, col=column)
        ring = sorted((first.place(one), second.place(one)) for one in complete if one.number in front)
        figure.add_trace(
            go.Scatter(
                x=[x for x, _ in ring], y=[y for _, y in ring], name="Pareto front", legendgroup="front",
                mode="lines+markers" if len(objectives) == 2 else "markers", hoverinfo="skip",
                line={"color": INK, "width": 1.2, "dash": "dot"}, showlegend=column == 1,
                marker={"size": 16, "color": INK, "symbol": "circle-open", "line": {"width": 1.8}},
            ),
            row=1, col=column,
        )  # fmt: skip
        figure.update_xaxes(first.layout(), row=1, col=column)
        figure.update_yaxes(second.layout(), row=1, col=column)
    return styled(figure, "Pareto front: no trial is better in everything than those in a ring", 480)


class Parameters:
    """What a study searched: its parameters, the most important first."""

    def __init__(self, study: optuna.Study, trials: Sequence[FrozenTrial]) -> None:
        """Look at all trials; a parameter may be of some of them only."""
        self.distributions: dict[str, BaseDistribution] = {}
        for trial in trials:
            self.distributions |= trial.distributions
        complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
        self.importance: dict[str, float] = {}
        self.interval: dict[str, tuple[float, float]] = {}
        """90 per cent of the importances that come out of as many trials drawn from these, with replacement."""
        self.complete = len(complete)
        differ = len({tuple(trial.values) for trial in complete}) > 1
        if len(self.distributions) > 1 and differ and len(complete) >= FEWEST_COMPLETE:
            evaluator = PedAnovaImportanceEvaluator(target_quantile=0.25)
            self.importance = get_param_importances(study, evaluator=evaluator)
            draws = [_importance_again(study, complete, evaluator, seed) for seed in range(_RESAMPLES)]
            for key in self.importance:
                shares = sorted(draw.get(key, 0.0) for draw in draws)
                self.interval[key] = shares[_RESAMPLES // 20], shares[-1 - _RESAMPLES // 20]
        order = sorted(self.distributions, key=lambda key: (-self.importance.get(key, 0.0), key))
        self.shown = order[:_MOST_PARAMETERS]
        """Those that there is room for."""
        self.labels = {key: plain(label, 40) for key, label in short_keys(order).items()}

    def __bool__(self) -> bool:
        """Return whether anything was searched."""
        return bool(self.distributions)

    def is_log(self, key: str) -> bool:
        """Return whether a parameter was searched on a logarithmic scale."""
        return bool(getattr(self.distributions[key], "log", False))

    def choices(self, key: str) -> list[str] | None:
        """Return what a parameter was chosen from, None for a number."""
        distribution = self.distributions[key]
        if not isinstance(distribution, CategoricalDistribution):
            return None
        cut = [plain(choice, 24) for choice in distribution.choices]
        return cut if len({*cut}) == len(cut) else [f"{at}: {one}" for at, one in enumerate(cut)]

    def shown_value(self, key: str, value: Any) -> Any:
        """Return what stands for a value on an axis: its choice's text, or the number itself."""
        choices, distribution = self.choices(key), self.distributions[key]
        if choices is None or not isinstance(distribution, CategoricalDistribution):
            return short(value)
        return choices[int(distribution.to_internal_repr(value))]

    def room(self, key: str) -> tuple[float, float]:
        """Return the ends of a number's range, which are never the same."""
        distribution: Any = self.distributions[key]
        low, high = float(distribution.low), float(distribution.high)
        return low, high if high > low else low + max(abs(low), 1e-9)


def _importance_again(
    study: optuna.Study, complete: Sequence[FrozenTrial], evaluator: PedAnovaImportanceEvaluator, seed: int
) -> dict[str, float]:
    """Return the importances in a bootstrap sample of a study's complete trials."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)  # it says of each study that it is made
    again = optuna.create_study(directions=study.directions)
    again.add_trials(random.Random(seed).choices(complete, k=len(complete)))
    return get_param_importances(again, evaluator=evaluator)


def importance_bars(parameters: Parameters) -> go.Figure | None:
    """Draw how much each parameter mattered for a trial to be among the best quarter (PED-ANOVA)."""
    if not parameters.importance:
        return None
    keys = [key for key in parameters.shown if key in parameters.importance][::-1]
    shares = [100 * parameters.importance[key] for key in keys]
    ends = [tuple(100 * end for end in parameters.interval[key]) for key in keys]
    bars = go.Bar(
        x=shares, y=[parameters.labels[key] for key in keys], orientation="h", marker_color="#0072B2",
        hovertext=[plain(key) for key in keys], hoverinfo="text",
        error_x={
            "type": "data", "symmetric": False, "color": INK, "thickness": 1.2, "width": 4,
            "array": [max(high - share, 0.0) for share, (_, high) in zip(shares, ends, strict=True)],
            "arrayminus": [max(share - low, 0.0) for share, (low, _) in zip(shares, ends, strict=True)],
        },
    )  # fmt: skip
    figure = styled(go.Figure(bars), "What mattered most", 150 + 34 * len(keys), legend=False)
    figure.update_xaxes(
        title_text="importance for being in the best quarter, %",
        range=[0, 128],
        tickvals=list(range(0, 101, 20)),
    )
    for key, share, (low, high) in zip(keys, shares, ends, strict=True):
        figure.add_annotation(
            text=f"{share:.0f} % ({low:.0f} to {high:.0f})", x=1, xref="x domain", xanchor="right",
            y=parameters.labels[key], showarrow=False, font={"size": 12, "color": INK},
        )  # fmt: skip
    figure.update_yaxes(automargin=True, ticksuffix="  ")
    return figure
