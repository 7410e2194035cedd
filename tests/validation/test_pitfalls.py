import numpy as np
import pytest

from deepracer_exp.validation import pitfalls
from deepracer_exp.validation.reward_grid import sample_reward_grid

CENTER = """\
def reward_function(params):
    return max(0.0, 1.0 - params["distance_from_center"])
"""
EDGE = """\
def reward_function(params):
    return params["distance_from_center"]
"""
LEFT_GRASS = """\
def reward_function(params):
    return 2.0 if params["is_offtrack"] and params["is_left_of_center"] else 1.0
"""
SPEED = """\
def reward_function(params):
    return params["speed"]
"""
PROGRESS_PER_STEP = """\
def reward_function(params):
    return params["progress"] / params["steps"]
"""
TIME = """\
def reward_function(params):
    return 100.0 if params["progress"] == 100 else -1.0
"""
DELTA = """\
last = {"progress": 0.0, "steps": 0.0}


def reward_function(params):
    gained = params["progress"] - last["progress"] if params["steps"] == last["steps"] + 1 else 0.0
    last["progress"], last["steps"] = params["progress"], params["steps"]
    return gained - 0.01
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (EDGE, "pays more off the track than on it"),
        (LEFT_GRASS, "pays more off the track than on it: 2 per step"),
        (SPEED, "pays as much off the track as on it: 2 per step"),
    ],
)
def test_reward_off_the_track_is_reported(race_with, surveyor_of, text, words):
    race = race_with(text)
    (told,) = pitfalls.pays_off_the_road(sample_reward_grid(race, surveyor_of(race), 0.25))
    assert words in told


def test_the_side_that_pays_is_named(race_with, surveyor_of):
    race = race_with(LEFT_GRASS)
    (told,) = pitfalls.pays_off_the_road(sample_reward_grid(race, surveyor_of(race), 0.25))
    assert "m left of the centre line" in told


@pytest.mark.parametrize(
    "text", [CENTER, "def reward_function(params):\n    return -1.0 * params['is_offtrack']\n"]
)
def test_a_function_that_prefers_the_road_is_left_alone(race_with, surveyor_of, text):
    race = race_with(text)
    assert not list(pitfalls.pays_off_the_road(sample_reward_grid(race, surveyor_of(race), 0.25)))


@pytest.mark.parametrize(
    "text", [CENTER, "def reward_function(params):\n    return 1 - params['speed'] / 10\n"]
)
def test_pay_for_standing_is_told(race_with, laps, text):
    (told,) = pitfalls.pays_for_standing(race_with(text), laps)
    assert told.startswith("pays for standing still: ")


@pytest.mark.parametrize("text", [SPEED, DELTA, PROGRESS_PER_STEP])
def test_less_pay_for_standing_than_for_driving_is_not(race_with, laps, text):
    assert not list(pitfalls.pays_for_standing(race_with(text), laps))


def test_a_function_that_cannot_take_a_standing_car_is_not_accused(race_with, laps):
    divides = "def reward_function(params):\n    return 1 / params['speed']\n"
    assert not list(pitfalls.pays_for_standing(race_with(divides), laps))


@pytest.mark.parametrize("text", [CENTER, "def reward_function(params):\n    return 1 / params['speed']\n"])
def test_more_pay_for_a_slow_lap_is_told_with_both_times(race_with, laps, text):
    (told,) = pitfalls.pays_for_slowness(race_with(text), laps)
    assert "pays more for a slow lap than for a fast one: " in told
    assert f"in {laps[0].time_s:.1f} s" in told
    assert f"in {laps[-1].time_s:.1f} s" in told


@pytest.mark.parametrize(
    "text", [TIME, DELTA, "def reward_function(params):\n    return params['speed'] ** 2\n"]
)
def test_more_pay_for_a_fast_lap_is_not(race_with, laps, text):
    assert not list(pitfalls.pays_for_slowness(race_with(text), laps))


def test_one_lap_alone_is_not_compared(race_with, laps):
    assert not list(pitfalls.pays_for_slowness(race_with(CENTER), laps[:1]))
    assert not list(pitfalls.pays_for_slowness(race_with(CENTER), []))


def test_only_a_constant_reward_is_reported_as_constant():
    assert list(pitfalls.constant_reward(np.full(9, 3.0))) == [
        "always returns 3, whatever the car does: there is nothing to learn"
    ]
    assert not list(pitfalls.constant_reward(np.r_[np.full(9, 3.0), 3.1]))


@pytest.mark.parametrize(("factor", "warned"), [("1", False), ("2", True)])
def test_a_reward_batch_that_pays_otherwise_is_told(race_with, laps, factor, warned):
    batch = f'\n\ndef reward_batch(params):\n    return {factor} * params["speed"]\n'
    race, sampled = race_with(SPEED + batch), laps[0].paid
    told = list(pitfalls.batch_differs(race, sampled, sampled.columns["speed"]))
    assert bool(told) == warned
    if told:
        assert f"in {len(sampled)} of {len(sampled)}" in told[0]
