"""Test whether the entropy of a policy rises, instead of falling as it learns."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from deepracer_exp.reports.tables.statistics import chance_of_rise, moving_average
from deepracer_exp.training.stopping.stopping_rules import entropy_share

LEAST_ITERATIONS = 12
"""Fewest iterations for a test."""
_BLOCKS = 12
"""More iterations are averaged to so many, because neighbours are not independent."""
RISE = 0.2
"""Rise that counts: of a list of actions as a share of the highest entropy, of a continuous space as the share by which
the actions scatter more."""
CHANCE = 0.02
"""Significance level: the chance of a false alarm for an entropy that only scatters."""


@dataclass(frozen=True, kw_only=True)
class RisingEntropy:
    """A rise of the entropy; entropies are means of three iterations in nats."""

    since: int
    """The iteration at which it was lowest."""
    lowest: float
    now: float
    rise: float
    """The rise in the terms of `RISE`."""


def rising_entropy(iterations: pd.DataFrame, action_count: int | None) -> RisingEntropy | None:
    """Test whether entropy has risen since it was lowest; None: it has not, or there are too few iterations to say.

    The entropies since then are compared with their order (Kendall's tau, one-sided), the chance of a false alarm
    divided by the number of possible starts (Bonferroni), as for `slower_laps`.

    Args:
        iterations: a row each, with `iteration` and `entropy` in nats.
        action_count: of a discrete policy, None of a continuous one.
    """
    rows = iterations[iterations["entropy"].notna()]
    if len(rows) < LEAST_ITERATIONS:
        return None
    entropy = moving_average(rows["entropy"].to_numpy(np.float64))
    place = int(entropy.argmin())
    lowest, now = float(entropy[place]), float(entropy[-1])
    rise = entropy_share(now, lowest, action_count) - entropy_share(lowest, lowest, action_count)
    parts = np.array_split(rows["entropy"].to_numpy(np.float64), _BLOCKS)
    blocks = np.array([part.mean() for part in parts])
    if rise < RISE or not chance_of_rise(blocks[blocks.argmin() :]) < CHANCE / _BLOCKS:
        return None
    return RisingEntropy(since=int(rows["iteration"].iloc[place]), lowest=lowest, now=now, rise=rise)
