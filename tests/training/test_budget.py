import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from deepracer_exp.config.running import BudgetConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.tracking.metrics import TRACK_METRICS
from deepracer_exp.training import budget as module
from deepracer_exp.training.budget import Budget, RunEnded, refuse_ended, refuse_spent

NONE = {field.name: None for field in dataclasses.fields(BudgetConfig)} | {"schedule_until": 1.0}


def limits(**given: Any) -> BudgetConfig:
    return BudgetConfig(**{**NONE, "alerts": (50, 80, 100), **given})


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run that has no siblings yet."""
    folder = tmp_path / "experiment" / "run"
    folder.mkdir(parents=True)
    return folder


def sibling(run: Path, name: str, *, ended: bool = True, **spent: Any) -> None:
    """Write what a run of the same experiment has used; one that has not ended was cut off within a row."""
    folder = run.parent / name
    folder.mkdir(exist_ok=True)
    row = json.dumps({"env_steps": 0, "wall_clock_s": 0.0, **spent})
    if ended:
        (folder / "summary.json").write_text(row)
    else:
        (folder / "metrics.jsonl").write_text(f"{json.dumps({'env_steps': 1})}\n{row}\n" + '{"env_st')


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
        ({"max_cost": 1.0, "price_per_hour": 20.0}, (500, 1, 90.0), ("max_cost", 0.5)),
    ],
)
def test_the_limit_nearest_to_its_end_counts_of_those_that_are_set(limit, at, used):
    assert Budget(limits(**limit), Path()).used(*at) == used


@pytest.mark.parametrize(("until", "place"), [(1.0, 0.25), (0.5, 0.5), (0.25, 1.0), (0.1, 1.0), (2.0, 0.125)])
def test_schedules_come_to_their_end_at_a_share_of_the_budget_and_stay_there(until, place):
    assert Budget(limits(env_steps=1000, schedule_until=until), Path()).scheduled(250, 1, 0.0) == place


def test_a_run_costs_the_price_of_its_time():
    assert Budget(limits(env_steps=1, price_per_hour=3.0), Path()).cost(1800.0) == 1.5
    assert Budget(limits(env_steps=1), Path()).cost(1800.0) is None


def test_the_runs_of_an_experiment_share_its_limits(run):
    sibling(run, "first", env_steps=600)
    config = limits(experiment_env_steps=1000)
    assert Budget(config, run).used(0, 0, 0.0) == ("experiment_env_steps", 0.0)
    assert Budget(config, run).used(200, 0, 0.0) == ("experiment_env_steps", 0.5)
    assert Budget(config, run).used(400, 0, 0.0) == ("experiment_env_steps", 1.0)


def test_minutes_and_costs_are_summed_at_each_runs_own_price(run):
    sibling(run, "cheap", wall_clock_s=3600.0, cost=1.0)
    sibling(run, "dear", wall_clock_s=1800.0, cost=4.0)
    costs = Budget(limits(experiment_max_cost=10.0, price_per_hour=5.0), run)
    assert costs.used(0, 0, 3600.0) == ("experiment_max_cost", 1.0)
    minutes = Budget(limits(experiment_minutes=100.0), run)
    assert minutes.used(0, 0, 300.0) == ("experiment_minutes", 0.5)


@pytest.mark.parametrize("tracks", [0, 134], ids=["one track", "every track of the catalogue"])
def test_a_run_that_continues_or_was_killed_counts_with_its_last_whole_row_however_long(run, tracks):
    columns = {f"{metric}/{number:080d}": 100 / 3 for metric in TRACK_METRICS for number in range(tracks)}
    sibling(run, "continues", ended=False, env_steps=500, **columns)
    assert Budget(limits(experiment_env_steps=1000), run).used(250, 0, 0.0)[1] == 0.5


def test_other_runs_are_looked_at_again_while_this_one_continues(run, monkeypatch):
    monkeypatch.setattr(module, "_REFRESH_S", 0.0)
    budget = Budget(limits(experiment_env_steps=1000), run)
    assert budget.used(100, 0, 0.0)[1] == 0.1
    sibling(run, "beside", ended=False, env_steps=500)
    assert budget.used(100, 0, 0.0)[1] == 0.2
    sibling(run, "beside", ended=False, env_steps=1000)
    assert budget.used(100, 0, 0.0)[1] == 1.0


def test_what_is_no_run_and_what_is_incomplete_count_nothing(run):
    (run.parent / "notes.txt").write_text("of mine")
    (run.parent / "empty").mkdir()
    (run.parent / "incomplete").mkdir()
    (run.parent / "incomplete" / "summary.json").write_text('{"env_steps": 99')
    (run / "metrics.jsonl").write_text('{"env_steps": 900, "wall_clock_s": 9.0}\n')  # this run's own
    assert Budget(limits(experiment_env_steps=1000), run).used(100, 0, 0.0)[1] == 0.1


def test_an_experiment_that_has_used_everything_starts_no_run(run):
    sibling(run, "first", env_steps=700)
    refuse_spent(limits(experiment_env_steps=1000), run.parent)
    refuse_spent(limits(env_steps=100), run.parent)
    refuse_spent(limits(experiment_env_steps=1), run.parent / "not there")
    sibling(run, "second", env_steps=300)
    with pytest.raises(BadInput, match=r"budget\.experiment_env_steps=1000: .* have used 1,000 already"):
        refuse_spent(limits(experiment_env_steps=1000), run.parent)


def test_a_run_that_used_up_the_limit_of_its_experiment_needs_a_higher_one_to_resume(run):
    sibling(run, "first", env_steps=600)
    spent = {"status": "finished", "limit": "experiment_env_steps", "iteration": 4}
    sibling(run, run.name, env_steps=400, **spent)
    with pytest.raises(RunEnded, match=r"give it more, such as budget\.experiment_env_steps="):
        refuse_ended(run, limits(experiment_env_steps=1000), [])
    refuse_ended(run, limits(experiment_env_steps=1001), [])


def test_each_share_of_a_limit_is_reported_once():
    budget = Budget(limits(env_steps=1000), Path())
    passed = {steps: [one.percent for one in budget.alerts(steps, 0, 0.0)] for steps in range(0, 1200, 100)}
    assert {steps: percents for steps, percents in passed.items() if percents} == {
        500: [50],
        800: [80],
        1000: [100],
    }


def test_shares_that_are_passed_together_are_one_alert():
    budget = Budget(limits(env_steps=1000, minutes=10.0), Path())
    assert budget.alerts(0, 0, 0.0) == []
    (steps,) = budget.alerts(950, 0, 60.0)
    assert (steps.limit, steps.percent) == ("env_steps", 80)
    assert steps.message == "80% of budget.env_steps used: 950 steps of 1,000 steps"


def test_what_was_passed_before_a_run_began_is_not_reported_by_it(run):
    sibling(run, "first", env_steps=600)
    budget = Budget(limits(experiment_env_steps=1000), run)
    assert budget.alerts(0, 0, 0.0) == []
    assert budget.alerts(100, 0, 0.0) == []
    (alert,) = budget.alerts(200, 0, 0.0)
    assert alert.message == "80% of budget.experiment_env_steps used: 800 steps of 1,000 steps"


def test_it_reports_the_limits_that_are_set():
    assert str(Budget(limits(env_steps=3_000_000, minutes=1.5), Path())) == "3,000,000 steps or 1.5 min"
    costs = limits(max_cost=2.0, experiment_max_cost=5.0, price_per_hour=1.0)
    assert str(Budget(costs, Path())) == "2.00 in cost or 5.00 in cost of all runs"


@pytest.mark.parametrize("name", ["max_cost", "experiment_max_cost"])
def test_costs_without_a_price_are_refused(name):
    with pytest.raises(ValueError, match="price_per_hour"):
        limits(env_steps=1, **{name: 3.0})
