"""What a reward function reads is known from its text, or it counts as reading everything."""

from typing import Any

import numpy as np
import pytest

from deepracer_exp.env.race import Race
from deepracer_exp.rewards.params import MASK, OBJECT_COLUMNS
from deepracer_exp.rewards.reads import keys_read
from deepracer_exp.rewards.reward import RewardFunction
from deepracer_exp.rewards.source import named_reward_source, zoo_names
from tests.env.conftest import make_setup

PLAIN = "def reward_function(params):\n    return "


@pytest.mark.parametrize(
    ("body", "keys"),
    [
        ("params['x'] + params.get('y', 0.0)", {"x", "y"}),
        ("1.0 if 'speed' in params and 'z' not in params else 0.0", {"speed", "z"}),
        (
            "sum(params['objects_distance'][k] for k in params['closest_objects'])",
            {"objects_distance", "closest_objects"},
        ),
        ("(lambda: params['x'])()", {"x"}),
        ("params[key]", None),
        ("len(params)", None),
        ("sum(params.values())", None),
        ("helper(params)", None),
        ("(p := params)['x']", None),
        ("eval('params')['x'] + params['y']", None),
        ("locals()['params']['x']", None),
        ("params['x'] if print(*[params]) else 0.0", None),
    ],
)
def test_keys_are_known_only_where_the_params_are_used_by_name(body: str, keys: set[str] | None) -> None:
    found = keys_read(PLAIN + body, "reward_function")
    assert found == (None if keys is None else frozenset(keys))


HELPER = "def helper(weight, p):\n    return weight * p['speed'] + other(p)\n\n\n"
OTHER = "def other(values):\n    return values['x']\n\n\n"


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        (OTHER + HELPER + PLAIN + "helper(2.0, params)", {"speed", "x"}),
        (HELPER + PLAIN + "helper(2.0, params)", None),  # nobody knows what `other` is
        (OTHER + HELPER + PLAIN + "helper(2.0, p=params)", None),
        (OTHER + HELPER + PLAIN + "helper(*[2.0], params)", None),
        (OTHER + "other = print\n\n\n" + HELPER + PLAIN + "helper(2.0, params)", None),
        ("from math import sqrt as other\n\n\n" + OTHER + HELPER + PLAIN + "helper(2.0, params)", None),
        ("@print\n" + OTHER + PLAIN + "other(params)", None),
        ("def reward_function(params):\n    params['x'] = 1.0\n    return params['x']\n", {"x"}),
        ("def reward_function(params):\n    return reward_function(params) if params['x'] else 0.0\n", {"x"}),
        ("class Reward:\n    pass\n\n\nreward_function = Reward()\n", None),
    ],
)
def test_params_are_followed_into_functions_of_the_module(text: str, keys: set[str] | None) -> None:
    found = keys_read(text, "reward_function")
    assert found == (None if keys is None else frozenset(keys))


class _Noted(dict[str, Any]):
    """A dictionary that notes which keys are read."""

    def __init__(self, params: dict[str, Any]) -> None:
        super().__init__(params)
        self.read: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        self.read.add(key)
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        self.read.add(key)
        return super().get(key, default)


@pytest.mark.parametrize("scalar", [False, True])
@pytest.mark.parametrize("name", zoo_names())
def test_a_function_of_the_zoo_reads_no_key_but_those_found_in_its_text(name: str, scalar: bool) -> None:
    function = RewardFunction(named_reward_source(name), 4, 5.0, None, scalar)
    read = keys_read(function.source.text, "reward_batch" if function.is_batch else "reward_function")
    assert read is not None
    race = Race(make_setup("race=head_to_bot", "race.boxes.number=2", "observation.next_objects=2"), 4)
    race.reset()
    race.step(np.full(4, 7))
    race.step(np.full(4, 7))
    noted: list[_Noted] = []
    for place, own in enumerate(function.functions):

        def spy(params: dict[str, Any], own: Any = own) -> object:
            noted.append(_Noted(params))
            return own(noted[-1])

        function.functions[place] = spy
    result, objects = race.others.judge(race.rules.apply(), wanted=OBJECT_COLUMNS)
    commands = np.zeros(4), np.ones(4)
    params = race.rules.params(result, *commands)
    whole = function({**params, **objects}, race.rules.track_params)
    assert noted[0].read <= read
    fewer = {key: objects[key] for key in (*function.object_keys, MASK)}
    function = RewardFunction(function.source, 4, 5.0, None, scalar)
    np.testing.assert_array_equal(function({**params, **fewer}, race.rules.track_params), whole)


def test_lists_that_are_not_read_are_not_made() -> None:
    race = Race(make_setup("race=head_to_bot", "reward=avoid_objects", "observation.next_objects=2"), 2)
    keys = race._reward_function.object_keys
    assert "objects_distance" in keys
    assert "objects_location" not in keys
    race.reset()
    race.step(np.full(2, 7))
    _, objects = race.others.judge(race.rules.apply(), wanted=keys)
    assert set(objects) == {*keys, MASK}
