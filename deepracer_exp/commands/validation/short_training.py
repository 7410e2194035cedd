"""The short training of `validate trial=60s`, and its improvement."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console

from deepracer_exp.errors import RunFailed
from deepracer_exp.runs.run_files import METRICS, read_metrics
from deepracer_exp.training.plan import TrainPlan

_FEWEST = 6
"""Fewest iterations of a short training whose thirds can be compared."""


def train_shortly(err: Console, plan: TrainPlan) -> list[str]:
    """Train, and return lines with the run and the improvement of its metrics.

    Raises:
        RunFailed: the training failed.
        KeyboardInterrupt: it was interrupted.
    """
    from deepracer_exp.reports.pages.run_page import RunReport
    from deepracer_exp.training.run import run_training

    outcome = run_training(plan, err, report=RunReport())
    if outcome.status == "failed":
        raise RunFailed(f"trial: run failed: {outcome.reason}; see {outcome.folder}")
    if outcome.status == "interrupted":
        raise KeyboardInterrupt
    rows = read_metrics(outcome.folder / METRICS)
    compared = compare_thirds(rows) or ["too short to see whether anything improves; give it more time"]
    steps = rows[-1]["env_steps"] if rows else 0
    return [f"\nTrial: {steps:,} steps -> {outcome.folder}", *(f"  {line}" for line in compared)]


def compare_thirds(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Compare the first third of iterations, rows of metrics.jsonl, with the last; return a line for each metric.

    A metric improves if it rises by more than twice the standard error of the difference.
    """
    third = len(rows) // 3
    if len(rows) < _FEWEST:
        return []
    ended = np.diff([0, *(row["episodes"] for row in rows)])
    lines = []
    for key, name in (("completion", "per cent of the lap"), ("mean_return", "reward of an episode")):
        first, last = (
            np.array([row[key] for row in part if row[key] is not None])
            for part in (rows[:third], rows[-third:])
        )
        if len(first) < 2 or len(last) < 2:
            continue
        error = np.hypot(first.std(ddof=1) / np.sqrt(len(first)), last.std(ddof=1) / np.sqrt(len(last)))
        what = "improves" if last.mean() - first.mean() > 2 * error else "does not improve"
        lines.append(
            f"{name} {what}: {first.mean():.4g} in the first third ({ended[:third].sum():,} episodes), "
            f"{last.mean():.4g} in the last ({ended[-third:].sum():,})"
        )
    return lines
