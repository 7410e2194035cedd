"""Means over runs and how far they can be trusted."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import ttest_1samp

CONFIDENCE = 0.95


def mean_and_interval(
    values: Sequence[float | None], digits: int = 4
) -> dict[str, float | list[float] | None]:
    """Return `mean` and `interval` of the values that are known, for JSON.

    Runs differ by their seeds only, and there are few of them: Student's interval of the mean. It is None with fewer
    than two values, the mean with none.
    """
    known = np.array([value for value in values if value is not None])
    if len(known) < 2:
        return {"mean": round(float(known[0]), digits) if len(known) else None, "interval": None}
    mean = float(known.mean())
    if np.ptp(known) == 0:  # no interval is defined for what does not vary
        return {"mean": round(mean, digits), "interval": [round(mean, digits)] * 2}
    low, high = ttest_1samp(known, 0.0).confidence_interval(CONFIDENCE)
    return {"mean": round(mean, digits), "interval": [round(float(low), digits), round(float(high), digits)]}
