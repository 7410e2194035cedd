"""Laws of the figures of a training and of its episodes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deepracer_exp.analysis.charts.figure import Chart
from deepracer_exp.analysis.charts.laps import (
    correlations,
    lap_delta,
    lap_time_histogram,
    lap_time_percentile,
    start_position,
)
from deepracer_exp.analysis.charts.layout import draw
from deepracer_exp.analysis.charts.rewards import (
    common_rewards,
    discount_factors,
    discounted,
    reward_distribution,
    scatter_time_reward,
)
from deepracer_exp.analysis.charts.training import (
    evaluations,
    learning_vs_lap_time,
    quarters,
    stability,
    training_progress,
)
from deepracer_exp.analysis.log_view import LogView, prepare
from deepracer_exp.deepracer.recording_reader import read_recording

from .chart_layers import layers
from .made_up import Drive, made_up_recording

CONSOLE = Path(__file__).parents[2] / "../shared/reference/console_training"
ALL = (
    *(training_progress, learning_vs_lap_time, quarters, stability, evaluations),
    *(lap_time_histogram, lap_time_percentile, lap_delta, correlations),
    start_position,
    reward_distribution,
    common_rewards,
    scatter_time_reward,
    discount_factors,
)


PAID = (
    reward_distribution,
    common_rewards,
    discount_factors,
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
    entropy = np.linspace(2.6, 1.6, 20)
    return prepare(made_up_recording(drives, entropy=list(entropy), evaluations=races))


@pytest.mark.parametrize("figure", ALL)
def test_every_figure_has_labels_and_a_caption_and_is_drawn(
    view: LogView, figure: Callable[[LogView], Chart | None]
) -> None:
    chart = figure(view)
    assert chart is not None
    assert chart.name == figure.__name__
    assert chart.caption.endswith(".")
    assert len(chart.table)
    for row in chart.rows:
        for panel in row:
            assert panel.y_label
    assert chart.rows[-1][-1].x_label or chart.rows[-1][-1].x_names
    assert all(len(points.x) <= 5000 for points in layers(chart, "points"))
    assert draw(chart).data


@pytest.mark.parametrize("figure", ALL)
def test_a_training_of_one_short_episode_breaks_no_figure(figure: Callable[[LogView], Chart | None]) -> None:
    chart = figure(prepare(made_up_recording([Drive(until=0.02)])))
    if chart is not None:
        draw(chart)


@pytest.mark.parametrize("figure", ALL)
def test_a_race_without_a_training_breaks_no_figure(figure: Callable[[LogView], Chart | None]) -> None:
    chart = figure(prepare(made_up_recording([], evaluations={"race": [Drive()]})))
    # The others are of iterations, which a race has none of.
    of_drives = (evaluations, stability, lap_time_histogram, *PAID)
    assert (chart is not None) == (figure in of_drives)
    if chart is not None:
        draw(chart)


def test_a_training_that_stopped_growing_is_marked_where_it_did() -> None:
    drives = [Drive(iteration=k // 2, off_at=min(6 + 6 * (k // 2), 84)) for k in range(80)]
    flat = prepare(made_up_recording(drives, entropy=[2.0] * 40))
    marks = layers(training_progress(flat), "mark")
    assert len({mark.x0 for mark in marks}) == 1
    assert 11 <= marks[0].x0 <= 18
    growing = prepare(made_up_recording(drives[:26], entropy=[2.0] * 13))
    assert not layers(training_progress(growing), "mark")


def test_updates_without_laps_and_laps_without_updates_have_no_common_figure(view: LogView) -> None:
    recording = view.recording
    assert learning_vs_lap_time(prepare(replace(recording, updates=recording.updates[:0]))) is None
    assert learning_vs_lap_time(prepare(made_up_recording([Drive(until=0.2)], entropy=[2.0]))) is None


def test_entropy_that_falls_with_lap_time_is_named(view: LogView) -> None:
    chart = learning_vs_lap_time(view)
    assert chart is not None
    assert "entropy (rank correlation +1.00)" in chart.caption


def test_quarters_hold_all_episodes(view: LogView) -> None:
    chart = quarters(view)
    assert chart is not None
    assert chart.table["episodes"].sum() == view.episodes["ended"].sum() == 160
    assert chart.table["complete"].sum() == view.episodes["complete"].sum()


def test_the_real_time_factor_is_simulated_over_real_time(view: LogView) -> None:
    steps = view.recording.steps.copy()
    steps["wall_clock"] = 1.7e9 + np.arange(len(steps)) * 2 / 15
    chart = stability(prepare(replace(view.recording, steps=steps)))
    assert chart is not None
    panel = next(panel for row in chart.rows for panel in row if panel.title == "Real-time factor")
    line = layers(panel, "line")[0]
    assert np.median(line.y) == pytest.approx(0.5, rel=0.02)
    titles = [panel.title for row in stability(view).rows for panel in row]  # type: ignore[union-attr]
    assert "Real-time factor" not in titles


def test_starts_are_counted_at_their_places(view: LogView) -> None:
    chart = start_position(view)
    assert chart is not None
    np.testing.assert_allclose(chart.table["start"], np.arange(0, 100, 5))
    assert (chart.table["episodes"] == 8).all()


def test_all_starts_at_one_place_say_nothing_of_places() -> None:
    assert start_position(prepare(made_up_recording([Drive()] * 4))) is None


def test_bars_of_episode_rewards_count_every_episode_once(view: LogView) -> None:
    chart = reward_distribution(view)
    assert chart is not None
    bars = layers(chart.rows[0][1], "bars")
    assert [layer.y.sum() for layer in bars] == [
        (~view.episodes["complete"]).sum(),
        view.episodes["complete"].sum(),
    ]


def test_common_rewards_are_shares_of_all_steps(view: LogView) -> None:
    steps = view.recording.steps.copy()
    steps["reward"] = np.where(np.arange(len(steps)) % 4, 1.0, 0.25)
    chart = common_rewards(prepare(replace(view.recording, steps=steps)))
    assert chart is not None
    assert chart.rows[0][0].x_names == ["0.25", "1"]
    np.testing.assert_allclose(layers(chart, "bars")[0].y, [25.0, 75.0], atol=0.1)


def test_the_weight_of_a_reward_halves_where_the_caption_says() -> None:
    chart = discount_factors(prepare(made_up_recording([Drive()])))
    assert chart is not None
    assert "69 steps (4.6 s)" in chart.caption
    own = next(layer for layer in layers(chart, "line") if layer.name == "0.99 (this training)")
    assert np.interp(69.0, own.x, own.y) == pytest.approx(50.0, abs=0.5)


def test_the_future_reward_of_the_figure_is_that_of_the_steps(view: LogView) -> None:
    rewards = view.steps[view.steps["episode"] == 5]
    found = discounted(rewards["reward"].to_numpy(), view.discount)
    np.testing.assert_allclose(found, rewards["discounted_future_reward"])


@pytest.mark.skipif(not CONSOLE.is_dir(), reason="the recorded console training is not there")
def test_the_console_training_has_47_laps_the_best_of_14_13_s() -> None:
    console = prepare(read_recording(CONSOLE))
    chart = lap_time_histogram(console)
    assert chart is not None
    assert len(chart.table) == 47
    assert any(mark.name == "best 14.13 s" for mark in layers(chart, "mark"))
    drawn = [figure(console) for figure in ALL]
    assert all(chart is not None for chart in drawn)
    assert max(len(draw(chart).to_json()) for chart in drawn if chart is not None) < 120_000
