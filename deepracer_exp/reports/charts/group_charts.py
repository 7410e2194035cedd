"""Groups of runs in figures: learning curves with bands over seeds, and the scores of the best checkpoints."""

from collections.abc import Sequence

import numpy as np

from deepracer_exp.reports.tables.group_tables import CURVES, group_curve
from deepracer_exp.reports.tables.groups import FORMS, RunGroup, courses_of

from .figure import Chart, Layer, Panel, band, in_rows, line, points
from .style import BLUE, CATEGORIES, ORANGE

_TITLES = {
    "eval_lap_time_s": ("Lap of the evaluated policy, usual conditions", "mean complete lap, s"),
    "eval_completion": ("Completion of the evaluated policy", "per cent of the lap"),
    "eval_race_score_s": ("Race score, usual and held-out conditions", "seconds per complete lap"),
    "completion": ("Completion in training", "per cent of the lap"),
    "mean_return": ("Return of an episode", "return"),
    "mean_lap_time_s": ("Lap in training, exploring", "mean complete lap, s"),
}
"""Titles and axes of `CURVES`."""


def learning_curve_charts(groups: Sequence[RunGroup]) -> list[Chart]:
    """Draw the learning curves of groups, a chart a track: a group of several seeds as its mean with a band."""
    courses = courses_of(groups)
    charts = [_learning_curves(groups, course, len(courses) > 1) for course in courses]
    return [chart for chart in charts if chart is not None]


def _learning_curves(groups: Sequence[RunGroup], course: str, several: bool) -> Chart | None:
    here = [(number, runs) for number, group in enumerate(groups) if (runs := group.on(course)).records]
    longest = max(
        (float(record.rows[-1]["env_steps"]) for _, runs in here for record in runs.records if record.rows),
        default=0,
    )
    factor, unit = (1e-6, "million control steps") if longest >= 2e6 else (1e-3, "thousand control steps")
    panels: list[Panel] = []
    named: set[str] = set()
    for column in CURVES:
        layers: list[Layer] = []
        for number, group in here:
            table = group_curve(group, column).replace([np.inf], np.nan)
            if not table["iqm"].notna().any():
                continue
            color, dashed = CATEGORIES[number % len(CATEGORIES)], number >= len(CATEGORIES)
            # A group that completes no lap is not in the first panel.
            steps, name = factor * table["env_steps"], None if group.name in named else group.name
            named.add(group.name)
            if table["low"].notna().any():
                layers.append(band(steps, table["low"], table["high"], color))
            layers.append(line(steps, table["iqm"], color, name, width=2.5, dashed=dashed))
        if layers:
            title, label = _TITLES[column]
            panels.append(Panel(title=title, x_label=unit, y_label=label, layers=layers))
    if not panels:
        return None
    seeds = sorted({len(runs.records) for _, runs in here})
    words = (
        f"Lines are interquartile means over {' or '.join(map(str, seeds))} runs, bands their bootstrap intervals "
        "(95 per cent; from three runs on)"
        if seeds[-1] > 1
        else "Each line is one run, so that nothing says how much of a difference is chance"
    )
    return Chart(
        name=f"learning_curves_{courses_name(course)}" if several else "learning_curves",
        title=f"Learning curves on {course}" if several else "Learning curves",
        caption=f"{words}. An evaluation takes the most probable actions; a run whose policy completes no lap "
        "counts as slower than any, and where more than a quarter of the runs completes none, the line has a gap. "
        "Curves of the training are moving averages of three iterations.",
        rows=in_rows(panels),
    )


def courses_name(course: str) -> str:
    """Return the name of a track, or of several, as part of a figure's name."""
    return "".join(letter if letter.isalnum() else "_" for letter in course)


def best_checkpoints(groups: Sequence[RunGroup]) -> Chart | None:
    """Draw the figures of each run's best checkpoint by group and track, with their interquartile mean and interval."""
    places = [(group, course) for group in groups for course in group.courses]
    several = len(courses_of(groups)) > 1
    names = [group.name + f" on {course}" * several for group, course in places]
    panels = []
    for figure in FORMS:
        layers: list[Layer] = []
        for place, (group, course) in enumerate(places):
            runs = group.on(course)
            scores = runs.scores(figure)
            finite, estimate = np.sort(scores[np.isfinite(scores)]), runs.estimate(figure)
            if not len(finite) or estimate is None:
                continue
            spread = place + 0.4 * ((np.arange(len(finite)) + 0.5) / len(finite) - 0.5)
            layers.append(points(finite, spread, BLUE, size=8))
            if estimate.interval is not None and np.isfinite([estimate.iqm, *estimate.interval]).all():
                low, high = estimate.interval
                layers.append(line([low, estimate.iqm, high], [place, place, place], ORANGE))
                layers.append(points([estimate.iqm], [place], ORANGE, size=13, symbol="diamond"))
        if layers:
            panels.append(Panel(x_label=FORMS[figure][0], layers=layers, y_names=names))
    if not panels:
        return None
    return Chart(
        name="best_checkpoints",
        title="Best checkpoints",
        caption="Points are runs, by the evaluation of their best checkpoint; diamonds are interquartile means with "
        "their intervals (95 per cent). Runs without a complete lap have no point in seconds.",
        rows=[[panel] for panel in panels],
    )
