"""The picture of all trials' learning: the entropy of their policies, coloured by how they ended."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import plotly.graph_objects as go
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.errors import BadInput
from deepracer_exp.formats.run_files import read_metrics

from .best import best_trial
from .fates import FATES, fate_of, words
from .figures import by_fate, styled, thinned

_MOST_POINTS = 15_000  # of all curves together: 0.3 MB of the page
_FEWEST_POINTS = 12  # of a curve


def entropy_curves(study: optuna.Study, trials: Sequence[FrozenTrial]) -> go.Figure | None:
    """Draw the entropy of every trial's policy while it learned, coloured by how the trial ended."""
    rows = {trial.number: runs for trial in trials if (runs := _rows(study, trial))}
    if not rows:
        return None
    every = [row for runs in rows.values() for run in runs for row in run]
    column = "entropy_share" if any(row.get("entropy_share") is not None for row in every) else "entropy"
    most = max(_FEWEST_POINTS, _MOST_POINTS // sum(map(len, rows.values())))
    best = best_trial(study).number if any(trial.state == TrialState.COMPLETE for trial in trials) else None
    figure = go.Figure()
    known = [trial for trial in trials if trial.number in rows]
    for fate, some in by_fate(known).items():
        look = FATES[fate]
        line = {"color": look.color, "dash": look.dash, "width": 1.3}
        _add_curves(figure, some, rows, column, most, {"name": words(fate), "line": line, "opacity": 0.75})
    for trial in known:
        if trial.number == best:
            line = {"color": FATES[fate_of(trial)].color, "width": 4.5}
            _add_curves(figure, [trial], rows, column, most, {"name": f"best: trial {best}", "line": line})
    styled(figure, "Entropy of the policies, by how their trials ended", 460)
    figure.update_xaxes(title_text="control steps", rangemode="tozero")
    share = column == "entropy_share"
    figure.update_yaxes(title_text="entropy, share of a choice by chance" if share else "entropy, nats")
    if share:
        figure.update_yaxes(tickformat=".0%")
    return figure


def _add_curves(
    figure: go.Figure,
    trials: Sequence[FrozenTrial],
    rows: Mapping[int, list[list[dict[str, Any]]]],
    column: str,
    most: int,
    look: Mapping[str, Any],
) -> None:
    """Add the curves of trials as one trace, with gaps between them: hundreds of traces would be slow."""
    x: list[int | None] = []
    y: list[float | None] = []
    whose: list[int] = []
    for trial in trials:
        for run in rows[trial.number]:
            told = [row for row in run if row.get(column) is not None and math.isfinite(row[column])]
            some = thinned(told, most)
            x += [*(int(row["env_steps"]) for row in some), None]
            y += [*(round(row[column], 4) for row in some), None]
            whose += [trial.number] * (len(some) + 1)
    hover = "<b>Trial %{customdata}</b><br>%{x:.3s} steps: %{y:.3f}<extra></extra>"
    figure.add_trace(go.Scatter(x=x, y=y, mode="lines", customdata=whose, hovertemplate=hover, **look))


def _rows(study: optuna.Study, trial: FrozenTrial) -> list[list[dict[str, Any]]]:
    """Return the rows of a trial's runs; a run whose files are gone or torn is left out."""
    told = [run.get("run_dir") for run in trial.user_attrs.get("runs") or ()] or [
        trial.user_attrs.get("run_dir")
    ]
    base = Path(study.user_attrs.get("runs_dir", "runs")) / study.study_name
    found = []
    for folder in dict.fromkeys(Path(name) for name in told if name):
        place = next((one for one in (base / folder.name, folder) if (one / "metrics.jsonl").is_file()), None)
        try:
            rows = [] if place is None else read_metrics(place / "metrics.jsonl")
        except BadInput:
            continue
        if rows := [row for row in rows if isinstance(row.get("env_steps"), int)]:
            found.append(rows)
    return found
