"""The scores of groups of runs and their differences, as tables, sentences and JSON."""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.errors import count
from deepracer_exp.runs.run_files import RunRecord
from deepracer_exp.runs.run_result import result_of

from .evidence import Estimate, Interval, iqm_band
from .groups import FORMS, VERDICT, Comparison, RunGroup, courses_of
from .log_tables import NONE, Table
from .statistics import Values, subsample


def scored(groups: Sequence[RunGroup]) -> Table:
    """Return the scores of each group: interquartile means over its runs, with intervals, on each track."""
    several = len(courses_of(groups)) > 1
    rows = []
    for group in groups:
        for course in group.courses:
            runs = group.on(course)
            figures = [figure_text(figure, runs.estimate(figure)) for figure in FORMS]
            rows.append((group.name, *[course] * several, str(len(runs.records)), *figures))
    heads = ("group", *["track"] * several, "runs", *(name for name, _, _ in FORMS.values()))
    return Table(heads, tuple(rows), 1 + several)


def figure_text(figure: str, estimate: Estimate | None) -> str:
    """Return an estimate as text: ``8.02 (7.91 to 8.20)``."""
    if estimate is None:
        return NONE
    form = FORMS[figure][1]
    middle = form.format(estimate.iqm) if math.isfinite(estimate.iqm) else "no lap"
    if estimate.interval is None or not math.isfinite(min(estimate.interval)):
        return middle
    return f"{middle} ({_ends(form, estimate.interval)})"


def _ends(form: str, interval: Interval) -> str:
    return " to ".join(form.format(end) if math.isfinite(end) else "no lap" for end in interval)


def differences_table(comparisons: Sequence[Comparison]) -> Table:
    """Return comparisons as texts; a column names the groups where there are several."""
    many = len({comparison.group for comparison in comparisons}) > 1
    several = len({comparison.course for comparison in comparisons}) > 1
    rows = []
    for comparison in comparisons:
        name, form, _ = FORMS[comparison.figure]
        if comparison.course is None:
            name, form = f"{name.partition(',')[0]}, % of the track's mean", "{:.1f}"
        apart, chance = comparison.difference, comparison.difference.probability_interval
        signed = form.replace(":", ":+")
        change = NONE if apart.iqm is None else signed.format(apart.iqm)
        if apart.interval is not None:
            change += f" ({_ends(signed, apart.interval)})"
        better = f"{apart.probability:.0%}" + (
            "" if chance is None else f" ({chance[0]:.0%} to {chance[1]:.0%})"
        )
        track = [comparison.course or "all tracks"] * several
        group = [comparison.group] * many
        rows.append((*group, *track, name, comparison.verdict, change, better))
    heads = ("figure", "verdict", "difference", "probability of improvement")
    return Table((*["group"] * many, *["track"] * several, *heads), tuple(rows), 2 + many + several)


def title_of(comparisons: Sequence[Comparison]) -> str:
    """Return the title of a table of comparisons: ``new against old``, or ``Against old`` for several groups."""
    names = {comparison.group for comparison in comparisons}
    return (
        f"{names.pop()} against {comparisons[0].other}"
        if len(names) == 1
        else f"Against {comparisons[0].other}"
    )


def sentences(groups: Sequence[RunGroup], comparisons: Sequence[Comparison]) -> list[str]:
    """Summarise the tables in sentences: first each group's differences from the first, and whether they are chance."""
    alone = len(courses_of(groups)) == 1
    single = all(len(group.records) == 1 for group in groups)
    verdicts: dict[str, list[Comparison]] = {}
    for comparison in comparisons:
        if comparison.figure in VERDICT and (comparison.course is None or alone):
            verdicts.setdefault(comparison.group, []).append(comparison)
    lines = [
        f"{name} against {groups[0].name}: {'; '.join(comparison.words for comparison in some)}."
        + " Too few runs to tell this from chance." * (not single and not some[0].difference.enough)
        for name, some in verdicts.items()
    ]
    if single:
        lines.append("Each run is alone: nothing says how much of a difference is chance. Train more seeds.")
    results = [result_of(record.summary) for group in groups for record in group.records]
    lacking = sum(result is None or not result.evaluated for result in results)
    if lacking:
        lines.append(f"{count(lacking, 'run')} without an evaluation, or not ended: left out of the figures.")
    tests = set()
    for record in (record for group in groups for record in group.records):
        evaluation = record.config.get("evaluation") or {}
        race = evaluation.get("race") or record.config.get("race")
        tests.add(json.dumps({**evaluation, "tracks": None, "race": race}))
    if len(tests) > 1:
        lines.append("The runs were evaluated under different conditions: their figures do not compare.")
    return lines


def groups_as_json(groups: Sequence[RunGroup], comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Return the whole comparison as JSON types; infinite seconds, of laps never completed, are null."""
    curves = curves_table(groups)
    return {
        "groups": [
            {
                "name": group.name,
                "track": course,
                "runs": [str(record.path) for record in group.on(course).records],
                "figures": {figure: _estimate_json(group.on(course).estimate(figure)) for figure in FORMS},
            }
            for group in groups
            for course in group.courses
        ],
        "differences": [
            {
                "group": comparison.group,
                "other": comparison.other,
                "track": comparison.course,
                "figure": comparison.figure,
                "difference": comparison.difference.iqm,
                "interval": comparison.difference.interval,
                "probability_of_improvement": comparison.difference.probability,
                "probability_interval": comparison.difference.probability_interval,
                "verdict": comparison.verdict,
            }
            for comparison in comparisons
        ],
        "curves": [
            {
                key: None if isinstance(value, float) and not math.isfinite(value) else value
                for key, value in row.items()
            }
            for row in curves.to_dict("records")
        ],
    }


def _estimate_json(score: Estimate | None) -> dict[str, Any] | None:
    if score is None:
        return None
    ends = None if score.interval is None else [end if math.isfinite(end) else None for end in score.interval]
    return {"iqm": score.iqm if math.isfinite(score.iqm) else None, "interval": ends, "runs": score.seeds}


CURVES = (
    "eval_lap_time_s",
    "eval_completion",
    "eval_race_score_s",
    "completion",
    "mean_return",
    "mean_lap_time_s",
)
"""Columns of metrics.jsonl whose curves are drawn and exported; seconds of an evaluated policy without a lap are
infinite."""
_PLACES = 150


def group_curve(group: RunGroup, column: str) -> pd.DataFrame:
    """Return a learning curve of a group's runs on one track.

    Between its values a run keeps the last one; before its first and after its last it has none.

    Returns:
        Columns `env_steps`, `iqm`, `low`, `high` (NaN where unknown, infinite where more than a quarter of the runs has
        no lap) and `runs`, the number of runs with a value; no row where no run has one.
    """
    curves = [_measured(record, column) for record in group.records]
    steps = np.unique(np.concatenate([own_steps for own_steps, _ in curves]))
    if not len(steps):
        return pd.DataFrame(columns=["env_steps", "iqm", "low", "high", "runs"])
    grid = steps[subsample(len(steps), _PLACES)]
    values = np.stack([_held(*points, grid) for points in curves])
    middle, low, high = iqm_band(values)
    runs = (~np.isnan(values)).sum(axis=0)
    return pd.DataFrame(
        {"env_steps": grid.astype(np.int64), "iqm": middle, "low": low, "high": high, "runs": runs}
    )


def _measured(record: RunRecord, column: str) -> tuple[Values, Values]:
    """Return the steps at which a run has a value of a column, and the values."""
    rows = pd.DataFrame(record.rows)
    if column.startswith("eval_"):
        rows = rows[rows["eval_completion"].notna()] if "eval_completion" in rows else rows.iloc[:0]
    columns = [name for name in rows if str(name).startswith(f"{column}/")] or [column]
    if not set(columns) <= set(rows):
        return np.zeros(0), np.zeros(0)
    # Not every iteration ends an episode on every track.
    values = rows[columns].astype(float)
    values = values if column.startswith("eval_") else values.ffill().rolling(3, min_periods=1).mean()
    means = values.mean(axis=1, skipna=False).to_numpy(np.float64)
    if column.startswith("eval_") and column.endswith("_s"):
        means = np.where(np.isnan(means), np.inf, means)
    there = ~np.isnan(means)
    return rows["env_steps"].to_numpy(np.float64)[there], means[there]


def _held(steps: Values, values: Values, grid: Values) -> Values:
    if not len(steps):
        return np.full(len(grid), np.nan)
    last = np.searchsorted(steps, grid, "right") - 1
    return np.where((last >= 0) & (grid <= steps[-1]), values[np.maximum(last, 0)], np.nan)


def curves_table(groups: Sequence[RunGroup]) -> pd.DataFrame:
    """Return all learning curves, a row a point: `group`, `track`, `curve` and the columns of `group_curve`."""
    tables = [
        group_curve(group.on(course), column).assign(group=group.name, track=course, curve=column)
        for group in groups
        for course in group.courses
        for column in CURVES
    ]
    return pd.concat(tables, ignore_index=True)[
        ["group", "track", "curve", "env_steps", "iqm", "low", "high", "runs"]
    ]
