import numpy as np
import pytest

from deepracer_exp.env.trace_columns import STATUS_CODE
from deepracer_exp.evaluation.race_protocol import RaceProtocol

STEP_S = 0.5
PENALTY_S = {"off_track": 2.0, "reversed": 2.0, "immobilized": 0.0}
"""The service's own (deepracer-simapp, rollout_agent_ctrl.py), where a job sets no REVERSE_ or IMMOBILIZED_PENALTY."""


def drive(config, story, closed=True):
    """Let one car live through (status, progress) pairs; return the race and where it was put back."""
    race = RaceProtocol(config, np.array([closed]), STEP_S)
    backs = []
    for status, progress in story:
        if not race.running[0]:
            break
        back = race.step(np.array([STATUS_CODE[status]]), np.array([float(progress)]))
        backs += back.percent.tolist()
    return race, backs


def steady(*progress):
    return [("in_progress", percent) for percent in progress]


OFF, DONE = ("off_track", 60), ("lap_complete", 100)


def test_three_trials_ends_at_the_first_off_track(protocol):
    race, backs = drive(protocol("three_trials"), [*steady(0, 20, 40), OFF, *steady(41, 42)])
    (attempt,) = race.attempts
    assert not race.running[0]
    assert backs == []
    assert (attempt.end, attempt.progress, attempt.time_s) == ("off_track", 60, 4 * STEP_S)


def test_three_trials_ends_with_the_lap(protocol):
    race, _ = drive(protocol("three_trials"), [*steady(0, 50), DONE, *steady(1)])
    (attempt,) = race.attempts
    assert attempt.complete
    assert attempt.time_s == 3 * STEP_S
    assert not race.running[0]


@pytest.mark.parametrize(("time_s", "laps"), [(3.5, 2), (3.49, 1), (4.9, 2), (5.0, 3)])
def test_four_minutes_counts_only_laps_that_fit(protocol, time_s, laps):
    lap = [*steady(30, 60), DONE]
    race, _ = drive(protocol("four_minutes", time_s=time_s), [("prepare", 0), *lap * 5])
    assert sum(attempt.complete for attempt in race.attempts) == laps
    assert race.attempts[-1].end == "time_up"
    # The clock starts with the reset, one step before the prepare step.
    assert [attempt.time_s for attempt in race.attempts[:-1]] == [4 * STEP_S, *[3 * STEP_S] * (laps - 1)]
    assert sum(attempt.time_s for attempt in race.attempts) == pytest.approx(time_s)


def test_in_four_minutes_a_lap_that_leaves_the_track_restarts(protocol):
    race, backs = drive(protocol("four_minutes"), [*steady(0, 40), OFF, *steady(0, 50), DONE])
    assert backs == [0]
    assert [attempt.end for attempt in race.attempts] == ["off_track", "lap_complete"]
    assert race.running[0]


def test_summit_puts_the_car_back_at_its_last_progress_at_most_three_times_a_lap(protocol):
    lap = [*steady(10), *[OFF, *steady(11)] * 4, *steady(50), DONE]
    race, backs = drive(protocol("summit"), [*lap, *lap])
    # Twice the same lap: three resets, then the fourth fault fails it, and the next three are allowed again.
    assert backs == [10, 11, 11, 0] * 2
    assert [(a.end, a.resets) for a in race.attempts] == [("off_track", 3), ("lap_complete", 0)] * 2


def test_a_car_is_never_put_back_where_it_left_the_track(protocol):
    _, backs = drive(protocol("summit"), [*steady(10), ("off_track", 80)])
    assert backs == [10]


def test_penalties_add_to_the_lap_and_to_the_race(protocol):
    faults = ["off_track", "reversed", "immobilized"]
    story = [*steady(0)]
    for fault in faults:
        story += [(fault, 20), *steady(20)]
    race, _ = drive(protocol("aws_virtual"), [*story, DONE, *steady(50), DONE])
    first, second = race.attempts
    assert first.penalty_s == sum(PENALTY_S[fault] for fault in faults)
    assert first.time_s == 8 * STEP_S + first.penalty_s
    assert first.resets == 3
    assert (second.penalty_s, second.time_s, second.begin_s) == (0, 2 * STEP_S, first.time_s)


def test_a_penalty_can_use_up_the_race(protocol):
    config = protocol("aws_virtual", time_s=3.0)
    race, _ = drive(config, [*steady(0, 10), OFF, *steady(10, 20, 30), OFF, *steady(30)])
    assert race.attempts[-1].end == "time_up"
    assert race.clock_s[0] == 3.0


def test_the_virtual_race_ends_after_three_laps(protocol):
    race, backs = drive(protocol("aws_virtual"), [*steady(50), DONE] * 5)
    assert len(race.attempts) == 3
    assert backs == []


def test_after_a_lap_of_an_open_course_the_car_is_put_at_its_start(protocol):
    _, backs = drive(protocol("four_minutes"), [*steady(50), DONE, *steady(1)], closed=False)
    assert backs == [0]


def test_the_penalties_of_the_virtual_race_are_those_of_the_service(protocol):
    penalty = protocol("aws_virtual").penalty_s
    assert {name: getattr(penalty, name) for name in PENALTY_S} == PENALTY_S


def test_among_others_a_penalty_passes_in_simulated_time(protocol):
    config = protocol("object_avoidance")
    race = RaceProtocol(config, np.array([True]), STEP_S, among_others=True)

    def step(status, progress):
        return race.step(np.array([STATUS_CODE[status]]), np.array([float(progress)]))

    step("in_progress", 10)
    back = step("crashed", 20)
    assert (back.cars.tolist(), back.crashed.tolist(), back.restarts.tolist()) == ([0], [True], [False])
    assert back.hold_s.tolist() == [config.penalty_s.crashed] == [5.0]
    for _ in range(10):
        assert not len(step("pause", 15).cars)
    step("lap_complete", 100)
    (attempt,) = race.attempts
    assert attempt.complete
    assert not attempt.crash_free
    assert (attempt.crashes, attempt.resets, attempt.penalty_s) == (1, 1, 5.0)
    # Thirteen steps, ten of them the penalty; nothing is added to the clock.
    assert attempt.time_s == 13 * STEP_S
