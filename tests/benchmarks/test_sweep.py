"""The benchmark of sweeps counts what it says."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks import sweep_runs
from benchmarks.command import read_metrics
from benchmarks.same import different_rows
from deepracer_exp.config.compose import compose_evaluation


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
