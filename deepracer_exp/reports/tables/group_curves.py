"""Learning curves of groups of runs: interquartile means over seeds, with their intervals."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from deepracer_exp.runs.run_files import RunRecord

from .evidence import iqm_band
from .groups import RunGroup
from .statistics import Values, subsample

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
