"""Numbers that several charts need: moving averages, histograms, fits, intervals."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .chart import Values

MOVING = 3
"""Iterations in a moving average, as racers have used since 2020."""
RESAMPLES = 2000
CONFIDENCE = 0.95


def moving_average(values: Values, over: int = MOVING) -> Values:
    """Return the mean of each value and those before it, leaving unknown ones out; NaN where the value itself is."""
    series = pd.Series(values, dtype=np.float64)
    return series.rolling(over, min_periods=1).mean().where(series.notna()).to_numpy()


@dataclass(frozen=True, eq=False)
class Histogram:
    """Counts of values in bins of one width."""

    centers: Values
    counts: Values
    width: float


def histogram(values: Values, least: int = 8, most: int = 50) -> Histogram:
    """Count values; their number and spread decide on the bins (Freedman and Diaconis, 1981)."""
    low, high = float(values.min()), float(values.max())
    if high - low <= 1e-6 * max(abs(high), abs(low)):
        return Histogram(np.array([low]), np.array([float(len(values))]), max(0.05 * abs(low), 1e-6))
    spread = float(np.subtract(*np.percentile(values, [75, 25])))
    width = 2 * spread / len(values) ** (1 / 3)
    width = float(np.clip(width, (high - low) / most, (high - low) / least))
    grain = _grain(values)
    if grain > 0:
        # Bins with different numbers of possible values would look like a comb.
        width = grain * max(1, round(width / grain))
        low -= grain / 2
    edges = low + width * np.arange(int(np.ceil((high - low) / width + 1e-6)) + 1)
    counts, _ = np.histogram(values, bins=edges)
    return Histogram((edges[1:] + edges[:-1]) / 2, counts.astype(np.float64), width)


def _grain(values: Values) -> float:
    """Return of what all values are multiples, up to a constant; 0 where there is nothing like that."""
    apart = np.diff(np.unique(values.round(6)))
    if len(apart) == 0 or len(apart) > len(values) / 4:
        return 0.0
    grain = float(apart.min())
    return grain if np.abs(apart / grain - (apart / grain).round()).max() < 0.01 else 0.0


@dataclass(frozen=True)
class Fit:
    """A curve through points, by least squares."""

    coefficients: tuple[float, ...]
    """Of the highest power first."""
    r_squared: float
    """Share of the variance of y that it explains."""

    def at(self, x: Values) -> Values:
        """Return the curve."""
        return np.polyval(np.array(self.coefficients), x)


def fit(x: Values, y: Values, degree: int) -> Fit | None:
    """Fit a polynomial, None where the points do not decide on one."""
    if len(np.unique(x)) <= degree + 1 or np.ptp(y) == 0:
        return None
    middle, scale = float(x.mean()), float(x.std())
    polynomial = np.polynomial.Polynomial.fit(x, y, degree, domain=[middle - scale, middle + scale])
    residual = y - polynomial(x)
    found = polynomial.convert().coef[::-1]
    padded = np.concatenate([np.zeros(degree + 1 - len(found)), found])
    return Fit(tuple(float(c) for c in padded), 1 - float(residual.var() / y.var()))


def correlation(x: Values, y: Values) -> float:
    """Return Pearson's r, NaN where one of them does not vary."""
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan")
    return float(np.corrcoef(x, y)[0, 1])


def median_band(curves: Values) -> tuple[Values, Values, Values]:
    """Return the median of curves and its bootstrap interval (95 per cent, percentile method, Efron 1979).

    Args:
        curves: one a row, (n, m); NaN where a curve has no value. With a single known value the interval is NaN, and
            where less than half of the curves have one so is the median.

    Returns:
        median, low and high, each (m,).
    """
    known = np.isfinite(curves)
    enough = known.sum(axis=0) >= max(1.0, len(curves) / 2)
    median, low, high = (np.full(curves.shape[1], np.nan) for _ in range(3))
    dice = np.random.default_rng(0)
    groups: dict[bytes, list[int]] = {}
    for column in np.flatnonzero(enough):
        groups.setdefault(known[:, column].tobytes(), []).append(int(column))
    for pattern, columns in groups.items():
        rows = np.flatnonzero(np.frombuffer(pattern, dtype=bool))
        values = curves[rows][:, columns]
        median[columns] = np.median(values, axis=0)
        if len(rows) > 1:
            drawn = dice.integers(len(rows), size=(RESAMPLES, len(rows)))
            # A few columns at a time: all of them may be hundreds of MB.
            for first in range(0, len(columns), 50):
                part = columns[first : first + 50]
                medians = np.median(values[:, first : first + 50][drawn], axis=1)
                tail = 50 * (1 - CONFIDENCE)
                low[part], high[part] = np.percentile(medians, [tail, 100 - tail], axis=0)
    return median, low, high


def percentiles_by(group: NDArray[np.int64], values: Values, at: tuple[float, ...]) -> pd.DataFrame:
    """Return percentiles of the values of each group, indexed by it, one column each."""
    groups = pd.Series(values).groupby(group)
    return pd.DataFrame({p: groups.quantile(p / 100) for p in at})
