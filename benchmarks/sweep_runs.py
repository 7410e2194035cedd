"""The runs of a sweep, and the same trials trained in full."""

import contextlib
import json
import statistics
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from optuna.trial import FrozenTrial

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.sweep import SweepRequest
from deepracer_exp.evaluation.checkpoint import read_checkpoint
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.run import read_run
from deepracer_exp.formats.run_files import read_config, read_object
from sweeps.score import value_on_the_way, values_of

from .command import command_line, read_metrics, read_summary, train
from .pruning_replay import Course, Pace
from .same import Row, different_rows

_OTHERWISE = ("stopping", "tracking", "report")
"""Groups that the whole runs have otherwise than the trials; nothing of them changes what is learned."""
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


def full_overrides(told: Sequence[str], threads: int) -> list[str]:
    """Return what a trial's whole run is told.

    Args:
        told: the overrides of the trial.
        threads: of the trial's worker.
    """
    keys = [override.partition("=")[0].lstrip("+~") for override in told]
    kept = [one for one, key in zip(told, keys, strict=True) if key.partition(".")[0] not in _OTHERWISE]
    own = [] if "collector.threads" in keys else [f"collector.threads={threads}"]
    return [*kept, *own, "stopping=none", "tracking=off", "report=false"]


def full_run(folder: Path, overrides: Sequence[str]) -> Path:
    """Return the run of these overrides in `folder`; train if there is none. It may have failed: trials do."""
    run = _ended(folder, overrides)
    if run is not None:
        return run
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    try:
        run = train(overrides, folder)
    except SystemExit:
        run = _ended(folder, overrides)
        if run is None:
            raise
    print(f"{folder.name}: {read_summary(run)['status']} in {time.monotonic() - began:.0f} s", flush=True)
    return run


def _ended(folder: Path, overrides: Sequence[str]) -> Path | None:
    for summary in sorted(folder.glob("runs/*/*/summary.json")):
        told = yaml.safe_load((summary.parent / "overrides.yaml").read_text(encoding="utf-8"))
        if told == list(overrides) and read_summary(summary.parent)["status"] in ("finished", "failed"):
            return summary.parent
    return None


def refuse_another_beginning(trial: int, rows: Sequence[Row], full: Sequence[Row], fate: str) -> None:
    """Hold a trial of the sweep against its whole run.

    Args:
        trial: its number.
        rows: of its metrics.jsonl.
        full: those of the whole run.
        fate: how the trial ended.

    Raises:
        SystemExit: it is not the beginning; with the whole budget, not the whole.
    """
    found = different_rows(full if fate == "finished" else full[: len(rows)], rows)
    if found is not None:
        raise SystemExit(f"trial {trial} ({fate}): is not the beginning of its whole run: {found}")


def hold_against(trial: FrozenTrial, run: Path, whole: Path, course: Course) -> None:
    """Refuse a trial that is not the beginning of its whole run, or has told Optuna something else.

    Raises:
        SystemExit: naming the trial and the difference.
    """
    fate = trial.user_attrs["fate"]
    if fate == "failed":
        return
    refuse_another_beginning(trial.number, read_metrics(run), read_metrics(whole), fate)
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
