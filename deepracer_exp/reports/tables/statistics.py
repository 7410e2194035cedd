"""Statistics of driving: histograms, intervals, and sums by place."""

import math
from dataclasses import dataclass

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


def count_rows(place: ArrayLike, n: int) -> Values:
    """Return the number of rows at each of n places; -1 is no place."""
    place = np.asarray(place)
    return np.bincount(place[place >= 0], minlength=n).astype(np.float64)


def means(place: ArrayLike, values: ArrayLike, n: int, least: int = 1) -> Values:
    """Return the mean of the finite values at each of n places; NaN where there are fewer than `least`.

    -1 is no place.
    """
    place, values = np.asarray(place), np.asarray(values)
    counted = (place >= 0) & np.isfinite(values)
    counts = np.bincount(place[counted], minlength=n)
    sums = np.bincount(place[counted], values[counted], minlength=n)
    return sums / np.where(counts >= least, counts, np.nan)


def lowest_and_highest(place: NDArray[np.int64], values: ArrayLike, n: int) -> tuple[Values, Values]:
    """Return the lowest and the highest of the values at each of n places; -1 is no place, NaN where none is known."""
    place, values = place[place >= 0], np.asarray(values)[place >= 0]
    low, high = np.full((2, n), np.nan)
    np.fmin.at(low, place, values)
    np.fmax.at(high, place, values)
    return low, high


def quantiles(place: ArrayLike, values: ArrayLike, n: int, shares: tuple[float, ...]) -> Values:
    """Return quantiles (len(shares), n) of the values at each of n places; NaN where none is known.

    Between two values they are interpolated linearly; -1 is no place.
    """
    # One type and layout, so that one compiled function serves all.
    place, values = np.ascontiguousarray(place, np.int64), np.ascontiguousarray(values, np.float64)
    result: Values = _quantiles(place, values, n, np.array(shares))
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

    NaN values are left out; the p-value is NaN unless two values differ.
    """
    from scipy.stats import kendalltau  # takes a second to import

    measured = values[~np.isnan(values)]
    if len(np.unique(measured)) < 2:
        return float("nan")
    return float(kendalltau(np.arange(len(measured)), measured, alternative="greater").pvalue)
