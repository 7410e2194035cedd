"""Charts along the track: what they show adds up to what was driven."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.analysis.charts.actions import (
    action_classes,
    action_use_by_section,
    entropy_along_track,
    zero_steering_top_speed,
)
from deepracer_exp.analysis.charts.driving_line import (
    acceleration_map,
    lap_line,
    racing_line,
    sector_times,
    slide_map,
    speed_steering_by_waypoint,
    waypoint_map,
)
from deepracer_exp.analysis.charts.figure import Chart
from deepracer_exp.analysis.charts.layout import draw
from deepracer_exp.analysis.charts.maps import Grid
from deepracer_exp.analysis.charts.mistakes import episode_ends_map, off_track_risk, risk_counts, visits_map
from deepracer_exp.analysis.charts.rewards import reward_by_waypoint, reward_map, reward_terms, value_map
from deepracer_exp.analysis.log_view import LogView, prepare
from deepracer_exp.analysis.racing_line import MARGIN_M, center_line, minimum_curvature_line
from deepracer_exp.analysis.statistics import means, quantiles, totals, wilson

from .chart_layers import layers
from .made_up import Drive, made_up_course, made_up_recording

MAPS = (
    *(visits_map, waypoint_map, lap_line, acceleration_map, slide_map, racing_line, sector_times),
    *(action_use_by_section, zero_steering_top_speed, reward_map, value_map),
)
BY_WAYPOINT = (
    *(episode_ends_map, off_track_risk, speed_steering_by_waypoint, entropy_along_track, reward_by_waypoint),
)


@pytest.fixture(scope="module")
def view() -> LogView:
    drives = [
        Drive(
            speed_mps=1.0 + 0.25 * (k % 4), iteration=k // 4, start=0.1 * (k % 3), offset_m=0.1 * (k % 3 - 1)
        )
        for k in range(8)
    ]
    drives += [Drive(speed_mps=1.5, iteration=2, off_at=40) for _ in range(3)]
    drives += [Drive(speed_mps=2.0, iteration=2, off_at=80, start=0.3), Drive(iteration=2, until=0.4)]
    drives += [Drive(speed_mps=0.5, iteration=2, wanders=((0.5, 0.7),)) for _ in range(3)]
    return prepare(made_up_recording(drives))


@pytest.fixture(scope="module")
def lost(view: LogView) -> LogView:
    """Return the same without a known course."""
    return replace(view, course=None)


def drawn(chart: Chart | None) -> Chart:
    assert chart is not None
    return chart


@pytest.mark.parametrize("make", MAPS + BY_WAYPOINT, ids=lambda make: make.__name__)
def test_every_chart_bears_its_name_and_can_be_drawn(
    make: Callable[[LogView], Chart | None], view: LogView
) -> None:
    chart = drawn(make(view))
    assert chart.name == make.__name__
    assert chart.caption.count(". ") >= 1
    assert len(chart.table)
    assert len(draw(chart).to_json()) < 1_000_000
    cells = layers(chart, "cells")
    assert all(layer.z.dtype == np.float32 for layer in cells)
    assert sum(layer.z.size for layer in cells) <= 60_000


@pytest.mark.parametrize("make", MAPS, ids=lambda make: make.__name__)
def test_without_a_known_course_there_is_no_map(
    make: Callable[[LogView], Chart | None], lost: LogView
) -> None:
    assert make(lost) is None


@pytest.mark.parametrize("make", BY_WAYPOINT, ids=lambda make: make.__name__)
def test_without_a_known_course_there_are_still_charts_by_waypoint(
    make: Callable[[LogView], Chart | None], lost: LogView
) -> None:
    chart = drawn(make(lost))
    assert not any(panel.map for row in chart.rows for panel in row)
    assert draw(chart).data


@pytest.mark.parametrize("make", MAPS[:1] + MAPS[2:] + BY_WAYPOINT, ids=lambda make: make.__name__)
def test_a_recording_without_training_has_no_charts_of_it(
    make: Callable[[LogView], Chart | None], view: LogView
) -> None:
    nothing = replace(view, steps=view.steps.iloc[:0], episodes=view.episodes.iloc[:0])
    assert make(nothing) is None


def test_visits_add_up_to_the_rows(view: LogView) -> None:
    assert drawn(visits_map(view)).table["visits"].sum() == len(view.steps)


def test_the_reward_map_weighted_by_visits_is_the_mean_reward(view: LogView) -> None:
    table = drawn(reward_map(view)).table
    mean = np.average(table["reward_mean"], weights=table["visits"])
    assert mean == pytest.approx(view.driven("reward")["reward"].mean())


def test_rewards_by_waypoint_add_up_to_all_rewards(view: LogView) -> None:
    table = drawn(reward_by_waypoint(view)).table
    assert (table["reward_mean"] * table["steps"]).sum() == pytest.approx(
        view.driven("reward")["reward"].sum()
    )
    known = table[table["steps"] > 0]
    for low, high in (("worst", "median"), ("median", "best"), ("worst", "mean"), ("mean", "best")):
        assert (known[f"reward_{low}"] <= known[f"reward_{high}"] + 1e-9).all()


def test_risk_counts_add_up_to_the_episodes_that_left_the_road(view: LogView) -> None:
    table = drawn(off_track_risk(view)).table
    off = view.episodes[view.episodes["status"] == "off_track"]
    assert table["off_track"].sum() == len(off) == 4
    counted = table.loc[table["off_track"] > 0, "waypoint"]
    assert set(counted) == set(off["last_waypoint"])


def test_every_waypoint_of_a_complete_lap_is_passed_once(view: LogView) -> None:
    n = view.waypoint_count
    complete = view.episodes["complete"].to_numpy()
    passes, off = risk_counts(view, complete, n)
    np.testing.assert_array_equal(passes, complete.sum())
    assert not off.any()


def test_an_episode_passes_the_waypoints_from_its_start_to_its_end(view: LogView) -> None:
    n = view.waypoint_count
    row = view.episodes.index[view.episodes["last_waypoint"].between(78, 82) & ~view.episodes["complete"]][0]
    wanted = np.arange(len(view.episodes)) == row
    first, last = view.episodes.loc[row, ["first_waypoint", "last_waypoint"]]
    passes, _ = risk_counts(view, wanted, n)
    np.testing.assert_array_equal(np.flatnonzero(passes), np.arange(first, last + 1))
    near, off = risk_counts(view, wanted, n, reach=2)
    np.testing.assert_array_equal(np.flatnonzero(near), np.arange(first - 2, last + 3))
    np.testing.assert_array_equal(np.flatnonzero(off), np.arange(last - 2, last + 3))


def test_more_episodes_never_leave_the_road_near_a_waypoint_than_came_near_it(view: LogView) -> None:
    for reach in (0, 2, 5):
        passes, off = risk_counts(view, np.ones(len(view.episodes), bool), view.waypoint_count, reach)
        assert (off <= passes).all()


def test_the_ends_are_those_of_the_episodes_without_a_lap(view: LogView) -> None:
    table = drawn(episode_ends_map(view)).table
    assert set(table["status"]) == {"off_track"}
    assert len(table) == 4


def test_the_shares_of_actions_make_a_hundred_in_each_section(view: LogView) -> None:
    table = drawn(action_use_by_section(view)).table.drop(columns="action")
    np.testing.assert_allclose(table.sum(), 100.0)


def test_entropy_is_zero_where_all_do_the_same_and_high_where_chance_decides() -> None:
    always = [Drive(speed_mps=0.5, iteration=k, wanders=((0.5, 0.7),)) for k in range(3) for _ in range(4)]
    chart = drawn(entropy_along_track(prepare(made_up_recording(always))))
    entropy = chart.table["last_third"].to_numpy()
    n = len(entropy)
    assert entropy[2 : n // 10].max() == pytest.approx(0.0, abs=1e-9)
    assert np.nanmin(entropy[int(0.53 * n) : int(0.67 * n)]) > 0.5
    assert np.nanmax(entropy) <= np.log(3) + 1e-9


def test_a_continuous_action_space_is_sorted_into_ranges(view: LogView) -> None:
    steps = view.steps.assign(action=np.nan, steer=np.linspace(-30.0, 30.0, len(view.steps)))
    classes = action_classes(replace(view, steps=steps))
    assert classes is not None
    assert classes.continuous
    assert (np.diff(classes.steering_deg) > -20.0).all()
    assert (classes.number >= 0).all()
    assert len(classes.names) <= 15


def test_the_fastest_lap_is_the_one_drawn(view: LogView) -> None:
    chart = drawn(lap_line(view))
    best = view.episodes["lap_time_s"].min()
    assert f"{best:.3f} s" in chart.title
    assert np.ptp(chart.table["tstamp"]) == pytest.approx(best, abs=0.2)


def test_sectors_of_the_fastest_lap_make_its_time(view: LogView) -> None:
    table = drawn(sector_times(view)).table
    assert table["fastest_lap_s"].sum() == pytest.approx(view.episodes["lap_time_s"].min(), abs=0.01)
    assert (table["best_s"] <= table["median_s"] + 1e-9).all()


def test_a_car_on_the_centre_line_is_away_from_the_racing_line_by_the_lines_own_offset() -> None:
    view = prepare(made_up_recording([Drive(speed_mps=0.5)]))
    assert view.course is not None
    table = drawn(racing_line(view)).table
    line = minimum_curvature_line(view.course)
    places = np.linspace(0.0, 1.0, 1000)
    expected = -line.at(places, line.offset_m)
    assert table["median_m"].min() == pytest.approx(expected.min(), abs=0.02)
    assert table["median_m"].max() == pytest.approx(expected.max(), abs=0.02)


@pytest.mark.parametrize("name", ["reinvent_base", "Monaco", "reInvent2019_track", "Straight_track"])
def test_the_racing_line_bends_less_than_the_centre_line_and_keeps_to_the_road(name: str) -> None:
    course = made_up_course(name)
    line, center = minimum_curvature_line(course), center_line(course)

    def bends(which: np.ndarray) -> float:
        return float(np.square(which).mean())

    assert bends(line.curvature_pm) <= bends(center.curvature_pm) + 1e-12
    assert (np.abs(line.offset_m) <= course.width_max_m / 2 - MARGIN_M + 1e-6).all()
    dense = np.column_stack(
        [np.interp(np.linspace(0.01, 0.99, 500), line.lap_position, c) for c in line.xy.T]
    )
    assert course.on_road(dense).all()


def test_a_circle_is_steered_at_the_angle_of_its_radius() -> None:
    line = center_line(made_up_course("Oval_track"))
    np.testing.assert_allclose(np.tan(np.radians(line.steering_deg)), 0.164 * line.curvature_pm)
    slow = line.speed_mps(2.0, 3.0)
    assert slow.max() <= 3.0
    bend = np.abs(line.curvature_pm) > 2.0 / 9.0
    np.testing.assert_allclose(slow[bend] ** 2 * np.abs(line.curvature_pm[bend]), 2.0)


def test_cells_cover_the_road_and_are_not_too_many() -> None:
    for name in ("reinvent_base", "Spain_track", "Straight_track"):
        course = made_up_course(name)
        for most in (1_000, 20_000):
            grid = Grid.over(course, most)
            assert grid.count <= most
            assert (grid.of(*course.outer.T) >= 0).all()
            assert (grid.of(*course.inner.T) >= 0).all()
    assert Grid.over(made_up_course()).of([np.nan, 1e9], [0.0, 0.0]).tolist() == [-1, -1]


def test_means_and_quantiles_are_those_of_pandas() -> None:
    dice = np.random.default_rng(0)
    place, values = dice.integers(-1, 30, 5_000), dice.normal(size=5_000)
    values[::50] = np.nan
    groups = pd.Series(values[place >= 0]).groupby(place[place >= 0])
    np.testing.assert_allclose(means(place, values, 30), groups.mean())
    found = quantiles(place, values, 30, (0.1, 0.5))
    for row, share in zip(found, (0.1, 0.5), strict=True):
        np.testing.assert_allclose(row, groups.quantile(share, interpolation="lower"))
    assert totals(place, None, 30).sum() == (place >= 0).sum()
    assert np.isnan(means(place, values, 31)[30])


def test_wilson_agrees_with_a_published_interval() -> None:
    # Newcombe (1998), table I: 81 of 263 and 0 of 20.
    low, high = wilson(np.array([81.0, 0.0]), np.array([263.0, 20.0]), z=1.959964)
    np.testing.assert_allclose(low, [0.2553, 0.0], atol=5e-5)
    np.testing.assert_allclose(high, [0.3662, 0.1611], atol=5e-5)


def test_terms_are_shown_with_their_sum(view: LogView) -> None:
    rows = view.steps.index[5:400]
    terms = pd.DataFrame({"progress": 1.5, "off_road": -0.5}, index=rows)
    chart = drawn(reward_terms(view, terms))
    known = chart.table.dropna()
    np.testing.assert_allclose(known["sum"], 1.0)
    np.testing.assert_allclose(known["off_road"], -0.5)
    assert draw(chart).data
    assert reward_terms(view, terms.iloc[:0]) is None
