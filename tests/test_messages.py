"""Messages repeat a long value in short, and never shorten what would be accepted."""

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.source import load_reward_source
from tests.conftest import refused

LONG = "x" * 5000


@pytest.mark.parametrize("value", [LONG, f"'x x{LONG}'"])
@pytest.mark.parametrize("key", ["track", "car", "name", "reward.name", "nothing"])
def test_a_long_value_is_not_repeated(key, value):
    message = refused(lambda: load_reward_source(compose_experiment([f"{key}={value}"])[0].reward))
    assert key in message
    assert "x" * 200 not in message


@pytest.mark.parametrize("value", [LONG, "a 'b' " * 1000, "word " * 1000])
def test_a_long_quoted_value_is_shortened_whatever_it_holds(value):
    message = str(BadInput(f"key={value!r}: is not known; accepted: one, two"))
    assert len(message) < 4100
    assert message.endswith("accepted: one, two")


def test_what_would_be_accepted_is_never_shortened():
    options = ", ".join(f"track's_{number}" for number in range(200))
    for message in (f"track='x': no such track; accepted: {options}", f"it's 'x': {options}"):
        assert str(BadInput(message)) == message


@pytest.mark.parametrize("key", ["lookahead_scale_m", "speed_scale_mps", "yaw_rate_scale_radps"])
@pytest.mark.parametrize("value", ["1e-320", "1e-7", "1e300", "nan"])
def test_a_scale_that_would_make_features_infinite_is_refused(key, value):
    assert f"observation.{key}" in refused(compose_experiment, [f"observation.{key}={value}"])
