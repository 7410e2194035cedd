"""The runs of a sweep, and the same trials trained to the end of their budget."""

import contextlib
import json
import shutil
import statistics
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.sweep import SweepRequest
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.runs.files import TRACKING, read_config, read_object
from deepracer_exp.runs.read_checkpoint import read_checkpoint
from deepracer_exp.runs.resolve import resolve
from deepracer_exp.training.callbacks import BUDGET_REACHED
from sweeps.objectives import intermediate_value, values_of

from .command import command_line, read_metrics, read_summary
from .pruning_replay import Course, Pace

_LEFT_BEHIND = ("trace", TRACKING)
"""Of a trial's run: most of its bytes, and its run in MLflow."""
_NOTED, _SCORES = "sweep_started.json", "scores.json"
_NOTE_S = 5.0


def started(overrides: Sequence[str], folder: Path) -> dict[str, Any]:
    """Run or resume the sweep in `folder`; return the `seconds` of all its `starts`.

    Raises:
        SystemExit: it did not end well, or another sweep has been begun in the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / _NOTED
    noted = read_object(file) or {"overrides": list(overrides), "seconds": 0.0, "starts": 0, "done": False}
    if noted["overrides"] != list(overrides):
        raise SystemExit(f"{folder}: has the sweep {' '.join(noted['overrides'])}; give another folder")
    if noted["done"]:
        return noted
    before_s, began = noted["seconds"], time.monotonic()
    noted["starts"] += 1
    line = command_line("sweep", *overrides)
    with subprocess.Popen(line, cwd=folder) as process:
        code = None
        while code is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(_NOTE_S)
            # While it runs, too, so that the time of a killed start counts.
            noted |= {"seconds": before_s + time.monotonic() - began, "done": code == 0}
            file.write_text(json.dumps(noted), encoding="utf-8")
    if code:
        raise SystemExit(f"{' '.join(line)}: exit code {code}")
    return noted


def refuse_others(request: SweepRequest) -> None:
    """Refuse sweeps whose trials are not one run each from scratch.

    Raises:
        SystemExit: naming the key.
    """
    config = request.entry.sweep
    for key, given in (
        ("parent", request.entry.parent is not None),
        ("sweep.seeds", config.seeds != 1),
        ("sweep.objectives", len(config.objectives) != 1),
        ("sweep/executor", config.executor.kind != "local"),
    ):
        if given:
            raise SystemExit(
                f"{key}: only trials of one run, from scratch, with one objective, on this machine"
            )


def whole_run(run: Path, folder: Path) -> Path:
    """Return a copy of a trial's run that has used its budget; a copy that is in `folder` already is resumed.

    It may have failed on the way: trials do.

    Args:
        run: that a stopping rule or a pruner has ended.
        folder: for the copy.

    Raises:
        SystemExit: it cannot be resumed.
    """
    copy = folder / "runs" / "whole" / run.name
    if not copy.exists():
        aside = folder / run.name
        shutil.rmtree(aside, ignore_errors=True)
        shutil.copytree(run, aside, symlinks=True, ignore=shutil.ignore_patterns(*_LEFT_BEHIND))
        copy.parent.mkdir(parents=True, exist_ok=True)
        aside.rename(copy)
    if _is_whole(copy):
        return copy
    began = time.monotonic()
    line = command_line("resume", str(copy), "stopping=none", "tracking=off", "report=false")
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if not _is_whole(copy):
        raise SystemExit(f"{' '.join(line)}: exit code {done.returncode}\n{done.stderr}")
    print(
        f"{folder.name}: {read_summary(copy)['status']} after {time.monotonic() - began:.0f} s more",
        flush=True,
    )
    return copy


def _is_whole(run: Path) -> bool:
    summary = read_object(run / "summary.json")
    return summary.get("status") == "failed" or str(summary.get("reason")).startswith(BUDGET_REACHED)


def hold_against(trial: FrozenTrial, course: Course) -> None:
    """Refuse a trial whose complete run reports something else than the trial has reported to Optuna.

    Raises:
        SystemExit: naming the trial and the difference.
    """
    outcome = trial.user_attrs["fate"]
    if outcome == "failed":
        return
    refuse_other_reports(trial, course)
    if outcome == "finished" and trial.values[0] != course.value:
        raise SystemExit(
            f"trial {trial.number}: had the value {trial.values[0]} and has {course.value} again"
        )


def refuse_other_reports(trial: FrozenTrial, course: Course) -> None:
    """Compare what a trial reported to Optuna with what its complete run reports.

    Raises:
        SystemExit: they differ.
    """
    until = trial.user_attrs["env_steps"]
    reports = {step: value for step, (at, value) in enumerate(course.points, 1) if at <= until}
    if trial.intermediate_values != reports:
        raise SystemExit(
            f"trial {trial.number}: reported {trial.intermediate_values} to Optuna, its complete run reports {reports}"
        )


def course_of(trial: int, run: Path, objective: str, protocol: EvaluationConfig) -> Course:
    """Return what a complete run reports to a sweep, before and at its end."""
    rows, summary = read_metrics(run), read_summary(run)
    every = read_config(run)["checkpoints"]["every"]
    # A run that ends before its first evaluation is evaluated then, which is not reported to the pruners.
    due = [row for row in rows if every is not None and row["iteration"] % every == 0]
    values = [(row["env_steps"], intermediate_value(row, objective, protocol.time_s)) for row in due]
    failed = summary["status"] == "failed"
    return Course(
        number=trial,
        points=tuple((env_steps, value) for env_steps, value in values if value is not None),
        env_steps=summary["env_steps"],
        outcome="failed" if failed else "finished",
        value=None if failed else score(run, objective, protocol),
    )


def score(run: Path, objective: str, protocol: EvaluationConfig) -> float:
    """Return the value of a run's best policy by a protocol; it races once, and the run's folder keeps the value."""
    file, key = run / _SCORES, f"{objective}: {protocol}"
    known = read_object(file)
    if key not in known:
        stored = resolve(str(run), run.parent, None)
        policy = read_checkpoint(
            stored.experiment, stored.checkpoints, stored.choose_checkpoint(None)
        ).networks.policy
        evaluation = Evaluator(stored.experiment, protocol)(policy)
        known[key] = values_of(evaluation, [objective], protocol.time_s)[0]
        file.write_text(json.dumps(known), encoding="utf-8")
    return float(known[key])


def pace_of(trials: Sequence[FrozenTrial]) -> Pace:
    """Return how long steps and trials took in a sweep."""
    runs = [run for trial in trials for run in trial.user_attrs["runs"] if run["env_steps"]]
    # A trial that was taken over had its time in two parts, of which only the last is in `took_s`.
    besides_s = [max(run["took_s"] - run["wall_clock_s"], 0.0) for run in runs if "took_s" in run]
    steps, driven_s = sum(run["env_steps"] for run in runs), sum(run["wall_clock_s"] for run in runs)
    return Pace(step_s=driven_s / steps, trial_s=statistics.median(besides_s))
