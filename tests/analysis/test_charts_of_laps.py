"""Laws of the figures of lap times."""

from statistics import NormalDist

import numpy as np
import pytest

from deepracer_exp.analysis.candidates import candidates
from deepracer_exp.analysis.charts.laps import (
    CHANCES,
    correlations,
    lap_delta,
    lap_time_histogram,
    lap_time_percentile,
)
from deepracer_exp.analysis.log_view import LogView, prepare

from .chart_layers import layers
from .made_up import Drive, made_up_course, made_up_recording


@pytest.fixture(scope="module")
def view() -> LogView:
    dice = np.random.default_rng(3)
    drives = [
        Drive(
            iteration=k // 10,
            speed_mps=round(1.2 + 0.004 * k + 0.1 * dice.normal(), 3),
            until=1.0 if k % 3 else 0.4,
        )
        for k in range(90)
    ]
    return prepare(made_up_recording(drives))


def test_the_chance_of_a_marked_lap_time_is_that_of_a_normal_distribution() -> None:
    assert CHANCES[-2] == pytest.approx(NormalDist().cdf(-2)) == pytest.approx(0.02275, abs=1e-5)
    assert CHANCES[-3] == pytest.approx(NormalDist().cdf(-3)) == pytest.approx(0.00135, abs=1e-5)


def test_marks_stand_at_mean_best_and_deviations_of_all_laps(view: LogView) -> None:
    times = view.episodes["lap_time_s"].dropna()
    panel = lap_time_histogram(view).rows[0][0]  # type: ignore[union-attr]
    marks = sorted(one.x0 for one in layers(panel, "mark"))
    deviations = [times.mean() - n * times.std() for n in (2, 3)]
    assert marks == pytest.approx(sorted([times.mean(), times.min(), *deviations]))


def test_the_histogram_counts_every_complete_lap_once(view: LogView) -> None:
    panels = lap_time_histogram(view).rows[0]  # type: ignore[union-attr]
    counts = [sum(one.y.sum() for one in layers(panel, "bars")) for panel in panels]
    late = view.episodes["iteration"] >= 6
    assert counts == [60, (late & view.episodes["complete"]).sum()]


def test_the_curve_over_the_histogram_has_its_area(view: LogView) -> None:
    panel = lap_time_histogram(view).rows[0][0]  # type: ignore[union-attr]
    bars, line = layers(panel, "bars")[0], layers(panel, "line")[0]
    assert np.trapezoid(line.y, line.x) == pytest.approx(bars.y.sum() * bars.width, rel=0.01)


def test_without_complete_laps_nothing_is_drawn() -> None:
    none = prepare(made_up_recording([Drive(until=0.3), Drive(until=0.5, iteration=1)]))
    assert [one(none) for one in (lap_time_histogram, lap_time_percentile, lap_delta, correlations)] == [
        None
    ] * 4


def test_one_lap_is_a_histogram_without_chances() -> None:
    chart = lap_time_histogram(prepare(made_up_recording([Drive()])))
    assert len(layers(chart, "mark")) == 2
    assert layers(chart, "bars")[0].y.sum() == 1


def test_stars_are_the_candidates_for_submission(view: LogView) -> None:
    star = next(one for one in layers(lap_time_percentile(view), "points") if one.marker.symbol == "star")
    assert sorted(star.x) == sorted(candidates(view.iterations)["iteration"])


def test_time_is_lost_where_the_slower_lap_is_slower() -> None:
    slow = Drive(speed_mps=1.5, sections=((0.4, 0.5, 1.0),))
    fast = Drive(speed_mps=1.5)
    chart = lap_delta(prepare(made_up_recording([fast, slow])))
    assert chart is not None
    line = layers(chart.rows[0][0], "line")[0]
    length_m = made_up_course().length_m
    lost_s = np.interp(np.array([0.39, 0.51, 1.0]) * length_m, line.x, line.y)
    whole = slow.lap_time_s() - fast.lap_time_s()
    np.testing.assert_allclose(lost_s, [0.0, whole, whole], atol=0.03)
    assert f"{whole:.2f} s slower" in chart.caption


def test_the_ordinary_lap_began_where_the_fastest_did() -> None:
    drives = [Drive(speed_mps=1.3 + 0.01 * k, start=0.1 * (k % 2)) for k in range(20)]
    view = prepare(made_up_recording(drives))
    chart = lap_delta(view)
    speeds = [one for one in layers(chart, "line") if one.showlegend]
    assert len(speeds) == 2
    gaps = [layer.x[np.flatnonzero(np.isnan(layer.x))[0] + 1] for layer in speeds]
    assert gaps[0] == pytest.approx(gaps[1], abs=0.2)


def test_lap_time_goes_against_speed(view: LogView) -> None:
    chart = correlations(view)
    assert chart is not None
    table = chart.table.set_index("column")
    assert table["r"]["speed_mean_mps"] < -0.97
    assert table["r2_linear"]["speed_mean_mps"] == pytest.approx(table["r"]["speed_mean_mps"] ** 2, abs=1e-6)
    assert (table["r2_cubic"] >= table["r2_linear"] - 1e-9).all()
    assert list(chart.table["r"].abs()) == sorted(chart.table["r"].abs(), reverse=True)
    assert len(chart.rows[0]) == 3
