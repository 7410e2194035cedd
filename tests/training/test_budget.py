import dataclasses
from typing import Any

import pytest

from deepracer_exp.config.running import BudgetConfig
from deepracer_exp.training.budget import Budget

NONE = {field.name: None for field in dataclasses.fields(BudgetConfig)} | {"schedule_until": 1.0}


def limits(**given: Any) -> BudgetConfig:
    return BudgetConfig(**{**NONE, "alerts": (50, 80, 100), **given})


@pytest.mark.parametrize(
    ("limit", "at", "used"),
    [
        # The limit nearest to its end counts.
        ({"env_steps": 1000, "iterations": 10, "minutes": 1.0}, (100, 2, 3.0), ("iterations", 0.2)),
        ({"env_steps": 1000, "iterations": 10, "minutes": 1.0}, (900, 2, 3.0), ("env_steps", 0.9)),
        ({"env_steps": 1000, "iterations": 10, "minutes": 1.0}, (100, 2, 60.0), ("minutes", 1.0)),
        # One that is not set never does.
        ({"env_steps": 1000}, (500, 1, 90.0), ("env_steps", 0.5)),
        ({"iterations": 10}, (500, 1, 90.0), ("iterations", 0.1)),
        ({"minutes": 0.5}, (500, 1, 90.0), ("minutes", 3.0)),
    ],
)
def test_the_limit_nearest_to_its_end_counts_of_those_that_are_set(limit, at, used):
    assert Budget(limits(**limit)).used(*at) == used


@pytest.mark.parametrize(("until", "place"), [(1.0, 0.25), (0.5, 0.5), (0.25, 1.0), (0.1, 1.0), (2.0, 0.125)])
def test_schedules_come_to_their_end_at_a_share_of_the_budget_and_stay_there(until, place):
    assert Budget(limits(env_steps=1000, schedule_until=until)).scheduled(250, 1, 0.0) == place


def test_each_share_of_a_limit_is_reported_once():
    budget = Budget(limits(env_steps=1000))
    passed = {steps: [one.percent for one in budget.alerts(steps, 0, 0.0)] for steps in range(0, 1200, 100)}
    assert {steps: percents for steps, percents in passed.items() if percents} == {
        500: [50],
        800: [80],
        1000: [100],
    }


def test_shares_that_are_passed_together_are_one_alert():
    budget = Budget(limits(env_steps=1000, minutes=10.0))
    assert budget.alerts(0, 0, 0.0) == []
    (steps,) = budget.alerts(950, 0, 60.0)
    assert (steps.limit, steps.percent) == ("env_steps", 80)
    assert steps.message == "80% of budget.env_steps used: 950 steps of 1,000 steps"


def test_it_reports_the_limits_that_are_set():
    assert str(Budget(limits(env_steps=3_000_000, minutes=1.5))) == "3,000,000 steps or 1.5 min"
