"""Statistics of what was driven: moving averages, histograms, fits, intervals, and sums by place."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

Values = NDArray[np.float64]
MOVING = 3
"""Iterations in a moving average, as racers have used since 2020."""
RESAMPLES = 2000
CONFIDENCE = 0.95


def moving_average(values: Values, over: int = MOVING) -> Values:
    """Return the mean of each value and those before it without unknown ones; NaN where the value itself is NaN."""
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


def fit_polynomial(x: Values, y: Values, degree: int) -> Fit | None:
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


def subsample(count: int, most: int) -> NDArray[np.intp]:
    """Return the indices of at most so many of `count` rows, evenly spaced, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.intp))


def totals(place: NDArray[np.intp], values: ArrayLike | None, n: int) -> Values:
    """Return the sum of values (None: the number of rows) at each of n places; -1 is no place, NaN no value."""
    known = place >= 0
    if values is None:
        return np.bincount(place[known], minlength=n).astype(np.float64)
    numbers = np.asarray(values, np.float64)
    known &= np.isfinite(numbers)
    return np.bincount(place[known], numbers[known], minlength=n).astype(np.float64)


def means(place: NDArray[np.intp], values: ArrayLike, n: int, least: int = 1) -> Values:
    """Return the mean of values at each of n places; NaN where fewer than `least` are known."""
    values = np.asarray(values, np.float64)
    known = totals(np.where(np.isfinite(values), place, -1), None, n)
    return totals(place, values, n) / np.where(known >= least, known, np.nan)


def quantiles(place: NDArray[np.intp], values: ArrayLike, n: int, shares: tuple[float, ...]) -> Values:
    """Return quantiles (len(shares), n) of the values at each of n places, between two values the lower one."""
    numbers = np.asarray(values, np.float64)
    known = (place >= 0) & np.isfinite(numbers)
    place, numbers = place[known], numbers[known]
    order = np.argsort(numbers)
    # Stable, so that the values of each place stay in order.
    numbers = numbers[order][
        np.argsort(place[order].astype(np.int16 if n < 2**15 else np.int32), kind="stable")
    ]
    count = np.bincount(place, minlength=n)
    first = np.r_[0, np.cumsum(count)[:-1]]
    if not len(numbers):
        return np.full((len(shares), n), np.nan)
    found = [
        numbers[np.minimum(first + ((count - 1) * share).astype(int), len(numbers) - 1)] for share in shares
    ]
    return np.where(count > 0, np.stack(found), np.nan)


def wilson(hits: ArrayLike, tries: ArrayLike, z: float = 1.959964) -> tuple[Values, Values]:
    """Return the ends of the Wilson score interval of hits / tries (by default 95 per cent); NaN where never tried.

    Source: E. B. Wilson, Probable inference, the law of succession, and statistical inference (1927).
    """
    tries = np.where(np.asarray(tries) > 0, tries, np.nan)
    share = np.asarray(hits) / tries
    middle = share + z**2 / (2 * tries)
    reach = z * np.sqrt(share * (1 - share) / tries + z**2 / (4 * tries**2))
    scale = 1 + z**2 / tries
    return np.maximum((middle - reach) / scale, 0.0), np.minimum((middle + reach) / scale, 1.0)
