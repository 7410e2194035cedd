"""Metric points of an iteration, and of a moment."""

import math
import time
from collections.abc import Mapping

from .names import metric_names

Point = tuple[str, float, int, int]
"""Key, value, time in ms, step."""

_STEP = "env_steps"
_CLOCK = "wall_clock_s"


def now_ms() -> int:
    """Return the time in ms since 1970."""
    return time.time_ns() // 1_000_000


def points_of(row: Mapping[str, float | None], step: int, start_ms: int) -> tuple[Point, ...]:
    """Return the points of a row of metrics.jsonl; None, NaN and infinite values are left out.

    A point's time is the run's start plus the row's `wall_clock_s`: a row told again, by whichever process, is the
    same point, and MLflow keeps equal points once. A row without that clock gets the time of now.

    Args:
        row: `env_steps` in it is the step and no point.
        step: env steps.
        start_ms: the run's start.
    """
    clock_s = row.get(_CLOCK)
    time_ms = now_ms() if clock_s is None else start_ms + round(1000 * clock_s)
    return points_at(metric_names({key: value for key, value in row.items() if key != _STEP}), step, time_ms)


def points_at(metrics: Mapping[str, float | None], step: int, time_ms: int) -> tuple[Point, ...]:
    """Return the points of metrics under their names in MLflow; None, NaN and infinite values are left out.

    Args:
        metrics: by name.
        step: whatever they are counted by.
        time_ms: since 1970.
    """
    return tuple(
        (key, float(value), time_ms, step)
        for key, value in metrics.items()
        if value is not None and math.isfinite(value)
    )
