"""Common mistakes in reward functions are warned of, and good functions are left alone."""

import numpy as np
import pytest

from deepracer_exp.validation import pitfalls
from deepracer_exp.validation.probe import Probe
from deepracer_exp.validation.reward_map import sample_reward_grid, state_of


def paying(expression: str) -> str:
    return f"def reward_function(params):\n    return {expression}\n"


CENTER = paying('max(0.0, 1.0 - params["distance_from_center"])')
LEFT_GRASS = paying('2.0 if params["is_offtrack"] and params["is_left_of_center"] else 1.0')
SPEED = paying('params["speed"]')
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
        (paying('params["distance_from_center"]'), ["pays more off the track than on it"]),
        (LEFT_GRASS, ["pays more off the track than on it: 2 per step", "m left of the centre line"]),
        (SPEED, ["pays as much off the track as on it: 2 per step"]),
        (CENTER, None),
        (paying("-1.0 * params['is_offtrack']"), None),
    ],
)
def test_reward_off_the_track_is_reported(race_with, text, words):
    race = race_with(text)
    grid = sample_reward_grid(race, state_of(race, Probe(race)), 0.25)
    found = list(pitfalls.pays_off_the_road(grid))
    assert len(found) == (words is not None)
    assert all(word in found[0] for word in words or ())


@pytest.mark.parametrize(
    ("text", "warned"),
    [
        (CENTER, True),
        (paying("1 - params['speed'] / 10"), True),
        (SPEED, False),
        (DELTA, False),
        (paying('params["progress"] / params["steps"]'), False),
        (paying("1 / params['speed']"), False),  # it cannot take a standing car
    ],
)
def test_reward_for_standing_is_reported(race_with, laps, text, warned):
    found = list(pitfalls.pays_for_standing(race_with(text), laps))
    assert [line.startswith("pays for standing still: ") for line in found] == [True] * warned


@pytest.mark.parametrize(
    ("text", "warned"),
    [
        (CENTER, True),
        (paying("1 / params['speed']"), True),
        (paying('100.0 if params["progress"] == 100 else -1.0'), False),
        (DELTA, False),
        (paying("params['speed'] ** 2"), False),
    ],
)
def test_more_reward_for_a_slow_lap_is_reported_with_both_times(race_with, laps, text, warned):
    race = race_with(text)
    found = list(pitfalls.pays_for_slowness(race, laps))
    assert len(found) == warned
    for line in found:
        assert "pays more for a slow lap than for a fast one: " in line
        assert f"in {laps[0].time_s:.1f} s" in line
        assert f"in {laps[-1].time_s:.1f} s" in line
    assert not list(pitfalls.pays_for_slowness(race, laps[:1]))


def test_only_a_constant_reward_is_reported_as_constant():
    assert list(pitfalls.constant_reward(np.full(9, 3.0))) == [
        "always returns 3, whatever the car does: there is nothing to learn"
    ]
    assert not list(pitfalls.constant_reward(np.r_[np.full(9, 3.0), 3.1]))


@pytest.mark.parametrize(("factor", "warned"), [("1", False), ("2", True)])
def test_a_reward_batch_that_pays_otherwise_is_reported(race_with, laps, factor, warned):
    batch = f'\n\ndef reward_batch(params):\n    return {factor} * params["speed"]\n'
    race, sampled = race_with(SPEED + batch), laps[0].paid
    found = list(pitfalls.batch_differs(race, sampled, sampled.columns["speed"]))
    assert [f"in {len(sampled)} of {len(sampled)}" in line for line in found] == [True] * warned
