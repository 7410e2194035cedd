"""Which iterations to submit, and how likely their laps are."""

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import norm

from deepracer_exp.deepracer.recording import Recording

from .log_view import LogView
from .statistics import wilson

LEAST_LAPS = 3
"""Complete laps of an iteration below which its 25th percentile means nothing."""
DENSE = 0.5
"""Share of complete laps an iteration must have, of the highest share that any iteration has."""
MOST = 3


def candidates_of(view: LogView) -> pd.DataFrame:
    """Return the candidates of a log; none of our own runs, which keep few checkpoints and have evaluated them."""
    return candidates(view.iterations if view.recording.best is None else view.iterations.iloc[:0])


def candidates(iterations: pd.DataFrame) -> pd.DataFrame:
    """Return the iterations whose policy is worth submitting, the best first, at most `MOST`.

    Fast and dense (after TheRayG/deepracer-log-analysis): at least `LEAST_LAPS` complete laps and `DENSE` of the
    highest share of complete laps; among those the ones with the lowest 25th percentile of the lap time.

    Args:
        iterations: `LogView.iterations`.
    """
    enough = iterations["lap_time_p25_s"].notna() & (iterations["complete"] >= LEAST_LAPS)
    dense = iterations["lap_share"] >= DENSE * iterations.loc[enough, "lap_share"].max()
    return iterations[enough & dense].sort_values("lap_time_p25_s", kind="stable").head(MOST)


def evaluated_candidates(recording: Recording) -> pd.DataFrame:
    """Return the iterations after which the service's evaluation completed every lap it tried, the fastest first.

    Returns:
        By iteration: `laps` and `lap_time_s`, their mean.
    """
    rows = recording.metrics
    rows = rows[(rows["phase"] == "evaluation") & (rows["stream"] == "training")]
    groups = rows.groupby("iteration")
    found = pd.DataFrame({"laps": groups.size(), "lap_time_s": groups["time_s"].mean()})
    return found[groups["completion"].min() >= 100.0].sort_values("lap_time_s", kind="stable")


@dataclass(frozen=True, kw_only=True)
class LapChance:
    """The chance that a complete lap takes no longer than a target."""

    target_s: float
    laps: int
    faster: int
    """Laps not above the target."""
    low: float
    """Of the 95 per cent interval of the measured share (Wilson 1927)."""
    high: float
    mean_s: float
    sd_s: float
    """Standard deviation; NaN of fewer than two laps."""
    normal: float
    """Chance by the normal distribution with this mean and deviation; NaN where there is none."""

    @property
    def share(self) -> float:
        """Measured share of laps not above the target."""
        return self.faster / self.laps


def lap_chance(lap_times_s: NDArray[np.float64], target_s: float) -> LapChance | None:
    """Return the chance that a complete lap takes no longer than a target, None without a lap.

    Args:
        lap_times_s: of complete laps; NaN of others is left out.
        target_s: lap time wanted.
    """
    laps = lap_times_s[np.isfinite(lap_times_s)]
    if not len(laps):
        return None
    faster = int((laps <= target_s).sum())
    low, high = map(float, wilson(faster, len(laps)))
    sd_s = float(laps.std(ddof=1)) if len(laps) > 1 else math.nan
    return LapChance(
        target_s=target_s,
        laps=len(laps),
        faster=faster,
        low=low,
        high=high,
        mean_s=float(laps.mean()),
        sd_s=sd_s,
        normal=float(norm.cdf(target_s, laps.mean(), sd_s)) if sd_s > 0 else math.nan,
    )
