from dataclasses import replace

import numpy as np
import pytest

from deepracer_exp.commands.validation.simple_driver import (
    SHARES,
    SimpleDriver,
    action_space_laps,
    drive_laps,
    flawed_laps,
)
from deepracer_exp.commands.validation.situations import (
    named_situations,
    poses,
    sample,
    seam,
    situations,
    start,
)
from deepracer_exp.config.driving import DiscreteAction, DiscreteActionSpace
from deepracer_exp.env.action_space import build_action_space


def test_situations_are_where_they_were_requested(race):
    at = poses(race, [0.25, 0.5], [0.2, -0.3], [0.1, 0.0], 2.0, 10.0)
    columns = situations(race, at).columns
    np.testing.assert_allclose(columns["distance_from_center"], [0.2, 0.3], atol=0.02)
    np.testing.assert_allclose(columns["progress"], [25, 50], atol=0.5)
    assert columns["speed"].tolist() == [2.0, 2.0]
    assert columns["steering_angle"].tolist() == [10.0, 10.0]
    assert columns["all_wheels_on_track"][0]
    lap_steps = race.track.length_m / 2.0 * 15
    np.testing.assert_allclose(columns["steps"], [2 + lap_steps / 4, 2 + lap_steps / 2], atol=1)
    np.testing.assert_allclose(columns["sim_time"], columns["steps"] / 15)


def test_the_named_situations_are_what_they_are_called(race, against):
    named = {
        case.name: {k: v[0] for k, v in case.now.columns.items()} for case in named_situations(race, against)
    }
    named["start"] = {k: v[0] for k, v in start(race).columns.items()}
    assert list(named) == ["mid-lap", "off the track", "finish", "wrong way", "reversed track", "start"]
    assert named["start"]["steps"] == 2
    assert named["start"]["progress"] < 2
    assert named["mid-lap"]["progress"] == pytest.approx(50)
    assert named["off the track"]["is_offtrack"]
    assert [name for name, columns in named.items() if columns["is_offtrack"]] == ["off the track"]
    assert named["finish"]["progress"] == 100
    turned = abs(named["wrong way"]["heading"] - named["mid-lap"]["heading"])
    assert turned == pytest.approx(180)
    reverse = {case.name: case.now.road for case in named_situations(race, against)}
    assert reverse["reversed track"].is_reversed
    assert reverse["reversed track"].waypoints == reverse["mid-lap"].waypoints[::-1]


def test_the_step_before_is_a_step_behind(race, against):
    case = named_situations(race, against)[0]
    now, before = case.now.columns, case.before.columns
    assert now["steps"] - before["steps"] == 1
    moved_m = np.hypot(now["x"] - before["x"], now["y"] - before["y"])
    assert moved_m == pytest.approx(now["speed"] / 15, rel=0.05)


def test_the_sample_is_the_same_at_every_call_and_holds_every_kind_of_place(race):
    one, two = (situations(race, sample(race, 500)).columns for _ in range(2))
    for key, column in one.items():
        np.testing.assert_array_equal(column, two[key])
    assert 0.05 < one["is_offtrack"].mean() < 0.4
    assert 0.4 < one["all_wheels_on_track"].mean() < 0.95
    assert set(one["speed"]) == set(race.actions.speed_mps)
    assert one["steps"].min() >= 2


def test_the_seam_names_the_closing_waypoint_and_its_repetition(race):
    (pair,) = seam(race).columns["closest_waypoints"].tolist()
    assert pair == [len(race.track.waypoints) - 1, 0]


def test_laps_are_complete_stay_on_the_road_and_are_the_faster_the_higher_the_speed(race, laps):
    assert len(laps) >= 2
    for lap in laps:
        columns = lap.paid.columns
        assert columns["progress"][-1] == 100
        assert (columns["progress"][:-1] < 100).all()
        assert columns["steps"][0] == 2
        assert columns["all_wheels_on_track"].all()
        assert columns["speed"].max() <= lap.speed_mps
        assert (np.diff(columns["steps"]) == 1).all()
    times = [lap.time_s for lap in laps]
    assert times == sorted(times, reverse=True)


def test_one_line_is_driven_at_several_shares_of_its_speeds(race, laps):
    highest = race.actions.high[1]
    assert [lap.speed_mps for lap in laps] == pytest.approx([share * highest for share in SHARES])
    assert laps[0].time_s > 1.2 * laps[1].time_s > 1.3 * laps[2].time_s
    assert all(lap.paid.columns["speed"].min() >= race.actions.low[1] for lap in laps)
    # No lap cuts what another drives around: they are as long, and a slow one nears no border more than the fast one.
    reach_m = [lap.paid.columns["distance_from_center"].max() for lap in laps]
    assert reach_m == sorted(reach_m)
    assert reach_m[-1] < race.track.width_m / 2


def test_a_single_action_gives_one_lap(race):
    action = DiscreteAction(steering_angle=0.0, speed=1.0)
    only = DiscreteActionSpace(kind="discrete", actions=(action,), file=None)
    (lap,) = action_space_laps(replace(race, actions=build_action_space(only)))
    assert lap.speed_mps == 1.0


def test_a_bend_taken_too_fast_gives_no_lap(race):
    assert drive_laps(race, [SimpleDriver(lateral_mps2=50.0)]) == [None]


def test_each_lap_with_a_flaw_has_that_flaw_and_is_no_faster_than_the_good_one(race, laps):
    good, flawed = laps[-1], flawed_laps(race, laps[-1])
    assert set(flawed) == {"zig-zag", "wide", "late braking"}

    def turns(lap):
        return (np.diff(np.sign(lap.paid.columns["steering_angle"])) != 0).sum()

    def steps_outside(lap):
        """Most bends turn to the left."""
        return (~lap.paid.columns["is_left_of_center"].astype(bool)).sum()

    def steps_at_both_extremes(lap):
        speed_mps = lap.paid.columns["speed"]
        return ((speed_mps == lap.speed_mps) | (speed_mps < 1.2)).sum()

    for flaw, measure in (
        ("zig-zag", turns),
        ("wide", steps_outside),
        ("late braking", steps_at_both_extremes),
    ):
        assert measure(flawed[flaw]) > 2 * measure(good)
    for lap in flawed.values():
        assert lap.time_s >= good.time_s
        assert lap.paid.columns["all_wheels_on_track"].all()
        assert lap.paid.columns["progress"][-1] == 100
