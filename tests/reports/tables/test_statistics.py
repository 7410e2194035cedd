"""Numbers that charts share."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.reports.tables.statistics import (
    chance_of_rise,
    count_rows,
    histogram,
    lowest_and_highest,
    means,
    moving_average,
    quantiles,
    wilson,
)

NUMBERS = st.lists(st.floats(-1e3, 1e3).map(lambda v: round(v, 3)), min_size=1, max_size=200)


def test_a_moving_average_is_of_a_value_and_the_two_before_that_are_known() -> None:
    assert moving_average(np.array([3.0, 6.0, 0.0, 3.0])).tolist() == [3.0, 4.5, 3.0, 3.0]
    np.testing.assert_array_equal(moving_average(np.array([1.0, np.nan, 3.0])), [1.0, np.nan, 2.0])


@given(NUMBERS)
def test_a_histogram_counts_every_value_once(values: list[float]) -> None:
    assert histogram(np.array(values)).counts.sum() == len(values)


def test_bins_of_times_in_steps_hold_equally_many_steps() -> None:
    times = np.random.default_rng(0).integers(120, 160, 5000) / 15
    found = histogram(times)
    steps = found.width * 15
    assert steps == pytest.approx(round(steps), abs=1e-3)
    # All steps are equally likely: whole bins are alike, which bins of unequal numbers of steps would not be.
    whole = found.counts[1:-1]
    assert whole.max() < 1.5 * whole.min()


def test_means_and_quantiles_are_those_of_pandas() -> None:
    dice = np.random.default_rng(0)
    place, values = dice.integers(-1, 30, 5_000), dice.normal(size=5_000)
    values[::50] = np.nan
    groups = pd.Series(values[place >= 0]).groupby(place[place >= 0])
    np.testing.assert_allclose(means(place, values, 30), groups.mean())
    np.testing.assert_allclose(quantiles(place, values, 30, (0.1, 0.5))[1], groups.median())
    low, high = lowest_and_highest(place, values, 30)
    np.testing.assert_array_equal(low, groups.min())
    np.testing.assert_array_equal(high, groups.max())
    assert count_rows(place, 30).sum() == (place >= 0).sum()
    assert np.isnan([means(place, values, 31)[30], quantiles(place, values, 31, (0.5,))[0, 30]]).all()


def test_wilson_agrees_with_a_published_interval() -> None:
    # Newcombe (1998), table I: 81 of 263 and 0 of 20.
    low, high = wilson(np.array([81.0, 0.0]), np.array([263.0, 20.0]))
    np.testing.assert_allclose(low, [0.2553, 0.0], atol=5e-5)
    np.testing.assert_allclose(high, [0.3662, 0.1611], atol=5e-5)


def test_the_chance_of_a_rise_is_small_where_all_values_rise_and_unknown_where_they_are_equal() -> None:
    rising = np.array([1.0, np.nan, 2.0, 3.0, 5.0, 8.0, 13.0])
    assert chance_of_rise(rising) == pytest.approx(1 / math.factorial(6))
    assert chance_of_rise(-rising) == pytest.approx(1.0)
    assert np.isnan(chance_of_rise(np.array([2.0, np.nan, 2.0])))
