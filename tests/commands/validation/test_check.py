import re
import time

import pytest

from deepracer_exp.commands.validation import validate as checking
from deepracer_exp.commands.validation.probe import NOT_CALLED, Probe, lines_for_step_1
from deepracer_exp.commands.validation.reward_map import state_of
from deepracer_exp.errors import BadInput


def function(body: str, before: str = "") -> str:
    return f"{before}def reward_function(params):\n    " + body.replace("\n", "\n    ") + "\n"


pytestmark = pytest.mark.processes

DELTA = """\
last = {"progress": 0.0, "steps": 0.0}
def reward_function(params):
    gained = params["progress"] - last["progress"] if params["steps"] == last["steps"] + 1 else 0.0
    last["progress"], last["steps"] = params["progress"], params["steps"]
    return gained
"""
GOOD = function(
    'pace = params["progress"] / params["steps"]\nreturn params["speed"] * pace**2 - 5.0 * params["is_offtrack"]'
)


def test_a_good_function_gets_no_warning(check_of):
    check = check_of(GOOD)
    assert check.failures == []
    assert check.warnings == []
    assert check.tried["off the track"].reward < 0 < check.tried["mid-lap"].reward
    assert check.lowest < 0 < check.highest
    assert [lap.total for lap in check.laps] == sorted(lap.total for lap in check.laps)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('return 1 / (params["progress"] != 100)', "raised ZeroDivisionError: division by zero in line 2 of"),
        (
            "x = 1\nif params['is_offtrack']:\n    x = params['nothing']\nreturn x",
            "raised KeyError: 'nothing' in line 4",
        ),
        ("exit(1)", "raised SystemExit: 1 in line 2"),
        ("pass", "line 2 returned None; accepted: a finite number"),
        ("x = 1j\nreturn x", "line 3 returned 1j; accepted: a finite number"),
        ('return float("nan")', "line 2 returned nan; accepted: a finite number"),
        ("return 100001", "line 2 returned 100001; accepted: a finite number from -100000 to 100000"),
        ('return "1"', "line 2 returned '1'; accepted: a finite number"),
    ],
)
def test_what_would_end_a_training_is_reported_with_its_line(check_of, body, words):
    check = check_of(function(body))
    assert words in check.failures[0]
    assert check.warnings == []


def test_a_failure_in_one_situation_names_it(check_of):
    (failure,) = check_of(function('return 1 / (not params["is_offtrack"])')).failures
    assert failure.endswith(", at off the track")


def test_a_failure_outside_the_named_situations_is_found_and_described(check_of):
    (failure,) = check_of(function('return 1 / (params["steering_angle"] < 25)')).failures
    assert "raised ZeroDivisionError" in failure
    assert "steering 30" in failure
    assert "situations)" in failure


def test_no_more_situations_fail_than_are_tried(check_of):
    (failure,) = check_of(
        function('return 1 / (params["steering_angle"] == 0 and params["speed"] == 2)')
    ).failures
    failed, tried = re.search(r"\((\d+) of (\d+) situations\)$", failure).groups()
    assert 0.8 * int(tried) < int(failed) < int(tried)


def test_a_function_that_hangs_is_called_once(check_of):
    check = check_of(function("while True:\n    pass"), time_limit_s=0.3)
    (failure,) = check.failures
    assert "took longer than the time limit of 0.3 s" in failure
    assert [answer.failure == NOT_CALLED for answer in check.tried.values()] == [False, *[True] * 5]


def test_whatever_aws_turns_into_a_float_is_fine(check_of):
    values = '[numpy.float32(1.5), numpy.array(1.5), True, 3][int(params["x"] * 100) % 4]'
    assert check_of(function(f"return {values}", "import numpy\n")).failures == []


def test_prints_and_changed_params_do_no_harm(check_of, capsys):
    check = check_of(
        function(
            'print(params["x"])\nparams["waypoints"].clear()\nparams["steps"] = 0\nreturn params["speed"]'
        )
    )
    assert check.failures == []
    assert capsys.readouterr().out == ""
    cleared = 'if params["steering_angle"] == 30:\n    params.clear()\n    return None\nreturn 1.0'
    (failure,) = check_of(function(cleared)).failures
    assert "line 4 returned None" in failure
    assert "steering 30 (" in failure


def test_branches_that_are_never_taken_are_reported_with_their_lines(check_of):
    loop = 'for d in params["objects_distance"]:\n    if d < 0:\n        r -= d'
    body = f'r = params["speed"]\nif r > 100:\n    r = 7\n    r += 1\n{loop}\nreturn r'
    found = [line for line in check_of(function(body)).warnings if "never reaches" in line]
    # Two boxes and a bot stand on the road for a function that reads of them, four more situations each.
    assert "lines 4 to 5 in 414 situations: r = 7" in found[0]
    assert "line 8" in found[1]


CONDITIONS = [
    'params["steps"] == 2',
    'params["progress"] == 100',
    'params["is_offtrack"]',
    'not params["all_wheels_on_track"]',
    'params["is_reversed"]',
    'params["is_left_of_center"]',
    'params["closest_waypoints"][1] == 0',
    'params["speed"] >= 3',
    'abs(params["steering_angle"]) > 25',
]


def test_what_happens_in_a_training_is_no_unreachable_branch(check_of):
    branches = "".join(f"if {condition}:\n    r += {i}\n" for i, condition in enumerate(CONDITIONS))
    found = check_of(function(f'r = params["speed"]\n{branches}return r')).warnings
    assert not any("never reaches" in line for line in found)


def test_a_constant_reward_is_reported_in_one_line(check_of):
    (found,) = check_of(function("return 1.0")).warnings
    assert "always returns 1, whatever the car does" in found


def test_a_reward_for_the_finish_alone_is_not_constant_and_belongs_to_the_range(check_of):
    check = check_of(function('return 100.0 if params["progress"] == 100 else -1.0'))
    assert not any("always returns" in line for line in check.warnings)
    assert (check.lowest, check.highest) == (-1.0, 100.0)


def test_a_random_reward_is_reported(check_of):
    found = check_of(function("return random.random()", "import random\n")).warnings
    assert any("draws random numbers" in line for line in found)


def test_a_function_that_divides_by_the_length_between_waypoints_is_warned_of_the_seam(check_of):
    body = (
        'a, b = (params["waypoints"][i] for i in params["closest_waypoints"])\n'
        'return params["speed"] / math.hypot(b[0] - a[0], b[1] - a[1]) - 9 * params["is_offtrack"]'
    )
    check = check_of(function(body, "import math\n"))
    assert check.failures == []
    assert "between the last waypoint and the first: raised ZeroDivisionError" in check.warnings[0]


def test_a_module_that_cannot_be_run_is_bad_input(check_of):
    with pytest.raises(BadInput, match="cannot be run: raised NameError"):
        check_of("x = nothing\n" + GOOD)


def test_a_reward_batch_that_fails_is_a_failure(check_of):
    check = check_of(GOOD + "\n\ndef reward_batch(params):\n    return 1.0\n")
    assert "one number per car" in check.failures[0]


@pytest.mark.parametrize(
    ("text", "memory"),
    [
        (GOOD, "none"),
        (DELTA, "earlier calls"),
        ("n = [0]\n" + function("n[0] += 1\nreturn n[0]"), "earlier calls"),
        (function("return random.random()", "import random\n"), "randomness"),
    ],
)
def test_stateful_and_random_rewards_are_distinguished(race_with, text, memory):
    race = race_with(text)
    assert state_of(race, Probe(race)) == memory


SET_UP_AT_THE_START = [
    "if params['steps'] <= 2:\n    global last\n    last = 0.0",
    "global last\nif params['steps'] == 2:\n    last = 0.0",
]


@pytest.mark.parametrize("set_up", SET_UP_AT_THE_START)
def test_a_function_that_sets_its_state_up_at_the_start_of_an_episode_can_be_used(check_of, set_up):
    """It trains: no call of an episode comes before that of its start."""
    gained = (
        "gained, last = params['progress'] - last, params['progress']\nreturn gained - params['is_offtrack']"
    )
    check = check_of(function(f"{set_up}\n{gained}"))
    assert check.failures == []
    assert check.state == "earlier calls"
    assert all(answer.failure is None for answer in check.tried.values())


WAITS_FOR_STEP_1 = """\
first = None
def reward_function(params):
    global first
    here = params["progress"]
    if {test}:
        first = here
    return {value}
"""
NO_STEP_1 = "steps is 2 in the first call of an episode"


@pytest.mark.parametrize(
    "test", ['params["steps"] == 1', 'params.get("steps") <= 1', 'int(params["steps"]) < 2']
)
def test_a_function_that_fails_because_it_waits_for_step_1_is_refused_with_that_reason(check_of, test):
    """The service's first step, the prepare step, has no call."""
    (failure,) = check_of(WAITS_FOR_STEP_1.format(test=test, value="here - first")).failures
    assert failure.startswith(f"waits for steps == 1, and {NO_STEP_1}: raised TypeError")


def test_a_function_that_fails_whatever_its_first_step_is_gets_no_such_reason(check_of):
    (failure,) = check_of(WAITS_FOR_STEP_1.format(test='params["steps"] == 0', value="here - first")).failures
    assert "in the first call" not in failure


@pytest.mark.parametrize(
    ("test", "warned"),
    [
        ('params["steps"] == 1', True),
        ('(steps := params["steps"]) and not steps', False),
        ('params["speed"] == 1.5', False),
        ('params["steps"] <= 2', False),
    ],
)
def test_a_branch_for_step_1_that_is_never_reached_is_said_to_be_that(check_of, test, warned):
    check = check_of(WAITS_FOR_STEP_1.format(test=test, value='here - params["speed"]'))
    assert check.failures == []
    assert (
        any("never reaches line 6" in line and line.endswith(NO_STEP_1) for line in check.warnings) == warned
    )


def test_what_is_set_aside_for_step_1_by_name_or_in_an_else_is_known():
    text = """\
steps = params["steps"]
if steps == 1:
    a = 1
if steps > 1:
    b = 1
else:
    c = 1
if speed == 1 or steps == 2:
    d = 1
"""
    assert lines_for_step_1(text) == {3, 7}


def test_a_first_call_that_computes_long_does_not_shrink_the_sample(race_with):
    first = "done = []\n" + function(
        "if not done:\n    done.append(sum(i % 3 for i in range(2000000)))\nreturn params['speed']"
    )
    race = race_with(first)
    cost_s = checking._cpu_s_per_call(Probe(race), race)
    began_s = time.thread_time()
    sum(i % 3 for i in range(2000000))
    assert cost_s < 0.004 * (time.thread_time() - began_s)
