"""The benchmark of sweeps counts what it says."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from optuna.pruners import HyperbandPruner, MedianPruner, NopPruner
from optuna.trial import FrozenTrial, TrialState, create_trial

from benchmarks import sweep, sweep_runs
from benchmarks.command import read_metrics
from benchmarks.same import different_rows
from benchmarks.sweep_runs import Course, Ended, Pace, makespan_s, replay
from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.sweeps.trial import SeedRun, runs_as_json

PACE = Pace(step_s=0.01, trial_s=5.0)
STEPS = 1000


def course(
    number: int, values: Sequence[float], value: float | None = None, outcome: str = "finished"
) -> Course:
    """A trial that is evaluated every 1,000 steps, and ends with its last evaluation."""
    points = tuple((STEPS * place, one) for place, one in enumerate(values, 1))
    worth = None if outcome == "failed" else min(values) if value is None else value
    return Course(number=number, points=points, env_steps=STEPS * len(values), outcome=outcome, value=worth)


def ended(
    number: int, env_steps: int, value: float | None, outcome: str = "finished", began_s: float = 0.0
) -> Ended:
    return Ended(
        number=number,
        outcome=outcome,
        env_steps=env_steps,
        value=value,
        began_s=began_s,
        ended_s=began_s + env_steps * PACE.step_s + PACE.trial_s,
    )


def test_without_a_pruner_every_trial_comes_to_its_own_end_and_workers_take_the_next_when_they_are_free() -> (
    None
):
    courses = [
        course(0, [9.0] * 4),
        course(1, [8.0]),
        course(2, [7.0] * 2),
        course(3, [6.0], outcome="failed"),
    ]
    found = replay(courses, NopPruner(), "pruned", pace=PACE, workers=2)
    assert [one.env_steps for one in found] == [4000, 1000, 2000, 1000]
    assert [one.outcome for one in found] == ["finished"] * 3 + ["failed"]
    assert [one.value for one in found] == [9.0, 8.0, 7.0, None]
    # 45, 15, 25 and 15 seconds: the second worker makes trials 1 and 2, and is free for 3 when the first one is not.
    assert [(one.began_s, one.ended_s) for one in found] == [(0, 45), (0, 15), (15, 40), (40, 55)]
    assert makespan_s(found) == 55


def test_the_median_ends_what_is_worse_than_the_median_of_the_complete_trials_at_the_same_step() -> None:
    courses = [
        course(0, [10.0, 8.0, 6.0]),
        course(1, [12.0, 10.0, 8.0]),
        course(
            2, [14.0, 9.5, 5.0], 4.0
        ),  # worse at first, before the warm-up is over; the median is 9 at step 2
        course(3, [11.0, 8.5, 7.5]),  # 8.5 is better than 9; 7.5 is not better than the median of 6 and 8
        course(4, [9.0, 7.0, 5.5]),
    ]
    pruner = MedianPruner(n_startup_trials=2, n_warmup_steps=2)
    found = replay(courses, pruner, "median", pace=PACE, workers=1)
    assert [one.outcome for one in found] == ["finished", "finished", "median", "median", "finished"]
    assert [one.env_steps for one in found] == [3000, 3000, 2000, 3000, 3000]
    assert [one.value for one in found] == [6.0, 8.0, None, None, 5.5]
    assert found[3].began_s == found[2].ended_s == 35 + 35 + 25


def test_hyperband_lets_a_third_of_a_rung_continue() -> None:
    courses = [course(number, [value] * 3) for number, value in enumerate([5.0, 6.0, 7.0, 4.0, 4.5])]
    pruner = HyperbandPruner(
        min_resource=1, max_resource=2, reduction_factor=3
    )  # one bracket: 1, 3, 9 evaluations
    found = replay(courses, pruner, "hyperband", pace=PACE, workers=1)
    # The first is alone at its rung; each new best of a third continues.
    assert [one.env_steps for one in found] == [3000, 1000, 1000, 3000, 1000]
    assert [one.outcome for one in found] == ["finished", "hyperband", "hyperband", "finished", "hyperband"]


def test_steps_are_saved_against_the_same_trials_without_pruning() -> None:
    unpruned = [ended(number, 4000, 9.0) for number in range(4)]
    pruned = [ended(0, 4000, 9.0), ended(1, 1000, None, "collapsed"), ended(2, 2500, 8.0, "converged")]
    pruned.append(ended(3, 500, None, "collapsed"))
    found = sweep.figures(pruned, 12.0, unpruned)
    assert found["steps_saved"] == 0.5
    assert found["steps_by_outcome"] == {"collapsed": 1500, "converged": 2500, "finished": 4000}
    assert found["trials_by_outcome"] == {"collapsed": 2, "converged": 1, "finished": 1}
    assert (found["env_steps"], found["trials_per_hour"]) == (8000, 20)
    assert sweep.figures(unpruned, 12.0, unpruned)["steps_saved"] == 0


def test_the_winner_is_the_best_of_the_first_on_more_laps() -> None:
    found = [ended(0, 1, 9.0), ended(1, 1, 8.0), ended(2, 1, 8.0), ended(3, 1, 12.0)]
    again = {0: 8.5, 1: 9.5, 2: 9.0, 3: 1.0}
    asked = []

    def drive(one: Ended) -> float:
        asked.append(one.number)
        return again[one.number]

    assert sweep.winner_of(found, "race_score", 3, drive).number == 0
    assert asked == [1, 2, 0]
    assert sweep.winner_of(found, "race_score", 0, drive).number == 1
    assert sweep.winner_of(found, "completion", 1, drive).number == 3
    with pytest.raises(SystemExit, match="no trial was complete"):
        sweep.winner_of([], "race_score", 3, drive)


def test_a_trial_that_reported_something_else_than_its_complete_run_is_refused() -> None:
    whole = course(0, [12.0, 10.0, 9.0, 8.0])

    def trial(reports: dict[int, float]) -> FrozenTrial:
        runs = runs_as_json([SeedRun(seed=0, env_steps=2500, ending="collapsed")])
        return create_trial(state=TrialState.PRUNED, intermediate_values=reports, user_attrs={"runs": runs})

    sweep_runs.hold_against(trial({1: 12.0, 2: 10.0}), whole)
    for reports in ({1: 12.0}, {1: 12.0, 2: 10.5}, {1: 12.0, 2: 10.0, 3: 9.0}):
        with pytest.raises(SystemExit, match="to Optuna"):
            sweep_runs.hold_against(trial(reports), whole)


def test_the_pace_is_that_of_all_steps_and_of_the_usual_trial() -> None:
    def trial(env_steps: int, wall_clock_s: float, took_s: float) -> FrozenTrial:
        run = SeedRun(seed=0, env_steps=env_steps, wall_clock_s=wall_clock_s, took_s=took_s)
        return create_trial(value=1.0, user_attrs={"runs": runs_as_json([run])})

    failed = create_trial(state=TrialState.FAIL, user_attrs={"runs": runs_as_json([SeedRun(seed=0)])})
    found = sweep_runs.pace_of(
        [trial(1000, 10.0, 14.0), trial(3000, 20.0, 26.0), trial(2000, 30.0, 20.0), failed]
    )
    assert found == Pace(step_s=0.01, trial_s=4.0)


def test_a_whole_run_reports_what_the_sweep_would_report_at_each_evaluation(
    trained: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trained("budget.iterations=5", "budget.env_steps=null", "checkpoints.every=2").folder
    config = compose_evaluation(["evaluation=sweep"])[0].evaluation
    monkeypatch.setattr(sweep_runs, "score", lambda *_: 12.5)
    found = sweep_runs.course_of(3, run, "completion", config)
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert found.points == tuple((rows[at]["env_steps"], rows[at]["eval_completion"]) for at in (1, 3))
    assert (found.number, found.env_steps, found.outcome, found.value) == (3, 5 * 1024, "finished", 12.5)


@pytest.mark.slow
def test_a_trial_that_was_ended_before_its_time_uses_its_budget_up_in_a_copy(
    trained: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = [f"stopping.{value}" for value in ("window=1", "warmup=2", "patience=2", "gain=1")]
    budget = ("budget.iterations=6", "budget.env_steps=null", "episode.max_steps=60", "checkpoints.every=2")
    run = trained(*budget, "stopping=plateau", *values).folder
    assert len(read_metrics(run)) < 6
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    whole = sweep_runs.whole_run(run, tmp_path / "000")
    assert different_rows(read_metrics(whole), read_metrics(trained(*budget).folder)) is None
    assert "000: finished after" in capsys.readouterr().out
    assert sweep_runs.whole_run(run, tmp_path / "000") == whole
    assert capsys.readouterr().out == ""
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_the_sweep_of_the_benchmark_is_one_that_it_can_measure_and_others_are_refused() -> None:
    sweep_runs.refuse_others(compose_sweep(sweep.READY))
    for override in ("sweep.seeds=3", "parent=somebody", "sweep.objectives=[lap_time,completion]"):
        key = override.partition("=")[0]
        with pytest.raises(SystemExit, match=key):
            sweep_runs.refuse_others(compose_sweep([*sweep.READY, override]))


def test_a_sweep_that_was_made_is_not_begun_again_and_another_one_is_refused(tmp_path: Path) -> None:
    noted = {"overrides": ["a=1"], "seconds": 90.0, "starts": 2, "done": True}
    (tmp_path / "sweep_started.json").write_text(json.dumps(noted))
    assert sweep_runs.started(["a=1"], tmp_path) == noted
    with pytest.raises(SystemExit, match="has the sweep a=1"):
        sweep_runs.started(["a=2"], tmp_path)
