import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepracer_exp.evaluation.race_protocol import Attempt
from deepracer_exp.evaluation.results import Evaluation, TrialGroup


def attempt(trial=0, time_s=10.0, progress=100.0, end=None, **more):
    end = end or ("lap_complete" if progress == 100 else "off_track")
    given = {"begin_s": 0.0, "penalty_s": 0.0, "resets": 0, **more}
    return Attempt(trial=trial, time_s=time_s, progress=progress, end=end, **given)


def group(*attempts, track="a", condition="usual"):
    """Return attempts of as many trials as they name."""
    return TrialGroup(track, condition, tuple(sorted({a.trial for a in attempts})), attempts)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(0, 99), min_size=2, max_size=20))
def test_the_bootstrap_interval_holds_the_mean(progress):
    found = group(*(attempt(at, progress=value) for at, value in enumerate(progress))).statistics()
    low, high = found["completion"]["interval"]
    assert found["completion"]["mean"] == pytest.approx(np.mean(progress))
    assert low - 1e-9 <= found["completion"]["mean"] <= high + 1e-9


def test_one_trial_has_no_interval():
    found = group(attempt(0), attempt(0)).statistics()
    assert found["completion"] == {"mean": 100.0, "interval": None}


def test_laps_of_one_trial_are_no_independent_findings():
    times = np.arange(8.0, 16.0)
    each_alone = group(*(attempt(trial, time) for trial, time in enumerate(times))).statistics()
    in_pairs = group(*(attempt(trial // 4, time) for trial, time in enumerate(times))).statistics()
    assert each_alone["lap_time_s"]["mean"] == in_pairs["lap_time_s"]["mean"]
    width = [np.diff(found["lap_time_s"]["interval"])[0] for found in (each_alone, in_pairs)]
    assert width[1] > width[0]


def test_lap_times_are_those_of_complete_laps():
    found = group(
        attempt(0, 8.0), attempt(1, 10.0), attempt(2, 12.0), attempt(3, 1.0, progress=9)
    ).statistics()
    times = found["lap_time_s"]
    assert (times["mean"], times["median"], times["best"]) == (10.0, 10.0, 8.0)
    assert times["std"] == pytest.approx(np.std([8, 10, 12]))
    assert (found["laps"], found["laps_tried"]) == (3, 4)
    assert found["lap_share"]["mean"] == 0.75


def test_a_lap_cut_off_by_the_clock_is_no_failure():
    cut = attempt(0, 5.0, progress=40.0, end="time_up")
    assert group(attempt(0), cut).completion == 100.0
    assert group(cut).completion == 40.0


def test_the_race_score_is_the_time_per_lap_with_failed_laps():
    lap, failed = attempt(0, 10.0, penalty_s=2.0), attempt(0, 4.0, progress=50.0)
    assert group(lap, failed).race_score_s == 14.0
    assert group(failed).race_score_s is None


@pytest.mark.parametrize("metric", ["lap_time", "race_score"])
def test_times_fall_back_to_progress_where_no_lap_was_finished(metric):
    ranks = [
        group(*attempts).rank(metric)
        for attempts in (
            [attempt(progress=20.0)],
            [attempt(progress=70.0)],
            [attempt(time_s=30.0)],
            [attempt(time_s=9.0)],
        )
    ]
    assert ranks == sorted(ranks)
    assert len(set(ranks)) == 4


def test_failures_count_in_the_race_score_but_not_in_the_lap_time():
    wild = group(attempt(0, 8.0), attempt(1, 7.0, progress=90.0))
    safe = group(attempt(0, 9.0), attempt(1, 9.0))
    assert wild.rank("lap_time") > safe.rank("lap_time")
    assert wild.rank("race_score") < safe.rank("race_score")
    assert wild.rank("progress") < safe.rank("progress")


def test_progress_without_a_lap_ranks_below_the_same_with_one():
    assert group(attempt(progress=50.0)).rank("progress") == (50.0, 0.0)


def test_the_rank_is_that_of_all_conditions_together():
    held_out = group(attempt(1, 12.0, progress=50.0), condition="held_out")
    evaluation = Evaluation((group(attempt(0, 10.0)), held_out))
    assert evaluation.rank("progress") == (75.0, 0.1)
    assert evaluation.rank("lap_time") == (1.0, -10.0)
    assert evaluation.rank("race_score") == (1.0, -22.0)
    assert evaluation.race_score_s == 22.0
    assert evaluation.on("held_out").completion == 50.0


def test_there_is_no_race_score_without_a_lap_on_each_track():
    lap, failed = group(attempt(0, 10.0), track="a"), group(attempt(1, progress=50.0), track="b")
    assert Evaluation((lap,)).race_score_s == 10.0
    assert Evaluation((lap, failed)).race_score_s is None


def test_one_more_track_with_a_lap_is_worth_more_than_any_time():
    def on_two_tracks(first, second):
        return Evaluation((group(first, track="a"), group(second, track="b"))).rank("lap_time")

    short_only = on_two_tracks(attempt(time_s=5.0), attempt(progress=99.0))
    both_slow = on_two_tracks(attempt(time_s=9.0), attempt(time_s=60.0))
    both_fast = on_two_tracks(attempt(time_s=9.0), attempt(time_s=50.0))
    assert short_only < both_slow < both_fast


def lap_and_failures(time_s, laps, failures, track="a", condition="usual"):
    """Return a group with as many complete laps, and failures that drove half of it."""
    failed = [attempt(laps + at, 1.0, progress=50.0) for at in range(failures)]
    return group(*(attempt(at, time_s) for at in range(laps)), *failed, track=track, condition=condition)


def test_the_fastest_policy_of_those_that_complete_nineteen_of_twenty_usual_laps_is_the_best():
    ranks = [
        Evaluation((lap_and_failures(*one),)).rank("reliable_lap")
        for one in ((5.0, 0, 20), (4.0, 18, 2), (7.0, 19, 1), (6.0, 20, 0))
    ]
    assert ranks == sorted(ranks)
    assert ranks[-2:] == [(1.0, -7.0), (1.0, -6.0)]


def test_held_out_laps_do_not_count_for_the_reliable_lap():
    held_out = lap_and_failures(60.0, 1, 7, condition="held_out")
    evaluation = Evaluation((lap_and_failures(6.0, 8, 0), held_out))
    assert evaluation.rank("reliable_lap") == (1.0, -6.0)
    assert evaluation.rank("lap_time") == pytest.approx((1.0, -12.0))


def test_a_policy_is_reliable_if_it_is_on_each_track():
    def on_two_tracks(*laps):
        here, there = (lap_and_failures(*one, track=name) for one, name in zip(laps, "ab", strict=True))
        return Evaluation((here, there)).rank("reliable_lap")

    one_fails = on_two_tracks((4.0, 40, 0), (9.0, 7, 1))
    both = on_two_tracks((5.0, 8, 0), (15.0, 8, 0))
    assert one_fails < on_two_tracks((6.0, 8, 0), (16.0, 8, 0)) < both == (1.0, -10.0)
