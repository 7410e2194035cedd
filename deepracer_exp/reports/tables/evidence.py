"""Evidence of several seeds: interquartile means, bootstrap intervals, and whether two groups really differ.

Definitions: Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice (2021). Scores come in
strata: one array a track, one value a seed. Seeds are resampled within their track, never from one track to another.

The percentiles of an interval are moved outwards for few seeds (Hesterberg, What Teachers Should Know About the
Bootstrap, 2015, "expanded percentile interval"): those of the plain one take 5 seeds against 5 of the same distribution
for different in 6 to 12 per cent of cases, and 3 against 3 in 20.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]
CONFIDENCE = 0.95
RESAMPLES = 2000
LEAST_FOR_INTERVAL = 3
"""Seeds of a group below which it has no interval."""
SAME = "no difference that seeds do not explain"
TOO_FEW = "too few runs to tell"

Strata = Sequence[Values]
"""Scores by track, (seeds,) each; infinity stands for a missing score that is worse than any, as of a lap never
driven."""
Interval = tuple[float, float]


def interquartile_mean(scores: Values) -> Values:
    """Return the mean of the middle half of scores, (..., seeds), without a quarter of them at either end."""
    from scipy.stats import trim_mean  # takes a second to import

    return np.asarray(trim_mean(scores, 0.25, axis=-1), np.float64)


@dataclass(frozen=True)
class Estimate:
    """The interquartile mean of a group of runs."""

    iqm: float
    """Infinite where more than a quarter of the runs have no score."""
    interval: Interval | None
    """95 per cent; None with fewer than `LEAST_FOR_INTERVAL` seeds. An end may be infinite."""
    seeds: int
    """Number of scores, over all tracks."""


def estimate(strata: Strata) -> Estimate:
    """Return the interquartile mean of all scores, of which there is one at least, with its bootstrap interval."""
    cells = sorted((np.sort(cell) for cell in strata), key=tuple)
    together = np.concatenate(cells)
    interval = None
    if len(together) >= LEAST_FOR_INTERVAL and _freedom(cells) >= 1:
        rng = np.random.default_rng(0)
        drawn = np.concatenate([_resampled(cell, rng) for cell in cells], axis=1)
        interval = _interval(interquartile_mean(drawn), cells)
    return Estimate(float(interquartile_mean(together)), interval, len(together))


def iqm_band(curves: Values) -> tuple[Values, Values, Values]:
    """Return the interquartile mean of curves and its bootstrap interval (95 per cent) at each of their points.

    Args:
        curves: one a row, a seed each, (n, m); NaN where a curve has no point, infinity where a lap was not completed.

    Returns:
        mean, low and high, each (m,). The mean is NaN where less than half of the curves have a point, the interval
        where fewer than `LEAST_FOR_INTERVAL` have one; all may be infinite.
    """
    middle, low, high = np.full((3, curves.shape[1]), np.nan)
    for column, values in enumerate(curves.T):
        measured = values[~np.isnan(values)]
        if len(measured) < max(1.0, len(values) / 2):
            continue
        band = estimate([measured])
        middle[column] = band.iqm
        if band.interval is not None:
            low[column], high[column] = band.interval
    return middle, low, high


@dataclass(frozen=True)
class Difference:
    """The difference between the scores of two groups of runs."""

    iqm: float | None
    """Interquartile mean minus the other's; None where one of them is infinite."""
    interval: Interval | None
    """95 per cent; None where unknown."""
    probability: float
    """Probability of improvement: that a run of the group scores better than one of the other on the same track, ties
    counting half; the mean over tracks."""
    probability_interval: Interval | None
    enough: bool
    """Whether there are enough seeds: with fewer, even groups without overlap occur by chance in one of twenty
    cases."""

    @property
    def explained_by_seeds(self) -> bool:
        """Whether seeds alone explain the difference: an interval contains its null value."""
        if not self.enough or self.probability_interval is None:
            return True
        low, high = self.probability_interval
        same = low <= 0.5 <= high
        return same or (self.interval is not None and self.interval[0] <= 0.0 <= self.interval[1])

    def verdict(self, better: str = "better", worse: str = "worse") -> str:
        """Return in words whether the groups differ, `better` or `worse` where they do."""
        if not self.enough:
            return TOO_FEW
        if self.explained_by_seeds:
            return SAME
        return better if self.probability > 0.5 else worse

    def reversed(self) -> "Difference":
        """Return the difference of the other group from this one."""
        return Difference(
            None if self.iqm is None else -self.iqm,
            None if self.interval is None else (-self.interval[1], -self.interval[0]),
            1.0 - self.probability,
            None
            if self.probability_interval is None
            else (1.0 - self.probability_interval[1], 1.0 - self.probability_interval[0]),
            self.enough,
        )


def difference(scores: Strata, other: Strata, lower_is_better: bool) -> Difference:
    """Compare `scores` with those of the `other` group; both have the same tracks in the same order.

    Raises:
        ValueError: a track has no score.
    """
    cells = [
        (tuple(np.sort(values)), tuple(np.sort(others))) for values, others in zip(scores, other, strict=True)
    ]
    pairs, turned = sorted(cells), sorted(cell[::-1] for cell in cells)
    if turned < pairs:  # the order of the groups decides only signs
        return difference(other, scores, lower_is_better).reversed()
    ours, theirs = ([np.array(cell) for cell in side] for side in zip(*pairs, strict=True))
    both, rng = [*ours, *theirs], np.random.default_rng(0)
    varies = _freedom(both) >= LEAST_FOR_INTERVAL - 1
    drawn, drawn_theirs = ([_resampled(cell, rng) for cell in some] for some in (ours, theirs))
    with np.errstate(invalid="ignore"):  # infinity minus infinity
        apart = float(interquartile_mean(np.concatenate(ours)) - interquartile_mean(np.concatenate(theirs)))
        resampled = np.subtract(
            *(interquartile_mean(np.concatenate(some, axis=1)) for some in (drawn, drawn_theirs))
        )
    chances = _improvement(drawn, drawn_theirs, lower_is_better)
    relabellings = math.prod(math.comb(len(a) + len(b), len(a)) for a, b in pairs)
    return Difference(
        apart if math.isfinite(apart) else None,
        _interval(resampled, both) if varies and np.isfinite(resampled).all() else None,
        float(
            _improvement([cell[None] for cell in ours], [cell[None] for cell in theirs], lower_is_better)[0]
        ),
        _interval(chances, both) if varies else None,
        2 / relabellings <= 1 - CONFIDENCE,
    )


def _improvement(ours: Strata, theirs: Strata, lower_is_better: bool) -> Values:
    """Return the probability of improvement of each resample; the scores of a track are (resamples, seeds)."""
    of_tracks = []
    for ours_here, other in zip(ours, theirs, strict=True):
        a, b = ours_here[:, :, None], other[:, None, :]
        better = a < b if lower_is_better else a > b
        of_tracks.append((better + 0.5 * (a == b)).mean(axis=(1, 2)))
    return np.asarray(np.mean(of_tracks, axis=0))


def _resampled(scores: Values, rng: np.random.Generator) -> Values:
    """Return resamples of the scores of a track, (RESAMPLES, seeds), drawn with replacement."""
    return scores[rng.integers(0, len(scores), (RESAMPLES, len(scores)))]


def _interval(statistic: Values, cells: Strata) -> Interval:
    """Return the expanded percentile interval of a statistic's resamples (RESAMPLES,)."""
    count, freedom = sum(map(len, cells)), _freedom(cells)
    from scipy.special import ndtr, stdtrit  # takes a tenth of a second, and most runs are one seed

    tail = float(ndtr(math.sqrt(count / freedom) * stdtrit(freedom, (1 - CONFIDENCE) / 2)))
    ordered = np.sort(statistic)
    outside = int(tail * len(ordered))  # no interpolation, which infinite values would not allow
    return float(ordered[outside]), float(ordered[-1 - outside])


def _freedom(cells: Strata) -> int:
    return sum(len(cell) - 1 for cell in cells)
