"""Test whether the laps of a training became slower, and whether its return rose meanwhile."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from deepracer_exp.runs.run_result import RELIABLE

from .statistics import Values, chance_of_rise

LEAST_TIMES = 8
"""Fewest lap times for a test."""
_MOST_BLOCKS = 12
"""More lap times are averaged to so many, because those of neighbouring iterations are not independent."""
_AVERAGED = 3
SLOWER = 0.02
"""Share by which the last laps must be slower than the fastest of the training."""
CHANCE = 0.02
"""Significance level: the chance of a false alarm for lap times that only scatter."""
_RETURN_CHANCE = 0.05
SERIES = {"eval_lap_time_s": "evaluated laps", "lap_time_mean_s": "exploring laps"}
"""Columns of lap times, the most important first, with their names."""


@dataclass(frozen=True, kw_only=True)
class SlowerLaps:
    """A slowdown of laps."""

    laps: str
    """A value of SERIES."""
    since: int
    """The iteration around which they were fastest."""
    fastest_s: float
    """Mean of the three lap times in a row around that iteration, s."""
    now_s: float
    """Mean of the last three lap times, s."""
    return_then: float
    """Mean return in the iterations of `fastest_s`."""
    return_now: float
    """Mean return in the iterations of `now_s`."""
    return_rose: bool

    def __str__(self) -> str:
        """Describe the slowdown in one or two sentences."""
        what = (
            f"The {self.laps} became slower from iteration {self.since} on, from {self.fastest_s:.2f} to "
            f"{self.now_s:.2f} s, while the return"
        )
        if not self.return_rose:
            return f"{what} did not rise ({self.return_then:.4g}, then {self.return_now:.4g})."
        return (
            f"{what} rose from {self.return_then:.4g} to {self.return_now:.4g}: the reward function rewards it. "
            "`deepracer-exp validate` shows what slow and fast laps return."
        )


def slower_laps(iterations: pd.DataFrame) -> SlowerLaps | None:
    """Test whether laps became slower since they were fastest; None: no, or there are too few to say.

    Kendall's tau (one-sided) tests the lap times since the fastest three in a row for a rising trend. That start was
    chosen among all, so the significance level is divided by their number (Bonferroni). The return rose if its values
    in the same iterations pass the same test.

    Args:
        iterations: a row each, with `iteration`, `reward_mean`, `eval_lap_share` and the columns SERIES; the first of
            them with `LEAST_TIMES` lap times counts. Evaluations with fewer complete laps than `RELIABLE` do not.
    """
    for column, name in SERIES.items():
        measured = iterations[column].notna()
        if column.startswith("eval_"):  # the few laps that an unreliable policy completes may be fast ones
            measured &= iterations["eval_lap_share"] >= RELIABLE
        if measured.sum() >= LEAST_TIMES:
            # The return of an evaluated policy is that of the iterations since the evaluation before.
            block = measured.cumsum() - measured
            returns = iterations["reward_mean"].groupby(block).mean().to_numpy()[: measured.sum()]
            rows = iterations[measured]
            return _tested(
                name,
                rows["iteration"].to_numpy(np.int64),
                rows[column].to_numpy(np.float64),
                returns.astype(np.float64),
            )
    return None


def _tested(name: str, iteration: np.ndarray, laps_s: Values, returns: Values) -> SlowerLaps | None:
    parts = np.array_split(np.arange(len(laps_s)), min(len(laps_s), _MOST_BLOCKS))
    times_s, rewards = (
        np.array([np.nanmean(values[part]) for part in parts]) for values in (laps_s, returns)
    )
    averages_s = np.convolve(times_s, np.ones(_AVERAGED) / _AVERAGED, "valid")
    fastest = int(averages_s.argmin())
    if averages_s[-1] < (1 + SLOWER) * averages_s[fastest]:
        return None
    starts = len(averages_s) - _AVERAGED
    if not chance_of_rise(times_s[fastest:]) < CHANCE / starts:
        return None
    middle = parts[fastest + _AVERAGED // 2]
    return SlowerLaps(
        laps=name,
        since=int(iteration[middle[len(middle) // 2]]),
        fastest_s=float(averages_s[fastest]),
        now_s=float(averages_s[-1]),
        return_then=float(np.mean(rewards[fastest : fastest + _AVERAGED])),
        return_now=float(np.mean(rewards[-_AVERAGED:])),
        return_rose=chance_of_rise(rewards[fastest:]) < _RETURN_CHANCE,
    )
