"""What is said of values that do not divide."""

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.training.rounding import rounded

CARS = ("experiment=tiny", "collector.cars=16")


@pytest.mark.parametrize(
    ("overrides", "lines"),
    [
        ((), []),
        (
            ("algorithm.frames_per_iteration=1000", "algorithm.batch_size=252"),
            [
                "algorithm.frames_per_iteration=1000: each iteration has 1,008 steps, 63 of each of 16 cars",
            ],
        ),
        (
            ("algorithm.frames_per_iteration=1008", "algorithm.batch_size=300"),
            [
                "algorithm.batch_size=300: each pass leaves out 108 of an iteration's 1,008 steps, others each time",
            ],
        ),
        (("algorithm.frames_per_iteration=null", "algorithm.episodes_per_iteration=20"), []),
    ],
)
def test_a_value_that_is_not_used_as_given_is_named_with_what_is(overrides, lines):
    assert rounded(compose_experiment([*CARS, *overrides])[0]) == lines


def test_soft_actor_critic_draws_its_minibatches_from_what_it_remembers():
    sac = ("algorithm=sac", "collector.cars=16", "algorithm.batch_size=300")
    assert rounded(compose_experiment(sac)[0]) == []
    (line,) = rounded(compose_experiment([*sac, "algorithm.frames_per_iteration=1000"])[0])
    assert line.startswith("algorithm.frames_per_iteration=1000: each iteration has 1,008 steps")
