"""A recording prepared for figures: known drives come out as they were made up."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.recorded import STEP_COLUMNS
from deepracer_exp.reports.tables.log_view import LogView, prepare
from deepracer_exp.reports.tables.step_columns import DERIVED_COLUMNS
from deepracer_exp.reports.tables.tables import EPISODE_COLUMNS, ITERATION_COLUMNS

from .made_up import Drive, made_up_course, made_up_recording

LENGTH_M = made_up_course().length_m
SLOW_S, FAST_S = (Drive(speed_mps=v).lap_time_s() for v in (1.0, 2.0))


@pytest.fixture(scope="module")
def view() -> LogView:
    drives = [
        Drive(speed_mps=1.0, iteration=0),
        Drive(speed_mps=2.0, iteration=0, start=0.25),
        Drive(speed_mps=1.5, iteration=1, off_at=40),
        Drive(speed_mps=1.5, iteration=1, until=0.5),
    ]
    return prepare(
        made_up_recording(
            drives, entropy=[1.5, 1.2], evaluated=[30.0, 60.0], evaluations={"race": [Drive(speed_mps=2.0)]}
        )
    )


def test_lap_times_statuses_and_waypoints_are_those_of_the_drives(view: LogView) -> None:
    table = view.episodes
    np.testing.assert_allclose(table["lap_time_s"], [SLOW_S, FAST_S, math.nan, math.nan])
    assert table["complete"].tolist() == [True, True, False, False]
    assert table["status"].tolist() == ["lap_complete", "lap_complete", "off_track", "in_progress"]
    assert table["progress"].iloc[3] == pytest.approx(50.0)
    assert table["last_waypoint"].iloc[2] == 40


def test_iterations_sum_up_their_episodes_and_take_what_the_update_logged(view: LogView) -> None:
    first, second = view.iterations.to_dict("records")
    assert (first["episodes"], first["complete"], first["lap_share"]) == (2, 2, 1.0)
    assert first["lap_time_best_s"] == pytest.approx(FAST_S)
    assert first["lap_time_p25_s"] == pytest.approx(0.25 * SLOW_S + 0.75 * FAST_S)
    assert math.isnan(second["lap_time_best_s"])
    assert (first["entropy"], second["entropy"]) == (1.5, 1.2)
    assert (first["eval_completion"], second["eval_completion"]) == (30.0, 60.0)
    assert math.isnan(second["held_out_completion"])
    assert first["steps"] + second["steps"] == len(view.steps)


def test_evaluations_stand_beside_the_training_and_every_table_has_its_documented_columns(
    view: LogView,
) -> None:
    assert view.evaluation_episodes["stream"].tolist() == ["race"]
    assert view.evaluation_episodes["lap_time_s"].tolist() == pytest.approx([FAST_S])
    assert set(view.steps["stream"]) == {"training"}
    for some in (view, prepare(made_up_recording([Drive()]))):
        assert list(some.steps) == [*STEP_COLUMNS, *DERIVED_COLUMNS]
        assert list(some.episodes) == list(EPISODE_COLUMNS)
        assert list(some.iterations) == list(ITERATION_COLUMNS)
        assert list(some.evaluation_episodes) == [*EPISODE_COLUMNS, "stream"]


def test_on_the_centre_line_at_constant_speed_nothing_accelerates_or_slides_away(view: LogView) -> None:
    rows = view.steps[view.steps["episode"] == 0].iloc[3:-3]
    np.testing.assert_allclose(rows["track_speed_mps"], 1.0, atol=0.02)
    np.testing.assert_allclose(rows["progress_speed_pps"], 100.0 / LENGTH_M, rtol=1e-6)
    assert rows["acceleration_mps2"].max() < 0.2
    assert rows["braking_mps2"].max() < 0.2
    assert rows["offset_m"].abs().max() < 1e-9
    assert rows["skew_deg"].abs().max() < 10.0


def test_a_car_that_starts_elsewhere_has_the_lap_position_of_the_course(view: LogView) -> None:
    rows = view.steps[view.steps["episode"] == 1]
    np.testing.assert_allclose(rows["lap_position"], (0.25 + rows["progress"] / 100) % 1.0, atol=1e-6)
    left = prepare(made_up_recording([Drive(offset_m=0.2)])).steps["offset_m"]
    assert left.median() == pytest.approx(0.2, abs=0.01)


def test_speeding_up_is_acceleration_and_slowing_down_is_braking() -> None:
    drive = Drive(speed_mps=1.0, sections=((0.4, 0.6, 3.0),))
    steps = prepare(made_up_recording([drive])).steps
    place = steps["lap_position"]
    assert steps.loc[place.between(0.39, 0.42), "acceleration_mps2"].max() > 5.0
    assert steps.loc[place.between(0.59, 0.63), "braking_mps2"].max() > 5.0
    assert steps.loc[place.between(0.39, 0.42), "braking_mps2"].max() < 0.5


def test_time_stamps_that_jitter_do_not_make_a_car_fast() -> None:
    recording = made_up_recording([Drive(speed_mps=2.0)])
    late_s = np.random.default_rng(0).uniform(-0.022, 0.022, len(recording.steps))
    jittered = recording.steps.assign(tstamp=recording.steps["tstamp"] + late_s)
    view = prepare(replace(recording, steps=jittered))
    single = (view.steps["delta_dist_m"] / view.steps["delta_time_s"]).iloc[3:-3]
    assert single.max() > 2.0 * 1.7
    assert view.steps["track_speed_mps"].iloc[3:-3].between(2.0 * 0.85, 2.0 * 1.2).all()


@pytest.mark.parametrize("name", ["console_v5_v2", "droa_v6_alternating", "droa_v6_fast"])
def test_no_speed_is_far_above_the_fastest_command(reference: Path, name: str) -> None:
    steps = prepare(read_recording(reference / "race_pace" / f"{name}.tar.gz")).steps
    assert steps["track_speed_mps"].max() <= steps["throttle"].max()


def test_a_tail_that_comes_round_slides_to_its_side_and_rolling_wheels_do_not() -> None:
    rolling, spinning = (
        prepare(made_up_recording([Drive(off_at=60, spins=spins)])).steps["slide_deg"].iloc[-4:]
        for spins in (False, True)
    )
    assert rolling.abs().max() < 10.0
    assert spinning.abs().max() > 30.0


def test_future_reward_sums_the_discounted_rest_of_the_episode(view: LogView) -> None:
    rows = view.steps[view.steps["episode"] == 2]
    reward = rows["reward"].to_numpy()
    expected = [float(np.sum(reward[k:] * 0.99 ** np.arange(len(reward) - k))) for k in range(len(reward))]
    np.testing.assert_allclose(rows["discounted_future_reward"], expected)


def test_rows_of_an_episode_that_stand_apart_are_put_together(view: LogView) -> None:
    steps = view.recording.steps
    mixed = steps.sort_values(["tstamp", "stream"], kind="stable").sort_values("steps", kind="stable")
    again = prepare(replace(view.recording, steps=mixed.reset_index(drop=True)))
    pd.testing.assert_frame_equal(again.steps, view.steps)
    pd.testing.assert_frame_equal(again.episodes, view.episodes)


def test_a_lap_whose_beginning_is_not_recorded_has_no_lap_time() -> None:
    recording = made_up_recording([Drive(), Drive()])
    view = prepare(replace(recording, steps=recording.steps.iloc[30:].reset_index(drop=True)))
    assert view.episodes["complete"].tolist() == [True, True]
    assert view.episodes["lap_time_s"].isna().tolist() == [True, False]
