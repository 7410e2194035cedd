"""Statistics of what was driven: histograms, intervals, and sums by place."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import ArrayLike, NDArray

Values = NDArray[np.float64]
MOST_ROWS = 100_000
"""Rows beyond which quantiles and the width of bins are those of an evenly spaced part of them."""
CONFIDENCE = 0.95


def moving_average(values: Values) -> Values:
    """Return for each value the mean of the known ones among the last three; NaN where the value itself is NaN."""
    series = pd.Series(values, dtype=np.float64)
    return series.rolling(3, min_periods=1).mean().where(series.notna()).to_numpy()


@dataclass(frozen=True, eq=False)
class Histogram:
    """Counts of values in bins of one width."""

    centers: Values
    counts: Values
    width: float


def histogram(values: Values, least: int = 8) -> Histogram:
    """Count values; their number and spread decide on the bins (Freedman and Diaconis, 1981)."""
    low, high = float(values.min()), float(values.max())
    if high - low <= 1e-6 * max(abs(high), abs(low)):
        return Histogram(np.array([low]), np.array([float(len(values))]), max(0.05 * abs(low), 1e-6))
    part = values[subsample(len(values), MOST_ROWS)]
    spread = float(np.subtract(*np.percentile(part, [75, 25])))
    width = float(np.clip(2 * spread / len(values) ** (1 / 3), (high - low) / 50, (high - low) / least))
    grain = _grain(part)
    if grain > 0:
        # Bins with different numbers of possible values would look like a comb.
        width = grain * max(1, round(width / grain))
        low -= grain / 2
    edges = low + width * np.arange(int(np.ceil((high - low) / width + 1e-6)) + 1)
    counts, _ = np.histogram(values, bins=edges)
    return Histogram((edges[1:] + edges[:-1]) / 2, counts.astype(np.float64), width)


def _grain(values: Values) -> float:
    """Return the spacing of which all values are multiples, up to a constant; 0 where there is none."""
    apart = np.diff(np.unique(values.round(6)))
    if len(apart) == 0 or len(apart) > len(values) / 4:
        return 0.0
    grain = float(apart.min())
    return grain if np.abs(apart / grain - (apart / grain).round()).max() < 0.01 else 0.0


def subsample(count: int, most: int) -> NDArray[np.intp]:
    """Return the indices of at most `most` of `count` rows, evenly spaced, with the first and the last."""
    if count <= most:
        return np.arange(count)
    return np.linspace(0, count - 1, most).round().astype(np.intp)


def totals(place: NDArray[np.intp], values: ArrayLike | None, n: int) -> Values:
    """Return the sum of values (None: the number of rows) at each of n places; -1 is no place, NaN no value."""
    placed = place >= 0
    if values is None:
        return np.bincount(place[placed], minlength=n).astype(np.float64)
    numbers = np.asarray(values, np.float64)
    placed &= np.isfinite(numbers)
    return np.bincount(place[placed], numbers[placed], minlength=n).astype(np.float64)


def means(place: NDArray[np.intp], values: ArrayLike, n: int, least: int = 1) -> Values:
    """Return the mean of values at each of n places; NaN where fewer than `least` are known."""
    values = np.asarray(values, np.float64)
    counts = totals(np.where(np.isfinite(values), place, -1), None, n)
    return totals(place, values, n) / np.where(counts >= least, counts, np.nan)


@njit(cache=True, nogil=True)
def lowest_and_highest(place, values, n):  # type: ignore[no-untyped-def]
    """Return the lowest and the highest of the values at each of n places; NaN where none is known."""
    low, high = np.full(n, np.nan), np.full(n, np.nan)
    for i in range(len(place)):
        k, value = place[i], values[i]
        if k >= 0 and value == value:  # NaN is no value
            if not low[k] <= value:
                low[k] = value
            if not high[k] >= value:
                high[k] = value
    return low, high


def quantiles(place: NDArray[np.intp], values: ArrayLike, n: int, shares: tuple[float, ...]) -> Values:
    """Return quantiles (len(shares), n) of the values at each of n places; NaN where none is known."""
    if not len(place):
        return np.full((len(shares), n), np.nan)
    groups = pd.Series(np.asarray(values, np.float64)).groupby(place)
    return groups.quantile(list(shares)).unstack().reindex(range(n)).to_numpy().T


def wilson(hits: ArrayLike, tries: ArrayLike) -> tuple[Values, Values]:
    """Return the ends of the Wilson score interval of hits / tries (95 per cent); NaN where never tried.

    Source: E. B. Wilson, Probable inference, the law of succession, and statistical inference (1927).
    """
    z = 1.959964
    tries = np.where(np.asarray(tries) > 0, tries, np.nan)
    share = np.asarray(hits) / tries
    middle = share + z**2 / (2 * tries)
    reach = z * np.sqrt(share * (1 - share) / tries + z**2 / (4 * tries**2))
    scale = 1 + z**2 / tries
    return np.maximum((middle - reach) / scale, 0.0), np.minimum((middle + reach) / scale, 1.0)
