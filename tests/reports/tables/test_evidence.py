"""Statistics over seeds: what they are, and that chance is not called a difference."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import bootstrap, mannwhitneyu, trim_mean

from deepracer_exp.reports.tables.evidence import (
    Difference,
    difference,
    estimate,
    interquartile_mean,
    iqm_band,
)

SCORES = st.lists(st.floats(-1e3, 1e3).map(lambda v: round(v, 3)), min_size=3, max_size=12)


@given(SCORES)
def test_the_interquartile_mean_is_scipys_and_leaves_a_quarter_out_at_either_end(scores: list[float]) -> None:
    kept = sorted(scores)[len(scores) // 4 : len(scores) - len(scores) // 4]
    assert interquartile_mean(np.array(scores)) == pytest.approx(np.mean(kept))
    assert estimate([np.array(scores)]).iqm == pytest.approx(trim_mean(scores, 0.25))


def test_with_many_seeds_the_interval_is_scipys_percentile_interval() -> None:
    scores = np.random.default_rng(1).normal(size=200)
    found = estimate([scores]).interval
    theirs = bootstrap(
        (scores,),
        lambda s, axis: trim_mean(s, 0.25, axis=axis),
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    np.testing.assert_allclose(found, theirs, atol=0.02)


def test_few_seeds_have_wider_intervals_which_hold_the_truth_as_often_as_they_say() -> None:
    dice, held = np.random.default_rng(2), 0
    for _ in range(300):
        low, high = estimate([dice.normal(size=5)]).interval or (0.0, 0.0)
        held += low <= 0 <= high
    assert 0.90 <= held / 300 <= 0.98


@settings(max_examples=30)
@given(SCORES, SCORES, st.randoms(use_true_random=False))
def test_the_order_of_seeds_tracks_and_groups_decides_nothing(a, b, dice) -> None:
    one, other = [np.array(a), np.array(b)], [np.array(b) + 1.0, np.array(a)]
    mixed = [np.array(dice.sample(list(cell), len(cell))) for cell in one]
    assert estimate(mixed[::-1]) == estimate(one)
    found = difference(one, other, lower_is_better=True)
    assert difference(mixed[::-1], other[::-1], lower_is_better=True) == found
    back = difference(other, one, lower_is_better=True).reversed()
    np.testing.assert_allclose(back.interval, found.interval)
    np.testing.assert_allclose(back.probability_interval, found.probability_interval, atol=1e-12)


def test_seeds_are_resampled_within_their_track() -> None:
    # Every track has scores of its own that do not vary: nothing does.
    constant = [np.full(4, 5.0), np.full(4, 9.0)]
    found = estimate(constant)
    assert found.interval == (found.iqm, found.iqm) == (7.0, 7.0)
    assert difference(constant, constant, lower_is_better=True).interval == (0.0, 0.0)


def test_the_probability_of_improvement_is_that_of_mann_and_whitney() -> None:
    dice = np.random.default_rng(3)
    a, b = dice.integers(0, 9, 7).astype(float), dice.integers(2, 11, 6).astype(float)
    higher = mannwhitneyu(a, b).statistic / (len(a) * len(b))
    assert difference([a], [b], lower_is_better=False).probability == pytest.approx(higher)
    assert difference([a], [b], lower_is_better=True).probability == pytest.approx(1 - higher)


@pytest.mark.parametrize(
    ("seeds", "tracks", "skewed"), [(5, 1, False), (5, 1, True), (10, 1, False), (3, 4, True)]
)
def test_groups_of_one_distribution_are_called_different_in_about_one_of_twenty_cases(
    seeds, tracks, skewed
) -> None:
    dice, called = np.random.default_rng(4), 0
    draw = (lambda: dice.lognormal(0, 0.8, seeds)) if skewed else (lambda: dice.normal(size=seeds))
    for _ in range(200):
        groups = [[draw() for _ in range(tracks)] for _ in range(2)]
        called += not difference(*groups, lower_is_better=True).explained_by_seeds
    assert called / 200 <= 0.07


def found_difference(seeds: int, shift: float, dice: np.random.Generator, tracks: int = 1) -> Difference:
    one, other = ([dice.normal(size=seeds) for _ in range(tracks)] for _ in range(2))
    return difference([cell - shift for cell in one], other, lower_is_better=True)


def test_a_real_difference_is_found_and_more_seeds_find_a_smaller_one() -> None:
    dice = np.random.default_rng(5)
    assert not any(found_difference(5, 8.0, dice).explained_by_seeds for _ in range(50))
    few, many = (
        sum(not found_difference(seeds, 1.5, dice).explained_by_seeds for _ in range(60)) for seeds in (5, 15)
    )
    assert few < many
    assert many >= 50


def test_three_seeds_on_one_track_are_too_few_and_on_two_tracks_enough() -> None:
    dice = np.random.default_rng(6)
    apart = found_difference(3, 50.0, dice)
    assert (apart.probability, apart.enough, apart.explained_by_seeds) == (1.0, False, True)
    assert not found_difference(3, 50.0, dice, tracks=2).explained_by_seeds
    single = difference([np.ones(1)], [np.zeros(1)], lower_is_better=True)
    assert (single.interval, single.probability_interval, single.explained_by_seeds) == (None, None, True)


def test_a_run_without_a_lap_is_worse_than_any_lap() -> None:
    laps_s, none = np.array([8.0, 8.1, 8.2, 8.3, np.inf]), np.full(5, np.inf)
    assert estimate([laps_s]).iqm == pytest.approx(8.2)
    assert np.isinf(estimate([none]).iqm)
    found = difference([laps_s], [none], lower_is_better=True)
    assert (found.iqm, found.interval, found.probability) == (None, None, pytest.approx(0.9))
    assert not found.explained_by_seeds


def test_a_band_needs_half_of_the_curves_and_three_of_them() -> None:
    curves = np.array([[1.0, 1.0, 1.0], [2.0, 2.0, np.nan], [3.0, np.nan, np.nan], [6.0, 4.0, np.nan]])
    middle, low, high = iqm_band(curves)
    np.testing.assert_allclose(middle, [2.5, 7 / 3, np.nan])
    assert np.isfinite(low).tolist() == np.isfinite(high).tolist() == [True, True, False]
    assert (low[0], high[0]) == estimate([curves[:, 0]]).interval
    assert np.isnan(iqm_band(curves[:2])[1:]).all()


def test_groups_without_a_lap_are_compared_without_a_warning(recwarn):
    nothing = np.full(3, np.inf)
    assert difference([nothing], [nothing], True).iqm is None
    assert not recwarn.list
