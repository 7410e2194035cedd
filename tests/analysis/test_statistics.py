"""Laws of the numbers that charts share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.analysis.statistics import (
    correlation,
    fit_polynomial,
    histogram,
    median_band,
    moving_average,
)

NUMBERS = st.lists(st.floats(-1e3, 1e3).map(lambda v: round(v, 3)), min_size=1, max_size=200)


def test_a_moving_average_is_of_a_value_and_the_two_before() -> None:
    assert moving_average(np.array([3.0, 6.0, 0.0, 3.0])).tolist() == [3.0, 4.5, 3.0, 3.0]


def test_an_unknown_value_has_no_average_and_does_not_spoil_the_next_one() -> None:
    assert moving_average(np.array([1.0, np.nan, 3.0])).tolist()[::2] == [1.0, 2.0]
    assert np.isnan(moving_average(np.array([1.0, np.nan, 3.0]))[1])


@given(NUMBERS)
def test_a_histogram_counts_every_value_once(values: list[float]) -> None:
    found = histogram(np.array(values))
    assert found.counts.sum() == len(values)


def test_bins_of_times_in_steps_hold_equally_many_steps() -> None:
    times = np.random.default_rng(0).integers(120, 160, 5000) / 15
    found = histogram(times)
    steps = found.width * 15
    assert steps == pytest.approx(round(steps), abs=1e-3)
    # All steps are equally likely: whole bins are alike, which bins of unequal numbers of steps would not be.
    whole = found.counts[1:-1]
    assert whole.max() < 1.5 * whole.min()


def test_a_fit_finds_the_curve_that_made_the_points() -> None:
    x = np.linspace(14, 16, 40)
    found = fit_polynomial(x, 3 * x**2 - 2 * x + 1, 2)
    assert found is not None
    np.testing.assert_allclose(found.coefficients, [3, -2, 1], rtol=1e-6, atol=1e-5)
    assert found.r_squared == pytest.approx(1.0)


def test_a_straight_fit_explains_the_square_of_the_correlation() -> None:
    dice = np.random.default_rng(1)
    x = dice.normal(size=300)
    y = x + dice.normal(size=300)
    found = fit_polynomial(x, y, 1)
    assert found is not None
    assert found.r_squared == pytest.approx(correlation(x, y) ** 2)


def test_too_few_places_decide_on_no_curve() -> None:
    assert fit_polynomial(np.array([1.0, 1.0, 2.0]), np.array([1.0, 2.0, 3.0]), 1) is None
    assert np.isnan(correlation(np.ones(5), np.arange(5.0)))


def test_a_bootstrap_interval_holds_the_true_median_about_as_often_as_it_says() -> None:
    dice = np.random.default_rng(2)
    _, low, high = median_band(dice.normal(size=(15, 400)))
    held = float(((low <= 0) & (high >= 0)).mean())
    assert 0.88 <= held <= 0.995


def test_one_run_has_a_median_and_no_interval() -> None:
    median, low, high = median_band(np.array([[1.0, 2.0]]))
    assert median.tolist() == [1.0, 2.0]
    assert np.isnan([low, high]).all()


def test_where_most_runs_have_ended_there_is_no_median() -> None:
    curves = np.array([[1.0, 1.0], [2.0, np.nan], [3.0, np.nan]])
    assert np.isnan(median_band(curves)[0][1])
