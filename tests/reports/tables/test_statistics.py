"""Numbers that charts share."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.stats import kendalltau, trim_mean

from deepracer_exp.reports.tables.evidence import interquartile_mean
from deepracer_exp.reports.tables.statistics import (
    chance_of_rise,
    histogram,
    means,
    moving_average,
    quantiles,
    totals,
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
    assert totals(place, None, 30).sum() == (place >= 0).sum()
    assert np.isnan([means(place, values, 31)[30], quantiles(place, values, 31, (0.5,))[0, 30]]).all()


def test_wilson_agrees_with_a_published_interval() -> None:
    # Newcombe (1998), table I: 81 of 263 and 0 of 20.
    low, high = wilson(np.array([81.0, 0.0]), np.array([263.0, 20.0]))
    np.testing.assert_allclose(low, [0.2553, 0.0], atol=5e-5)
    np.testing.assert_allclose(high, [0.3662, 0.1611], atol=5e-5)


@given(st.lists(st.one_of(st.integers(0, 5).map(float), st.floats(0.0, 9.0), st.just(np.nan)), max_size=12))
def test_the_chance_of_a_rise_is_that_of_kendalls_tau(values: list[float]) -> None:
    assume(np.isfinite(values).sum() > 1)  # SciPy warns of fewer
    expected = kendalltau(np.arange(len(values)), values, alternative="greater", nan_policy="omit").pvalue
    assert chance_of_rise(np.array(values)) == pytest.approx(expected, rel=1e-12, nan_ok=True)


@given(st.lists(NUMBERS.map(lambda numbers: (numbers * 7)[:7]), min_size=1, max_size=4), st.integers(1, 7))
def test_an_interquartile_mean_leaves_a_quarter_out_at_either_end(
    rows: list[list[float]], seeds: int
) -> None:
    scores = np.array(rows)[:, :seeds]
    np.testing.assert_array_equal(interquartile_mean(scores), trim_mean(scores, 0.25, axis=1))
    np.testing.assert_array_equal(interquartile_mean(scores.T, axis=0), trim_mean(scores, 0.25, axis=1))
