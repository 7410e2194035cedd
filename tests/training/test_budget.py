import pytest

from deepracer_exp.config.running import BudgetConfig
from deepracer_exp.training.budget import Budget


def test_the_limit_nearest_to_its_end_counts():
    budget = Budget(BudgetConfig(env_steps=1000, iterations=10, wall_clock_s=60.0))
    assert budget.used(100, 2, 3.0) == ("iterations", 0.2)
    assert budget.used(900, 2, 3.0) == ("env_steps", 0.9)
    assert budget.used(100, 2, 60.0) == ("wall_clock_s", 1.0)


@pytest.mark.parametrize(
    ("limits", "used"),
    [
        ((1000, None, None), ("env_steps", 0.5)),
        ((None, 10, None), ("iterations", 0.1)),
        ((None, None, 2), ("wall_clock_s", 2.0)),
    ],
)
def test_a_limit_that_is_not_set_never_counts(limits, used):
    names = ("env_steps", "iterations", "wall_clock_s")
    assert Budget(BudgetConfig(**dict(zip(names, limits, strict=True)))).used(500, 1, 4.0) == used


def test_it_tells_the_limits_that_are_set():
    assert (
        str(Budget(BudgetConfig(env_steps=3_000_000, iterations=None, wall_clock_s=60.0)))
        == "3,000,000 steps or 60 s"
    )
