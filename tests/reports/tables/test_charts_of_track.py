"""Charts along the track: what they show adds up to what was driven."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.reports.charts.action_charts import (
    action_classes,
    action_use_by_section,
    entropy_along_track,
    zero_steering_top_speed,
)
from deepracer_exp.reports.charts.driving_line import (
    acceleration_map,
    lap_line,
    racing_line,
    sector_times,
    slide_map,
    speed_steering_by_waypoint,
    waypoint_map,
)
from deepracer_exp.reports.charts.figure import Chart
from deepracer_exp.reports.charts.layout import draw
from deepracer_exp.reports.charts.maps import Grid
from deepracer_exp.reports.charts.mistakes import episode_ends_map, off_track_risk, visits_map
from deepracer_exp.reports.charts.reward_charts import reward_by_waypoint, reward_map, reward_terms, value_map
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.pages.page import figure_json
from deepracer_exp.reports.tables.log_view import LogView, prepare
from deepracer_exp.reports.tables.off_track import risk_counts
from deepracer_exp.reports.tables.racing_line import MARGIN_M, center_line, minimum_curvature_line

from .chart_layers import drawn, layers
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


@pytest.mark.parametrize("make", MAPS + BY_WAYPOINT, ids=lambda make: make.__name__)
def test_every_chart_is_drawn_as_far_as_course_and_steps_are_known(
    make: Callable[[LogView], Chart | None], view: LogView
) -> None:
    chart = make(view)
    assert chart.name == make.__name__
    assert chart.caption.count(". ") >= 1
    assert len(chart.table)
    assert len(figure_json(draw(chart))) < 1_000_000
    cells = layers(chart, "cells")
    assert all(layer.z.dtype == np.float32 for layer in cells)
    assert sum(layer.z.size for layer in cells) <= 60_000
    lost = make(replace(view, course=None))
    assert (lost is None) == (make in MAPS)
    if lost is not None:
        assert not any(panel.map for row in lost.rows for panel in row)
        assert drawn(lost).data
    nothing = make(replace(view, steps=view.steps.iloc[:0], episodes=view.episodes.iloc[:0]))
    assert (nothing is None) == (make is not waypoint_map)


def test_visits_add_up_to_the_rows(view: LogView) -> None:
    assert np.nansum(layers(visits_map(view), "cells")[0].z) == len(view.steps)


def test_the_reward_map_is_the_mean_reward_of_each_cell(view: LogView) -> None:
    cells = layers(reward_map(view), "cells")[0]
    rows = view.driven("X", "Y", "reward")
    side = cells.x[1] - cells.x[0]
    column, row = ((rows[axis] - edges[0]) / side for axis, edges in (("X", cells.x), ("Y", cells.y)))
    means = rows.groupby([row.round().astype(int), column.round().astype(int)])["reward"].mean()
    near = [abs(cells.z[place] - mean) < 0.05 for place, mean in means.items()]
    assert np.mean(near) > 0.98  # on an edge between two cells rounding decides


def test_rewards_by_waypoint_are_those_of_the_steps(view: LogView) -> None:
    chart = reward_by_waypoint(view)
    rows = view.driven("closest_waypoint", "reward")
    groups = rows.groupby("closest_waypoint")["reward"]
    mean, median = layers(chart.rows[0][0], "line")
    best, worst = layers(chart.rows[1][0], "line")
    for line, expected in (
        *((mean, groups.mean()), (median, groups.median())),
        *((best, groups.max()), (worst, groups.min())),
    ):
        np.testing.assert_allclose(line.y[expected.index], expected, rtol=1e-5, atol=1e-6)


def test_risk_counts_add_up_to_the_episodes_that_left_the_road(view: LogView) -> None:
    off = view.episodes[view.episodes["status"] == "off_track"]
    before, late = (layer.y for layer in layers(off_track_risk(view), "bars"))
    assert (before + late).sum() == len(off) == 4
    assert set(np.flatnonzero(before + late)) == set(off["last_waypoint"])
    passes, left = risk_counts(view.episodes[view.episodes["complete"]], view.waypoint_count)
    assert (set(passes), left.any()) == ({view.episodes["complete"].sum()}, False)
    for reach in (0, 2, 5):
        passes, left = risk_counts(view.episodes, view.waypoint_count, reach)
        assert (left <= passes).all()


def test_the_figures_show_the_risk_and_the_sectors_of_the_findings() -> None:
    early = [Drive(speed_mps=2.0, iteration=k) for k in range(4)]
    late = [Drive(speed_mps=1.4 + 0.1 * k, iteration=5, start=0.3 * (k % 2)) for k in range(6)]
    view = prepare(made_up_recording([*early, *late, *[Drive(off_at=34 + k, iteration=5) for k in range(4)]]))
    found = {one.rule: one for one in findings(view)}
    high = next(one.y for one in layers(off_track_risk(view), "line") if one.name.startswith("last third"))
    assert high.max() == pytest.approx(40.0)
    assert "(4 of 10 passes" in found["runs_off"].sentence
    best_s = view.episodes["lap_time_s"][4:].min()
    assert (
        f"s without a standing start; the fastest of them took {best_s:.2f} s" in found["time_lost"].sentence
    )
    chart = sector_times(view)
    assert "6 complete laps since iteration 5." in chart.caption
    assert f"add up to {found['time_lost'].values['theoretical_best_s']:.3f} s" in chart.title


def test_tyres_that_hardly_slip_are_dark(view: LogView) -> None:
    (cells,) = layers(slide_map(view), "cells")
    assert np.nanpercentile(cells.z, 90) < 2.0
    assert cells.zmax >= 5.0


def test_an_episode_passes_the_waypoints_from_its_start_to_its_end(view: LogView) -> None:
    n = view.waypoint_count
    far = view.episodes["last_waypoint"].between(78, 82) & ~view.episodes["complete"]
    one = view.episodes[far].iloc[:1]
    first, last = one[["start_at", "last_waypoint"]].iloc[0]
    passes, _ = risk_counts(one, n)
    np.testing.assert_array_equal(np.flatnonzero(passes), np.arange(first, last + 1))
    near, off = risk_counts(one, n, reach=2)
    np.testing.assert_array_equal(np.flatnonzero(near), np.arange(first - 2, last + 3))
    np.testing.assert_array_equal(np.flatnonzero(off), np.arange(last - 2, last + 3))


def test_the_ends_are_those_of_the_episodes_without_a_lap(view: LogView) -> None:
    chart = episode_ends_map(view)
    assert chart.title == "Where 4 of 15 episodes ended before the lap was complete"
    assert [layer.name for layer in layers(chart, "bars")] == ["off the road (4)"]
    alone = episode_ends_map(prepare(made_up_recording([Drive(off_at=40)])))
    assert alone.title == "Where 1 of 1 episode ended before the lap was complete"


def test_the_shares_of_actions_make_a_hundred_in_each_section(view: LogView) -> None:
    np.testing.assert_allclose(layers(action_use_by_section(view), "cells")[0].z.sum(axis=0), 100.0, atol=0.2)


def test_entropy_is_zero_where_all_do_the_same_and_high_where_chance_decides() -> None:
    always = [Drive(speed_mps=0.5, iteration=k, wanders=((0.5, 0.7),)) for k in range(3) for _ in range(4)]
    chart = entropy_along_track(prepare(made_up_recording(always)))
    entropy = next(layer.y for layer in layers(chart, "line") if layer.name == "last third")
    n = len(entropy)
    assert entropy[2 : n // 10].max() == pytest.approx(0.0, abs=1e-9)
    assert np.nanmin(entropy[int(0.53 * n) : int(0.67 * n)]) > 0.5
    assert np.nanmax(entropy) <= np.log(3) + 1e-6


def test_a_continuous_action_space_is_sorted_into_ranges(view: LogView) -> None:
    steps = view.steps.assign(action=np.nan, steer=np.linspace(-30.0, 30.0, len(view.steps)))
    classes = action_classes(replace(view, steps=steps))
    assert classes.continuous
    assert (np.diff(classes.steering_deg) > -20.0).all()
    assert (classes.number >= 0).all()
    assert len(classes.names) <= 15


def test_the_fastest_lap_is_drawn_and_its_sectors_make_its_time(view: LogView) -> None:
    best_s = view.episodes["lap_time_s"].min()
    chart = lap_line(view)
    assert f"{best_s:.3f} s" in chart.title
    assert len(layers(chart, "points")[0].x) == pytest.approx(15 * best_s, abs=2)
    chart = sector_times(view)
    assert chart.title.endswith(f"the fastest of these laps took {best_s:.3f} s")
    assert (layers(chart, "bars")[0].y >= -1e-6).all()


def test_a_car_on_the_centre_line_is_away_from_the_racing_line_by_the_lines_own_offset() -> None:
    view = prepare(made_up_recording([Drive(speed_mps=0.5)]))
    chart = racing_line(view)
    assert "1 complete lap, median" in [one.name for one in layers(chart, "line")]
    assert layers(sector_times(view), "bars")[0].name == "median of 1 complete lap"
    median = next(one.y for one in layers(chart.rows[1][0], "line") if one.name == "median")
    line = minimum_curvature_line(view.course)
    expected = -line.interpolate(np.linspace(0.0, 1.0, 1000), line.offset_m)
    assert (median.min(), median.max()) == pytest.approx((expected.min(), expected.max()), abs=0.02)


@pytest.mark.parametrize("name", ["reinvent_base", "Monaco", "reInvent2019_track", "Straight_track"])
def test_the_racing_line_bends_less_than_the_centre_line_and_keeps_to_the_road(name: str) -> None:
    course = made_up_course(name)
    line, center = minimum_curvature_line(course), center_line(course)
    assert np.square(line.curvature_pm).mean() <= np.square(center.curvature_pm).mean() + 1e-12
    assert (np.abs(line.offset_m) <= course.width_max_m / 2 - MARGIN_M + 1e-6).all()
    places = np.linspace(0.01, 0.99, 500)
    assert course.on_road(np.column_stack([line.interpolate(places, axis) for axis in line.xy.T])).all()


def test_a_circle_is_steered_at_the_angle_of_its_radius() -> None:
    line = center_line(made_up_course("Oval_track"))
    np.testing.assert_allclose(np.tan(np.radians(line.steering_deg)), 0.164 * line.curvature_pm)
    slow = line.speed_mps(2.0, 3.0)
    assert slow.max() <= 3.0
    bend = np.abs(line.curvature_pm) > 2.0 / 9.0
    np.testing.assert_allclose(slow[bend] ** 2 * np.abs(line.curvature_pm[bend]), 2.0)


@pytest.mark.parametrize("name", ["reinvent_base", "Spain_track", "Straight_track"])
def test_cells_cover_the_road_and_are_not_too_many(name: str) -> None:
    course = made_up_course(name)
    for most in (1_000, 20_000):
        grid = Grid.over(course, most)
        assert grid.count <= most
        assert (grid.of(*np.concatenate([course.outer, course.inner]).T) >= 0).all()
    assert grid.of([np.nan, 1e9], [0.0, 0.0]).tolist() == [-1, -1]


def test_terms_are_shown_with_their_sum(view: LogView) -> None:
    terms = pd.DataFrame({"progress": 1.5, "off_road": -0.5}, index=view.steps.index[5:400])
    chart = reward_terms(view, terms)
    total, progress, off_road = layers(chart.rows[0][0], "line")
    for line, value in ((total, 1.0), (progress, 1.5), (off_road, -0.5)):
        np.testing.assert_allclose(line.y[np.isfinite(line.y)], value)
    assert drawn(chart).data
    assert reward_terms(view, terms.iloc[:0]) is None
