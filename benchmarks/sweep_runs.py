"""The runs of a sweep, the same trials trained to the end of their budget, and how another pruner would end these.

A pruner sees nothing of a trial but the values it reports and their steps. So the values of a complete training,
reported to a study in memory step by step, give the decisions that the pruner would have made during that training; a
pruned training is the beginning of the complete one. Which values there are to compare with depends on what the other
workers do at the same time: each worker is modelled by how long its trials take, at the measured pace.
"""

import contextlib
import heapq
import json
import shutil
import statistics
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.pruners import BasePruner
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.sweep import SweepRequest
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.runs.run_files import MLFLOW, TRACKING, read_config, read_object
from deepracer_exp.sweeps.report.wording import ending_of
from deepracer_exp.sweeps.search.objectives import intermediate_value, objective_values
from deepracer_exp.sweeps.trial import Trial

from .command import command_line, read_metrics, read_summary
from .fresh import stored_policy

_LEFT_BEHIND = ("trace", TRACKING, MLFLOW)
"""Not copied from a trial's run: most of its bytes, and its link to MLflow."""
_NOTED, _SCORES = "sweep_started.json", "scores.json"
_NOTE_S = 5.0


@dataclass(frozen=True, kw_only=True)
class Course:
    """A trial without pruning."""

    number: int
    points: tuple[tuple[int, float], ...]
    """(env steps, value) of each evaluation before its end."""
    env_steps: int
    """At its end."""
    outcome: str
    """How it ends by itself."""
    value: float | None
    """Its value then; None: it failed."""


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How long trials take."""

    step_s: float
    """A control step of one worker, learning included."""
    trial_s: float
    """The rest of a trial, seconds."""


@dataclass(frozen=True, kw_only=True)
class Ended:
    """A trial that has ended."""

    number: int
    outcome: str
    env_steps: int
    value: float | None
    """None: it was pruned, or failed."""
    began_s: float
    """Since the start of the sweep."""
    ended_s: float


def replay(
    courses: Sequence[Course],
    pruner: BasePruner,
    outcome: str,
    *,
    pace: Pace,
    workers: int,
    direction: StudyDirection = StudyDirection.MINIMIZE,
    study_name: str = "replay",
) -> list[Ended]:
    """Replay trials with a pruner; return them in their order.

    Args:
        courses: in the order in which they begin.
        pruner: asked after each evaluation.
        outcome: of the trials that it prunes.
        pace: of all workers.
        workers: how many trials run at once; the first free one takes the next trial.
        direction: of the values.
        study_name: chooses Hyperband's brackets, with the trial's number.
    """
    study = optuna.create_study(study_name=study_name, pruner=pruner, direction=direction)
    waiting, ended = iter(courses), list[Ended]()
    lines = [_worker(study, waiting, outcome, pace, ended) for _ in range(workers)]
    moments = [(0.0, place) for place in range(workers)]
    while moments:
        _, place = heapq.heappop(moments)
        moment_s = next(lines[place], None)
        if moment_s is not None:
            heapq.heappush(moments, (moment_s, place))
    return sorted(ended, key=lambda one: one.number)


def _worker(
    study: optuna.Study, waiting: Iterator[Course], outcome: str, pace: Pace, ended: list[Ended]
) -> Iterator[float]:
    """Run trial after trial; yield the time of the next event, which happens at the next call."""
    now_s = 0.0
    for course in waiting:
        trial, began_s, pruned_at = study.ask(), now_s, None
        for step, (env_steps, value) in enumerate(course.points, 1):
            yield began_s + env_steps * pace.step_s
            trial.report(value, step)
            if trial.should_prune():
                pruned_at = env_steps
                break
        env_steps = course.env_steps if pruned_at is None else pruned_at
        now_s = began_s + env_steps * pace.step_s + pace.trial_s
        yield now_s
        _report(study, trial, course, pruned_at is not None)
        ended.append(
            Ended(
                number=course.number,
                outcome=course.outcome if pruned_at is None else outcome,
                env_steps=env_steps,
                value=course.value if pruned_at is None else None,
                began_s=began_s,
                ended_s=now_s,
            )
        )


def _report(study: optuna.Study, trial: optuna.Trial, course: Course, pruned: bool) -> None:
    if pruned:
        study.tell(trial, state=TrialState.PRUNED)
    elif course.value is None:
        study.tell(trial, state=TrialState.FAIL)
    else:
        study.tell(trial, course.value)


def makespan_s(ended: Sequence[Ended]) -> float:
    """Return when the last trial ended."""
    return max((one.ended_s for one in ended), default=0.0)


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
    """Refuse sweeps other than local ones of one objective whose trials are one run each from scratch.

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
    """Return a copy of a trial's run, resumed until it has used its budget; a copy already in `folder` is reused.

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
    return summary.get("status") == "failed" or summary.get("limit") is not None


def hold_against(trial: FrozenTrial, course: Course) -> None:
    """Refuse a trial whose complete run reports something other than the trial reported to Optuna.

    Raises:
        SystemExit: naming the trial and the difference.
    """
    ending, until = ending_of(trial), Trial.of(trial).env_steps
    if ending == "failed":
        return
    reports = {step: value for step, (at, value) in enumerate(course.points, 1) if at <= until}
    if trial.intermediate_values != reports:
        raise SystemExit(
            f"trial {trial.number}: reported {trial.intermediate_values} to Optuna, its complete run reports {reports}"
        )
    if ending == "finished" and trial.values[0] != course.value:
        raise SystemExit(
            f"trial {trial.number}: had the value {trial.values[0]} and has {course.value} again"
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
        experiment, policy = stored_policy(run)
        evaluation = Evaluator(experiment, protocol)(policy)
        known[key] = objective_values(evaluation, [objective], protocol.time_s)[0]
        file.write_text(json.dumps(known), encoding="utf-8")
    return float(known[key])


def pace_of(trials: Sequence[FrozenTrial]) -> Pace:
    """Return how long steps and trials took in a sweep."""
    runs = [run for trial in trials for run in Trial.of(trial).runs if run.env_steps]
    # A trial that was taken over had its time in two parts, of which only the last is in `took_s`.
    besides_s = [max(run.took_s - run.wall_clock_s, 0.0) for run in runs if run.took_s is not None]
    steps, driven_s = sum(run.env_steps for run in runs), sum(run.wall_clock_s for run in runs)
    return Pace(step_s=driven_s / steps, trial_s=statistics.median(besides_s))
