"""Where two sets of laps differ, known by construction."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.analysis.log_view import prepare_races
from deepracer_exp.errors import BadInput
from deepracer_exp.reports.against_log import (
    AgainstLog,
    actions_compared,
    along_the_track,
    laps_on,
    lines_compared,
    logged_laps,
)
from tests.analysis.chart_layers import drawn
from tests.analysis.made_up import Drive, made_up_course, made_up_recording


def compared(logged: list[Drive], simulated: list[Drive]) -> AgainstLog:
    course = made_up_course()
    laps = [laps_on(course, made_up_recording(drives).steps, "laps") for drives in (logged, simulated)]
    return AgainstLog(course=course, logged=laps[0], simulated=laps[1])


def test_they_differ_where_the_speed_differs_and_the_time_is_lost_there():
    both = compared([Drive(), Drive()], [Drive(sections=((0.4, 0.5, 1.0),))] * 2)
    one = both.stretch
    assert abs(one.begin - 40) <= 1
    assert abs(one.end - 50) <= 1
    assert one.speed_mps == pytest.approx(-0.5, abs=0.06)
    assert abs(one.offset_m) < 0.01
    waypoints = len(both.course.waypoints) - 1
    assert abs(one.first_waypoint - 0.4 * waypoints) < 4
    assert one.sector in both.sentences[-1]
    assert f"from {one.begin} to {one.end}% of the track" in both.sentences[-1]
    slower_s = both.course.length_m * 0.1 * (1 / 1.0 - 1 / 1.5)
    table = both.table.set_index("name")
    assert table.loc["median lap, s", "difference"] == pytest.approx(slower_s, abs=0.02)
    lost = along_the_track(both).table
    lost = lost[(lost["panel"] == "Time the simulated laps lose to the logged ones")].set_index("x")["y"]
    assert lost.loc[39] == pytest.approx(0.0, abs=0.02)
    assert lost.loc[51] == pytest.approx(slower_s, abs=0.02)


def test_a_line_beside_the_other_is_as_far_from_it_as_it_was_driven():
    both = compared([Drive(start=0.3, offset_m=-0.1)], [Drive(offset_m=0.15)])
    assert both.stretch.offset_m == pytest.approx(0.25, abs=0.02)
    assert "The lines are 0.25 m apart on average" in both.sentences[1]
    assert "further left" in both.sentences[-1]


def test_actions_of_the_same_list_are_compared_one_by_one_and_others_in_ranges():
    same = compared([Drive()], [Drive()])
    assert [name for name in same.table["name"] if name.startswith("action ")] == [
        "action right 20° 1.5 m/s, %",
        "action straight 1.5 m/s, %",
        "action left 20° 1.5 m/s, %",
    ]
    assert same.action_shares[0].sum() == pytest.approx(100.0)
    assert same.table["difference"].abs().max() == 0.0
    other = compared([Drive()], [Drive(speed_mps=2.0)])
    assert other.actions.continuous
    assert "different lists" in actions_compared(other).caption


def test_a_training_without_a_lap_and_without_an_evaluation_has_nothing_to_compare():
    view = prepare_races(made_up_recording([Drive(until=0.5), Drive(off_at=40)]))
    with pytest.raises(BadInput, match="has no evaluation, and its training no complete lap"):
        logged_laps(view, made_up_course())


@pytest.mark.parametrize("evaluations", [{}, {"evaluation-1": [Drive(), Drive()]}])
@pytest.mark.parametrize("column", ["episode_status", "obstacle_crash_counter"])
def test_laps_driven_among_bots_say_that_the_simulated_car_is_alone(evaluations, column):
    recording = made_up_recording([Drive(), Drive()], evaluations=evaluations)
    course, alone = made_up_course(), "the simulated car drives alone"
    assert alone not in logged_laps(prepare_races(recording), course).words
    steps = recording.steps
    crash = pd.Series(["crashed" if column == "episode_status" else 1.0] * len(steps))
    last = np.arange(len(steps)) == len(steps) - 5
    met = steps.assign(**{column: steps[column].astype(crash.dtype).mask(last, crash)})
    assert logged_laps(prepare_races(replace(recording, steps=met)), course).words.endswith(alone)


@pytest.mark.parametrize("until", [1.0, 0.3, 0.02])
def test_every_chart_is_drawn_however_far_the_laps_go(until):
    both = compared([Drive(), Drive(start=0.5)], [Drive(until=until)])
    for draw_one in (lines_compared, along_the_track, actions_compared):
        assert drawn(draw_one(both)).data
    assert all(sentence.endswith(".") for sentence in both.sentences)
    assert (both.stretch is None) == (until < 0.1)
    assert ("The simulated car completes no lap." in both.sentences) == (until < 1)
