"""Common mistakes in reward functions are warned of, and good functions are left alone."""

import numpy as np
import pytest

from deepracer_exp.commands.validation import pitfalls
from deepracer_exp.commands.validation.probe import Probe
from deepracer_exp.commands.validation.reward_map import sample_reward_grid, state_of
from deepracer_exp.commands.validation.simple_driver import flawed_laps


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
        (paying('params["distance_from_center"]'), ["returns more off the track than on it"]),
        (LEFT_GRASS, ["returns more off the track than on it: 2 per step", "m left of the centre line"]),
        (SPEED, ["returns as much off the track as on it: 2 per step"]),
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
    assert [line.startswith("rewards standing still: ") for line in found] == [True] * warned


MORE, AS_MUCH = (
    "returns more for a slow lap than for a fast one: ",
    ": nothing asks for speed except the discount (",
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (CENTER, [MORE, "; the discount does not make up for it (0.99 a step: "]),
        (paying("1 / params['speed']"), [MORE]),
        (SPEED, [AS_MUCH]),
        (DELTA, [AS_MUCH]),
        (DELTA.replace("0.01", "0.05"), [": little asks for speed except the discount (0.99 a step: "]),
        (DELTA.replace("0.01", "0.3"), None),
        (paying('100.0 if params["progress"] == 100 else -1.0'), None),
        (paying("params['speed'] ** 2"), None),
    ],
)
def test_a_slow_lap_that_returns_as_much_is_reported_with_both_times_and_returns(
    race_with, laps, text, words
):
    returns = pitfalls.lap_returns(race_with(text), laps, 0.99)
    found = list(pitfalls.slow_laps_return_as_much(returns, 0.99))
    assert len(found) == (words is not None)
    for line in found:
        assert all(word in line for word in words)
        assert f"in {laps[-1].time_s:.1f} s" in line
        assert f"{returns[-1].total:.4g}" in line
    assert not list(pitfalls.slow_laps_return_as_much(returns[:1], 0.99))


def test_the_speeds_of_a_lap_add_up_to_its_length_however_long_it_takes(race, race_with, laps):
    returns = pitfalls.lap_returns(race_with(SPEED), laps, 0.99)
    metres = [lap.total * race.car.control_period_s for lap in returns]
    assert metres == pytest.approx([race.track.length_m] * 3, rel=0.05)
    assert [lap.time_s for lap in returns] == [lap.time_s for lap in laps]
    assert returns[0].discounted < 0.8 * returns[-1].discounted


@pytest.mark.parametrize(
    ("slow", "fast", "discount", "words"),
    [
        ((100.0, 50.0), (100.0, 60.0), 0.99, AS_MUCH),
        ((100.0, 50.0), (100.0, 50.0), 0.99, ": nothing asks for speed, and the discount does not either ("),
        ((100.0, 100.0), (100.0, 100.0), 1.0, ": nothing asks for speed, and the discount does not either ("),
        ((100.0, 60.0), (104.0, 80.0), 0.99, ": little asks for speed except the discount ("),
        ((100.0, 60.0), (80.0, 70.0), 0.99, "; only the discount asks for speed ("),
        (
            (-100.0, -60.0),
            (-101.0, -70.0),
            0.99,
            ": nothing asks for speed, and the discount does not either (",
        ),
        ((-100.0, -60.0), (-50.0, -40.0), 0.99, None),
        ((100.0, 60.0), (140.0, 40.0), 0.99, None),
    ],
)
def test_the_discount_is_said_to_ask_for_speed_only_where_it_does(slow, fast, discount, words):
    laps = [pitfalls.LapReturn(10.0, *slow), pitfalls.LapReturn(7.0, *fast)]
    found = list(pitfalls.slow_laps_return_as_much(laps, discount))
    assert [words in line for line in found] == [True] * (words is not None)


def test_laps_of_almost_the_same_time_are_not_compared():
    laps = [pitfalls.LapReturn(10.0, 100.0, 50.0), pitfalls.LapReturn(9.5, 50.0, 20.0)]
    assert not list(pitfalls.slow_laps_return_as_much(laps, 0.99))


@pytest.fixture(scope="module")
def flawed(race, laps):
    return flawed_laps(race, laps[-1])


@pytest.mark.parametrize(
    ("text", "preferred"),
    [
        (paying("float(abs(params['steering_angle']) > 15) - 0.5"), {"zig-zag", "late braking"}),
        (
            paying("0.0 if params['is_left_of_center'] else params['distance_from_center']"),
            {"zig-zag", "wide"},
        ),
        (paying("float(params['speed'] == 3.0)"), {"late braking"}),
        (CENTER, {"zig-zag", "wide", "late braking"}),
        (DELTA.replace("0.01", "0.3"), set()),
    ],
)
def test_laps_with_a_flaw_are_named_where_they_return_more_than_the_good_one(
    race_with, laps, flawed, text, preferred
):
    good, *returns = pitfalls.lap_returns(race_with(text), [laps[-1], *flawed.values()], 0.99)
    found = list(pitfalls.flaws_return_more(good, dict(zip(flawed, returns, strict=True))))
    assert len(found) == bool(preferred)
    assert {name for name in flawed if any(f" {name} (" in line for line in found)} == preferred


def test_a_flaw_that_only_the_discount_forbids_is_said_to_be_one():
    good, wide = pitfalls.LapReturn(7.0, 100.0, 60.0), pitfalls.LapReturn(8.0, 110.0, 55.0)
    (line,) = pitfalls.flaws_return_more(good, {"wide": wide})
    assert line.endswith("a good one (100 in 7.0 s): wide (110 in 8.0 s; not with the discount)")
    assert not list(pitfalls.flaws_return_more(good, {"wide": good}))


def test_only_a_constant_reward_is_reported_as_constant():
    assert list(pitfalls.constant_reward(np.full(9, 3.0))) == [
        "always returns 3, whatever the car does: there is nothing to learn"
    ]
    assert not list(pitfalls.constant_reward(np.r_[np.full(9, 3.0), 3.1]))


@pytest.mark.parametrize(("factor", "warned"), [("1", False), ("2", True)])
def test_a_reward_batch_that_pays_otherwise_is_reported(race_with, factor, warned):
    batch = f'\n\ndef reward_batch(params):\n    return {factor} * params["speed"]\n'
    found = list(pitfalls.batch_differs(race_with(SPEED + batch), 50))
    assert ["in 50 of 50" in line for line in found] == [True] * warned


@pytest.mark.parametrize(("before", "warned"), [("previous_progress", False), ("progress", True)])
def test_a_batch_has_what_the_function_remembers(race_with, before, warned):
    memory = """
last = 0.0
def reward_function(params):
    global last
    gained, last = params["progress"] - last, params["progress"]
    return gained
"""
    batch = f'\n\ndef reward_batch(params):\n    return params["progress"] - params["{before}"]\n'
    assert bool(list(pitfalls.batch_differs(race_with(memory + batch), 50))) == warned
