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
from deepracer_exp.evaluation.checkpoint import read_checkpoint
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.run import read_run
from deepracer_exp.formats.run_files import read_config, read_object
from deepracer_exp.tracking import tracking_file
from deepracer_exp.training.training import SPENT
from sweeps.score import value_on_the_way, values_of

from .command import command_line, read_metrics, read_summary
from .pruning_replay import Course, Pace

_LEFT_BEHIND = ("trace", tracking_file.NAME)
"""Of a trial's run: most of its bytes, and its run in MLflow."""
_NOTED, _SCORES = "sweep_started.json", "scores.json"
_NOTE_S = 5.0


def started(overrides: Sequence[str], folder: Path) -> dict[str, Any]:
    """Run the sweep in `folder`, or go on with it; return the `seconds` of all its `starts`.

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
            # On the way, too: what was killed shall not forget its time.
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
    """Return a copy of a trial's run that has used its budget up; it goes on with whatever of it is in `folder`.

    It may have failed on the way: trials do.

    Args:
        run: that a stopping rule or a pruner has ended.
        folder: for the copy.

    Raises:
        SystemExit: it cannot go on.
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
    return summary.get("status") == "failed" or str(summary.get("reason")).startswith(SPENT)


def hold_against(trial: FrozenTrial, course: Course) -> None:
    """Refuse a trial whose whole run tells something else than the trial has told Optuna.

    Raises:
        SystemExit: naming the trial and the difference.
    """
    fate = trial.user_attrs["fate"]
    if fate == "failed":
        return
    refuse_other_reports(trial, course)
    if fate == "finished" and trial.values[0] != course.value:
        raise SystemExit(
            f"trial {trial.number}: was worth {trial.values[0]} and is worth {course.value} again"
        )


def refuse_other_reports(trial: FrozenTrial, course: Course) -> None:
    """Hold what a trial told Optuna on its way against what its whole run tells.

    Raises:
        SystemExit: they differ.
    """
    until = trial.user_attrs["env_steps"]
    reports = {step: value for step, (at, value) in enumerate(course.points, 1) if at <= until}
    if trial.intermediate_values != reports:
        raise SystemExit(
            f"trial {trial.number}: told Optuna {trial.intermediate_values}, its whole run tells {reports}"
        )


def course_of(trial: int, run: Path, objective: str, protocol: EvaluationConfig) -> Course:
    """Return what a whole run tells a sweep, on its way and at its end."""
    rows, summary = read_metrics(run), read_summary(run)
    every = read_config(run)["checkpoints"]["every"]
    # A run that ends before its first evaluation is evaluated then, which nobody tells the pruners.
    due = [row for row in rows if every is not None and row["iteration"] % every == 0]
    values = [(row["env_steps"], value_on_the_way(row, objective, protocol.time_s)) for row in due]
    failed = summary["status"] == "failed"
    return Course(
        number=trial,
        points=tuple((env_steps, value) for env_steps, value in values if value is not None),
        env_steps=summary["env_steps"],
        fate="failed" if failed else "finished",
        value=None if failed else score(run, objective, protocol),
    )


def score(run: Path, objective: str, protocol: EvaluationConfig) -> float:
    """Return what a run's best policy is worth by a protocol; it is driven once, and noted in the run's folder."""
    file, key = run / _SCORES, f"{objective}: {protocol}"
    known = read_object(file)
    if key not in known:
        stored = read_run(str(run), run.parent, None)
        policy = read_checkpoint(stored.experiment, stored.checkpoints, stored.meant(None)).networks.policy
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
