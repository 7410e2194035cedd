"""Charts of a training and of its laps: what they show is what was driven."""

from collections.abc import Callable
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from deepracer_exp.reports.charts.figure import Chart
from deepracer_exp.reports.charts.lap_charts import (
    CHANCES,
    correlations,
    lap_delta,
    lap_time_histogram,
    lap_time_percentile,
    start_position,
)
from deepracer_exp.reports.charts.layout import draw
from deepracer_exp.reports.charts.reward_charts import (
    common_rewards,
    discount_factors,
    reward_distribution,
    scatter_time_reward,
)
from deepracer_exp.reports.charts.training_charts import (
    evaluations,
    learning_vs_lap_time,
    quarters,
    stability,
    training_progress,
)
from deepracer_exp.reports.pages.page import figure_json
from deepracer_exp.reports.tables.log_view import LogView, prepare

from .chart_layers import drawn, layers
from .made_up import Drive, made_up_course, made_up_recording

OF_LAPS = (lap_time_histogram, lap_time_percentile, lap_delta, correlations)
OF_RACES = (evaluations, stability, lap_time_histogram, reward_distribution, common_rewards, discount_factors)
ALL = (
    *(training_progress, learning_vs_lap_time, quarters, stability, evaluations, *OF_LAPS, start_position),
    *(reward_distribution, common_rewards, scatter_time_reward, discount_factors),
)


@pytest.fixture(scope="module")
def view() -> LogView:
    drives = [
        Drive(
            iteration=k // 8,
            speed_mps=round(1.2 + 0.002 * k, 3),
            start=0.05 * (k % 20),
            off_at=None if k > 60 and k % 4 else (6 * k + 20) % 119,
        )
        for k in range(160)
    ]
    races = {"race": [Drive(speed_mps=1.4), Drive(speed_mps=1.4, until=0.5)]}
    return prepare(made_up_recording(drives, entropy=list(np.linspace(2.6, 1.6, 20)), evaluations=races))


@pytest.fixture(scope="module")
def lapping() -> LogView:
    """Nine iterations of ten episodes, two of three of which are laps that get faster."""
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


@pytest.mark.parametrize("figure", ALL)
def test_every_figure_has_labels_and_a_caption_and_is_drawn(
    view: LogView, figure: Callable[[LogView], Chart | None]
) -> None:
    chart = figure(view)
    assert chart is not None
    assert chart.name == figure.__name__
    assert chart.caption.endswith(".")
    assert len(chart.table)
    assert all(panel.y_label for row in chart.rows for panel in row)
    assert chart.rows[-1][-1].x_label or chart.rows[-1][-1].x_names
    assert all(len(points.x) <= 5000 for points in layers(chart, "points"))
    assert drawn(chart).data


def test_a_short_training_or_a_race_alone_breaks_no_figure() -> None:
    short = prepare(made_up_recording([Drive(until=0.02)]))
    race = prepare(made_up_recording([], evaluations={"race": [Drive()]}))
    # A race has no iterations.
    assert {figure.__name__ for figure in ALL if figure(race)} == {figure.__name__ for figure in OF_RACES}
    for chart in filter(None, (figure(view) for figure in ALL for view in (short, race))):
        assert drawn(chart).data


def test_without_complete_laps_no_laps_are_drawn() -> None:
    view = prepare(made_up_recording([Drive(until=0.3), Drive(until=0.5, iteration=1)]))
    assert [figure(view) for figure in OF_LAPS] == [None] * len(OF_LAPS)


def test_a_training_that_stopped_growing_is_marked_where_it_did() -> None:
    # Of fewer episodes several iterations are judged together.
    drives = [Drive(iteration=k // 5, off_at=min(6 + 6 * (k // 5), 84)) for k in range(200)]
    marks = layers(training_progress(prepare(made_up_recording(drives, entropy=[2.0] * 40))), "mark")
    assert len({mark.x0 for mark in marks}) == 1
    assert 11 <= marks[0].x0 <= 18
    growing = prepare(made_up_recording(drives[:65], entropy=[2.0] * 13))
    assert not layers(training_progress(growing), "mark")


def test_updates_without_laps_and_laps_without_updates_have_no_common_figure(view: LogView) -> None:
    recording = view.recording
    assert learning_vs_lap_time(prepare(replace(recording, updates=recording.updates[:0]))) is None
    assert learning_vs_lap_time(prepare(made_up_recording([Drive(until=0.2)], entropy=[2.0]))) is None


def test_episodes_of_one_race_and_of_two_are_called_so(view: LogView) -> None:
    assert "episode of an evaluation or race on this course" in evaluations(view).caption
    two = made_up_recording([], evaluations={"race": [Drive()], "second": [Drive()]})
    assert "episode of one of 2 evaluations or races" in evaluations(prepare(two)).caption


def test_quarters_count_all_laps(view: LogView) -> None:
    chart = quarters(view)
    ended = view.episodes[view.episodes["ended"]]
    counts = ended.groupby("quarter")["complete"].sum()
    assert counts.sum() == view.episodes["complete"].sum()
    assert f"the 160 episodes in their order. Complete laps per quarter: {', '.join(map(str, counts))}." in (
        chart.caption
    )
    np.testing.assert_allclose(layers(chart.rows[0][1], "bars")[0].y, 100 * counts / 40)


def test_starts_are_counted_at_their_places(view: LogView) -> None:
    bars = layers(start_position(view), "bars")
    np.testing.assert_allclose(bars[1].x, np.arange(0, 100, 5))
    assert (bars[1].y == 8).all()
    assert start_position(prepare(made_up_recording([Drive()] * 4))) is None


def test_bars_of_rewards_count_every_episode_once_and_every_step_by_its_share(view: LogView) -> None:
    bars = layers(reward_distribution(view).rows[0][1], "bars")
    complete = view.episodes["complete"]
    assert [layer.y.sum() for layer in bars] == [(~complete).sum(), complete.sum()]
    steps = view.recording.steps.copy()
    steps["reward"] = np.where(np.arange(len(steps)) % 4, 1.0, 0.25)
    steps.loc[steps["episode_status"] == "prepare", "reward"] = 0.0  # not paid by the reward function
    chart = common_rewards(prepare(replace(view.recording, steps=steps)))
    assert chart.rows[0][0].x_names == ["0.25", "1"]
    np.testing.assert_allclose(layers(chart, "bars")[0].y, [25.0, 75.0], atol=0.1)
    caption = reward_distribution(prepare(replace(view.recording, steps=steps))).caption
    assert caption.startswith("Half of the steps earn at least 1, one in ten at least 1.")


def test_the_weight_of_a_reward_halves_where_the_caption_says() -> None:
    chart = discount_factors(prepare(made_up_recording([Drive()])))
    assert "69 steps (4.6 s)" in chart.caption
    own = next(layer for layer in layers(chart, "line") if layer.name == "0.99 (this training)")
    assert np.interp(69.0, own.x, own.y) == pytest.approx(50.0, abs=0.5)


def test_a_log_without_hyperparameters_has_the_services_discount() -> None:
    recording = replace(made_up_recording([Drive()]), hyperparameters=None)
    assert (
        "of 0.999 (the service's default), a reward counts half"
        in discount_factors(prepare(recording)).caption
    )


def test_without_a_discount_no_number_of_steps_halves_a_reward() -> None:
    caption = discount_factors(replace(prepare(made_up_recording([Drive()])), discount=1.0)).caption
    assert caption.endswith("of 1 (this training), rewards count the same however late they come.")


def test_marks_stand_at_mean_best_and_deviations_of_all_laps(lapping: LogView) -> None:
    times = lapping.episodes["lap_time_s"].dropna()
    panel, late = lap_time_histogram(lapping).rows[0]
    marks = sorted(one.x0 for one in layers(panel, "mark"))
    deviations = [times.mean() - n * times.std() for n in (2, 3)]
    assert marks == pytest.approx(sorted([times.mean(), times.min(), *deviations]))
    for n, chance in CHANCES.items():
        assert chance == pytest.approx(NormalDist().cdf(n))
    counts = [sum(one.y.sum() for one in layers(some, "bars")) for some in (panel, late)]
    last_third = lapping.episodes["iteration"] >= 6
    assert counts == [60, (last_third & lapping.episodes["complete"]).sum()]
    bars, line = layers(panel, "bars")[0], layers(panel, "line")[0]
    assert np.trapezoid(line.y, line.x) == pytest.approx(bars.y.sum() * bars.width, rel=0.01)


def test_one_lap_is_a_histogram_without_chances() -> None:
    chart = lap_time_histogram(prepare(made_up_recording([Drive()])))
    assert len(layers(chart, "mark")) == 2
    assert layers(chart, "bars")[0].y.sum() == 1
    assert chart.caption.startswith("No chances can be estimated from 1 complete lap:")


def test_stars_are_the_candidates_for_submission(lapping: LogView) -> None:
    star = next(one for one in layers(lap_time_percentile(lapping), "points") if one.marker.symbol == "star")
    assert sorted(star.x) == sorted(lapping.candidates["iteration"])


def test_time_is_lost_where_the_slower_lap_is_slower() -> None:
    slow, fast = Drive(speed_mps=1.5, sections=((0.4, 0.5, 1.0),)), Drive(speed_mps=1.5)
    chart = lap_delta(prepare(made_up_recording([fast, slow])))
    line = layers(chart.rows[0][0], "line")[0]
    lost_s = np.interp(np.array([0.39, 0.51, 1.0]) * made_up_course().length_m, line.x, line.y)
    whole = slow.lap_time_s() - fast.lap_time_s()
    np.testing.assert_allclose(lost_s, [0.0, whole, whole], atol=0.03)
    assert f"{whole:.2f} s slower" in chart.caption


def test_the_names_of_sectors_stand_above_the_lost_time(lapping: LogView) -> None:
    panel = lap_delta(lapping).rows[0][0]
    assert panel.y_range[1] > layers(panel, "line")[0].y.max() + 0.3 * np.diff(panel.y_range)[0]


def test_the_ordinary_lap_began_where_the_fastest_did() -> None:
    drives = [Drive(speed_mps=1.3 + 0.01 * k, start=0.1 * (k % 2)) for k in range(20)]
    chart = lap_delta(prepare(made_up_recording(drives)))
    ordinary, fastest = (one for one in layers(chart, "line") if one.showlegend)
    begins = [layer.x[np.flatnonzero(np.isnan(layer.x))[0] + 1] for layer in (ordinary, fastest)]
    assert begins[0] == pytest.approx(begins[1], abs=0.2)


def test_lap_time_goes_against_speed_and_the_closest_comes_first(lapping: LogView) -> None:
    chart = correlations(lapping)
    panels = [panel for row in chart.rows for panel in row]
    r = [float(panel.title.removeprefix("r = ")) for panel in panels]
    assert [abs(one) for one in r] == sorted((abs(one) for one in r), reverse=True)
    assert r[[panel.x_label for panel in panels].index("speed along the track, mean, m/s")] < -0.97
    assert {len(layers(panel, "line")) for panel in panels} <= {1, 2}
    assert len(chart.rows[0]) == 3


def test_the_console_training_has_48_laps_the_best_of_14_20_s(console: LogView) -> None:
    chart = lap_time_histogram(console)
    assert chart.rows[0][0].title == "All complete laps (48)"
    assert any(mark.name == "best 14.20 s" for mark in layers(chart, "mark"))
    assert max(len(figure_json(draw(figure(console)))) for figure in ALL) < 120_000
