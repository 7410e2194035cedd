"""Whether a training has stopped growing, and whether it holds away from itself."""

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .statistics import moving_average

Values = NDArray[np.float64]
PATIENCE = 10
"""Iterations without growth that are the least proof."""
PATIENCE_SHARE = 0.2
"""Share of all iterations that must be without growth."""
COMPLETION_GAIN = 2.0
"""Points of completion that count as growth."""
COMPLETION_NEAR = 5.0
"""How far below its best completion may end, in points."""
REWARD_GAIN = 0.05
"""Growth of the reward that counts, as a share of its range."""
LAPS_GAIN = 0.05
"""Growth of the share of complete laps that counts."""
ENTROPY_CHANGE = 0.1
"""Change of the entropy that is flat: share of ln(actions), or of the scatter of a continuous policy."""
POOR = 50.0
"""Completion below which a training that no longer grows has not learned to drive, per cent."""
EVALUATION_DROP = 10.0
"""Fall of the evaluation from its best that counts, in points of completion."""


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """Since when nothing has grown."""

    iteration: int | None
    """None: not converged."""
    completion: float
    """Moving average at the end, per cent."""
    completion_before: float
    """Highest one before the last `patience` iterations."""
    completion_best: float
    entropy_change: float
    """Over the last `patience` iterations; NaN where not told."""
    patience: int
    iterations: int
    entropy_flat: bool


def convergence(iterations: pd.DataFrame, action_count: int | None) -> Convergence | None:
    """Find the iteration from which on a training no longer grew, None where it is too short to tell.

    All series are moving averages of three iterations. Converged since the earliest iteration k, at least `patience`
    before the end, after which completion, reward and the share of complete laps stay within what counts as growth
    of their best up to k; completion ends near its best; entropy, where told, is flat over the last `patience`.

    Args:
        iterations: `LogView.iterations`.
        action_count: of a discrete policy, None of a continuous one.
    """
    table = iterations[iterations["episodes"] > 0]
    count = len(table)
    patience = max(PATIENCE, math.ceil(PATIENCE_SHARE * count))
    if count <= patience:
        return None
    grown = ("completion_mean", "reward_mean", "lap_share")
    series = {name: moving_average(table[name].to_numpy(np.float64)) for name in grown}
    completion = series["completion_mean"]
    gains = {
        "completion_mean": COMPLETION_GAIN,
        "reward_mean": REWARD_GAIN * float(np.ptp(series["reward_mean"])),
        "lap_share": LAPS_GAIN,
    }
    still = np.ones(count, bool)
    for name, gain in gains.items():
        best = np.maximum.accumulate(series[name])
        still &= best[-1] <= best + gain
    change = _entropy_change(table["entropy"].to_numpy(np.float64), action_count, patience)
    flat = not change > ENTROPY_CHANGE
    since = int(still.argmax())
    near = completion[-1] >= completion.max() - COMPLETION_NEAR
    converged = flat and near and since <= count - 1 - patience
    return Convergence(
        iteration=int(table["iteration"].iloc[since]) if converged else None,
        completion=float(completion[-1]),
        completion_before=float(completion[:-patience].max()),
        completion_best=float(completion.max()),
        entropy_change=change,
        patience=patience,
        iterations=count,
        entropy_flat=flat,
    )


def _entropy_change(entropy: Values, action_count: int | None, patience: int) -> float:
    known = moving_average(entropy)
    known = known[np.isfinite(known)]
    if len(known) <= patience:
        return math.nan
    # Of a continuous policy exp((a - b) / 2) is the ratio of two scatters, for two normal distributions.
    scale = 2.0 if action_count is None else math.log(max(action_count, 2))
    return float(np.ptp(known[-patience:])) / scale


@dataclass(frozen=True, kw_only=True)
class Overfitting:
    """How training and evaluation went since the evaluation's best."""

    overfits: bool
    evaluated: str
    """`held-out evaluation` or `evaluation`."""
    best: float
    """Completion, per cent, mean of three evaluations."""
    best_iteration: int
    now: float
    training_best: float
    training_now: float


def overfitting(iterations: pd.DataFrame) -> Overfitting | None:
    """Tell whether completion in training holds while that of the evaluations falls; None with fewer than six.

    Evaluations on held-out conditions count before others. All series are moving averages of three.
    """
    for column, name in (("held_out_completion", "held-out evaluation"), ("eval_completion", "evaluation")):
        told = iterations[iterations[column].notna() & iterations["completion_mean"].notna()]
        if len(told) < 6:
            continue
        evaluated = moving_average(told[column].to_numpy(np.float64))
        training = moving_average(told["completion_mean"].to_numpy(np.float64))
        best = 2 + int(evaluated[2:].argmax())  # the first two are of fewer than three
        holds = training[-1] >= training[2:].max() - COMPLETION_NEAR
        return Overfitting(
            overfits=bool(holds and evaluated[-1] <= evaluated[best] - EVALUATION_DROP),
            evaluated=name,
            best=float(evaluated[best]),
            best_iteration=int(told["iteration"].iloc[best]),
            now=float(evaluated[-1]),
            training_best=float(training[2:].max()),
            training_now=float(training[-1]),
        )
    return None
