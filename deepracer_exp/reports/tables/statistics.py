"""Statistics of driving: histograms, intervals, and sums by place."""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.jit import njit

Values = NDArray[np.float64]
MOST_ROWS = 100_000
"""Rows beyond which quantiles and bin widths are computed from an evenly spaced part of them."""


def moving_average(values: Values) -> Values:
    """Return the trailing moving average over three values, ignoring NaN; NaN where the value itself is NaN."""
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
    bins = int(np.ceil((high - low) / width + 1e-6))
    # With bins of one width, NumPy computes the bin of a value instead of searching it.
    counts, edges = np.histogram(values, bins=bins, range=(low, low + width * bins))
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


def totals(place: ArrayLike, values: ArrayLike | None, n: int) -> Values:
    """Return the sum of values (None: the number of rows) at each of n places; -1 is no place, NaN no value."""
    if values is None:
        place = np.asarray(place)
        return np.bincount(place[place >= 0], minlength=n).astype(np.float64)
    return _counts_and_sums(_flat(place, np.int64), _flat(values, np.float64), n)[1]


def means(place: ArrayLike, values: ArrayLike, n: int, least: int = 1) -> Values:
    """Return the mean of values at each of n places; NaN where fewer than `least` are known."""
    counts, sums = _counts_and_sums(_flat(place, np.int64), _flat(values, np.float64), n)
    return sums / np.where(counts >= least, counts, np.nan)


def _flat(values: ArrayLike, kind: type) -> NDArray:
    # One type and layout, so that one compiled function serves all.
    return np.ascontiguousarray(values, kind)


@njit(cache=True, nogil=True)
def _counts_and_sums(place, values, n):  # type: ignore[no-untyped-def]
    """Return the number and the sum of the finite values at each of n places."""
    counts, sums = np.zeros(n), np.zeros(n)
    for i in range(len(place)):
        if place[i] >= 0 and math.isfinite(values[i]):
            counts[place[i]] += 1.0
            sums[place[i]] += values[i]
    return counts, sums


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


def quantiles(place: ArrayLike, values: ArrayLike, n: int, shares: tuple[float, ...]) -> Values:
    """Return quantiles (len(shares), n) of the values at each of n places; NaN where none is known.

    Between two values they are interpolated linearly; -1 is no place.
    """
    result: Values = _quantiles(_flat(place, np.int64), _flat(values, np.float64), n, np.array(shares))
    return result


@njit(cache=True, nogil=True)
def _quantiles(place, values, n, shares):  # type: ignore[no-untyped-def]
    end = np.zeros(n + 1, np.int64)
    for i in range(len(place)):
        if place[i] >= 0 and not math.isnan(values[i]):
            end[place[i] + 1] += 1
    end = np.cumsum(end)
    free, grouped = end[:-1].copy(), np.empty(end[-1])
    for i in range(len(place)):
        if place[i] >= 0 and not math.isnan(values[i]):
            grouped[free[place[i]]] = values[i]
            free[place[i]] += 1
    result = np.full((len(shares), n), np.nan)
    for k in range(n):
        here = np.sort(grouped[end[k] : end[k + 1]])
        for number in range(len(shares) if len(here) else 0):
            rank = shares[number] * (len(here) - 1)
            low = int(rank)
            result[number, k] = here[low]
            if low + 1 < len(here):
                result[number, k] += (here[low + 1] - here[low]) * (rank - low)
    return result


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


def chance_of_rise(values: Values) -> float:
    """Return the p-value of a rising trend in the order of the values: Kendall's tau, one-sided.

    NaN values are left out; the p-value is NaN unless two values differ. It is exact without ties, and a normal
    approximation with ties (M. G. Kendall, Rank Correlation Methods, 1970). SciPy has this test, too, but takes a
    second to import.
    """
    measured = values[~np.isnan(values)]
    n, equal = len(measured), np.unique(measured, return_counts=True)[1]
    later, earlier = np.tril_indices(n, -1)
    rising, falling = (
        int((measured[later] > measured[earlier]).sum()),
        int((measured[later] < measured[earlier]).sum()),
    )
    if len(equal) < 2:
        return float("nan")
    if len(equal) < n:
        variance = (n * (n - 1) * (2 * n + 5) - (equal * (equal - 1) * (2 * equal + 5)).sum()) / 18
        return NormalDist().cdf((falling - rising) / variance**0.5)
    orders = np.ones(1)
    for more in range(2, n + 1):  # how many orders of so many values have 0, 1, 2, ... pairs that fall
        orders = np.convolve(orders, np.ones(more))
    return float(orders[: falling + 1].sum() / orders.sum())
