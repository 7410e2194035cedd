"""Action spaces proposed from laps: which laps count, which actions are chosen, and what is added to recover with."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from deepracer_exp.config.bounds import FEWEST_ACTIONS
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.reports.charts.action_charts import proposed_actions_picture
from deepracer_exp.reports.tables.proposed_actions import (
    DEGREES_PER_MPS,
    NEAR,
    Commands,
    commands_of_log,
    fast_laps,
    propose_actions,
)
from tests.conftest import refused

from .made_up import Drive, made_up_recording

FAST, NEARLY, SLOW = Drive(speed_mps=2.0), Drive(speed_mps=1.95), Drive(speed_mps=1.5)
HASTY, OFF = Drive(speed_mps=3.0, until=0.5), Drive(speed_mps=3.0, off_at=40)
SCALE = np.array([DEGREES_PER_MPS, 1.0])


@pytest.fixture(scope="module")
def car():
    return compose_experiment([])[0].car


def commands(steering_deg, speed_mps) -> Commands:
    return Commands(
        laps="made up", steering_deg=np.array(steering_deg, float), speed_mps=np.array(speed_mps, float)
    )


def test_only_complete_laps_near_the_fastest_count():
    np.testing.assert_array_equal(
        fast_laps([np.nan, 10.0, 10.49, 10.51, 30.0]), [False, True, True, False, False]
    )
    assert not fast_laps([np.nan, np.nan]).any()


def test_slow_laps_and_attempts_that_failed_are_not_commands_to_choose_from():
    found = commands_of_log(made_up_recording([HASTY, SLOW, FAST, OFF, NEARLY]))
    assert set(found.speed_mps.tolist()) == {2.0, 1.95}
    assert found.laps.startswith("2 of 3 complete laps without a reset on reinvent_base")
    assert f"{FAST.lap_time_s():.2f} s" in found.laps


def test_laps_of_an_evaluation_count_beside_those_of_the_training():
    faster = Drive(speed_mps=2.5)
    raced = {"evaluation-1": [faster, Drive(speed_mps=1.0)]}
    found = commands_of_log(made_up_recording([FAST, SLOW], evaluations=raced))
    assert set(found.speed_mps.tolist()) == {2.5}
    assert "1 of the evaluations and races" in found.laps
    assert "training" not in found.laps


def test_without_a_complete_lap_nothing_is_proposed():
    assert "no complete lap" in refused(commands_of_log, made_up_recording([HASTY, OFF]))


def test_groups_of_commands_become_actions(car):
    centers = np.array([(-12.0, 2.5), (0.0, 3.0), (0.0, 3.8), (6.0, 3.4), (20.0, 2.0)])
    near = np.random.default_rng(1).normal(0.0, [0.2, 0.02], (200, 5, 2))
    points = (centers + near).reshape(-1, 2)
    # At most five are added.
    proposal = propose_actions(commands(*points.T), 10, car)
    chosen = np.array(proposal.actions)[~np.array(proposal.to_recover)]
    assert cdist(centers / SCALE, chosen / SCALE).min(axis=1).max() < 0.05
    assert proposal.shares.sum() == pytest.approx(1.0)
    degrees, mps = proposal.mean_deviation
    assert degrees < 0.5
    assert mps < 0.05


def test_ten_degrees_count_as_much_as_a_metre_per_second(car):
    """Of two pairs of groups, those that are closer in this measure share an action."""
    to_recover = [(-30.0, 1.2), (0.0, 1.2), (30.0, 1.2), (-10.0, 2.0), (10.0, 2.0)]
    steered, faster = [(-16.0, 3.0), (-8.0, 3.0)], [(20.0, 3.0), (20.0, 3.5)]
    proposal = propose_actions(commands(*np.repeat([*to_recover, *steered, *faster], 50, axis=0).T), 8, car)
    assert not any(proposal.to_recover)
    assert {tuple(action) for action in proposal.actions} == {*to_recover, *steered, (20.0, 3.25)}


def test_a_list_that_suffices_is_kept_as_it_is(car):
    listed = [(-30.0, 1.0), (-10.0, 1.5), (0.0, 1.0), (0.0, 2.0), (10.0, 1.5), (30.0, 1.0)]
    proposal = propose_actions(commands(*np.repeat(listed, 7, axis=0).T), 12, car)
    assert [tuple(action) for action in proposal.actions] == listed
    assert proposal.mean_deviation == (0.0, 0.0)


@given(
    st.lists(st.tuples(st.floats(-45, 45), st.floats(0, 5)), min_size=1, max_size=60),
    st.integers(FEWEST_ACTIONS, 20),
)
def test_whatever_the_laps_command_the_car_can_turn_brake_and_correct(car, points, wanted):
    driven = commands(*np.array(points).T).within(car)
    proposal = propose_actions(driven, wanted, car)
    listed = np.array(proposal.actions)
    assert len(listed) <= wanted
    assert len(np.unique(listed, axis=0)) == len(listed)
    assert np.abs(listed[:, 0]).max() <= car.max_steering_deg
    assert car.min_speed_mps <= listed[:, 1].min() <= listed[:, 1].max() <= car.max_speed_mps
    slow, usual = min(np.percentile(driven.speed_mps, 1), 1.3), np.median(driven.speed_mps)
    needed = np.array([(-30, slow), (0, slow), (30, slow), (-10, usual), (10, usual)])
    # An action may be rounded by half a step.
    assert cdist(needed / SCALE, listed / SCALE).min(axis=1).max() < NEAR + 0.06


def test_laps_that_turn_left_only_leave_a_way_to_the_right(car):
    steering_deg = np.linspace(0.0, 18.0, 300)
    proposal = propose_actions(commands(steering_deg, np.full(300, 2.2)), 12, car)
    added = [
        tuple(action)
        for action, recovers in zip(proposal.actions, proposal.to_recover, strict=True)
        if recovers
    ]
    assert added == [(-30.0, 1.3), (-10.0, 2.2), (0.0, 1.3), (30.0, 1.3)]
    assert len(proposal.actions) == 12
    assert proposed_actions_picture("left", proposal).startswith(b"\x89PNG")


@pytest.mark.parametrize("wanted", [FEWEST_ACTIONS - 1, 101])
def test_too_few_or_too_many_actions_are_refused(car, wanted):
    assert f"--count {wanted}" in refused(propose_actions, commands([0], [1]), wanted, car)


def test_a_real_training_has_its_fast_laps_and_its_list_of_actions(car, reference):
    from deepracer_exp.aws.logs.reader import read_recording

    recording = read_recording(reference / "race_pace" / "droa_v6_fast.tar.gz")
    found = commands_of_log(recording)
    proposal = propose_actions(found.within(car), 30, car)
    taken = {(round(a, 1), round(v, 2)) for a, v in zip(found.steering_deg, found.speed_mps, strict=True)}
    chosen = {
        (action.steering_deg, action.speed_mps)
        for action, recovers in zip(proposal.actions, proposal.to_recover, strict=True)
        if not recovers
    }
    assert chosen == taken
