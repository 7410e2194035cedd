"""The scores of groups of runs and their differences, as tables, sentences and JSON."""

import json
import math
from collections.abc import Sequence
from typing import Any

from deepracer_exp.errors import count
from deepracer_exp.runs.result import result_of

from .evidence import Estimate, Interval
from .group_curves import curves_table
from .groups import COMPARED, FORMS, Comparison, RunGroup, courses_of
from .log_tables import NONE, Table


def scored(groups: Sequence[RunGroup]) -> Table:
    """Return what each group scored: interquartile means over its runs, with their intervals, on each track."""
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
    return middle if estimate.interval is None else f"{middle} ({_ends(form, estimate.interval)})"


def _ends(form: str, interval: Interval) -> str:
    return " to ".join(form.format(end) if math.isfinite(end) else "no lap" for end in interval)


def differences_table(comparisons: Sequence[Comparison]) -> Table:
    """Return comparisons as texts."""
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
        rows.append((comparison.group, *track, name, comparison.verdict, change, better))
    heads = ("group", *["track"] * several, "figure", "verdict", "difference", "probability of improvement")
    return Table(heads, tuple(rows), 3 + several)


def sentences(groups: Sequence[RunGroup], comparisons: Sequence[Comparison]) -> list[str]:
    """Return what the tables say, in sentences: the verdict on the lap first."""
    alone = len(courses_of(groups)) == 1
    lines = [
        f"{comparison.group} against {comparison.other}, lap of the evaluated policy: {comparison.verdict}."
        for comparison in comparisons
        if comparison.figure == COMPARED[0] and (comparison.course is None or alone)
    ]
    results = [result_of(record.summary) for group in groups for record in group.records]
    lacking = sum(result is None or not result.evaluated for result in results)
    if lacking:
        lines.append(f"{count(lacking, 'run')} without an evaluation, or not ended: left out of the figures.")
    tests = {
        json.dumps({**(record.config.get("evaluation") or {}), "tracks": None})
        for group in groups
        for record in group.records
    }
    if len(tests) > 1:
        lines.append("The runs were evaluated under different conditions: their figures do not compare.")
    return lines


def groups_as_json(groups: Sequence[RunGroup], comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Return everything that is compared, JSON types; infinite seconds, of laps never completed, are null."""
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
