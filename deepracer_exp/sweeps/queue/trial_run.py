"""Makes the runs of a trial, one per seed, or resumes them where an earlier worker stopped."""

import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import optuna
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial

from deepracer_exp.config.overrides import key_of
from deepracer_exp.errors import RunFailed
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.results import HELD_OUT, USUAL
from deepracer_exp.evaluation.run_evaluation import write_evaluation
from deepracer_exp.reports.pages.run_page import RunReport
from deepracer_exp.runs.checkpoint_files import kept_checkpoints
from deepracer_exp.runs.folder import is_held
from deepracer_exp.runs.run_files import (
    CHECKPOINTS,
    METRICS,
    SUMMARY,
    is_run,
    read_metrics,
    read_object,
    read_run_id,
)
from deepracer_exp.runs.run_result import FAILED, FINISHED, INTERRUPTED, STOPPED_EARLY, Ending
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.sweeps.search.objectives import intermediate_value, objective_values
from deepracer_exp.sweeps.search.pruners import FirstOf, PruneDecision
from deepracer_exp.sweeps.trial import Interrupted, SeedRun, Trial, runs_as_json
from deepracer_exp.tracking.metadata import PARENT, STUDY
from deepracer_exp.tracking.mlflow_metrics import trial_metrics
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.tracking.study_run import TRIAL, end_trial_run, open_trial_run
from deepracer_exp.tracking.tracking_file import Status
from deepracer_exp.training.budget import RunEnded
from deepracer_exp.training.plan import TrainPlan, plan_resume
from deepracer_exp.training.run import copy_run, run_training
from deepracer_exp.training.train_result import TrainResult
from deepracer_exp.training.trainer import Callback, Trainer

from .claims import TrialClaims
from .lease import Lease
from .storage import patiently, resolve_database
from .worker_config import RUN_ID, WorkerConfig, plan_trial

Value = TypeVar("Value")

_KEEPS = {"report": "false", "trace": "laps"}
"""Defaults for the stored files of a trial's run, unless its overrides set more.

Traces are two thirds of a study's disk; laps save an eighth of them where most steps are of laps, as on short tracks.
"""
_MOST_TRIES = 3
"""Most attempts at a run from the same checkpoint, if its process is lost each time."""
_STATES = {FAILED: "FAIL", STOPPED_EARLY: "PRUNED"}
"""Optuna's state of a trial whose last run has this status; other runs are complete."""
_SHOWN = ("iteration", "env_steps", "completion", "entropy", "eval_completion", "eval_lap_time_s")
"""Columns of metrics.jsonl for the live view."""


class TrialRun(Callback):
    """Makes the runs of a trial, or resumes those that an earlier worker began.

    It is a callback of each run that keeps the claim, reports evaluations to Optuna and asks the pruners.
    """

    hurries_when_interrupted = True

    def __init__(
        self,
        config: WorkerConfig,
        claims: TrialClaims,
        lease: Lease,
        study: optuna.Study,
        storage: RDBStorage,
        trial_id: int,
        projector: Projector,
    ):
        """Load the claim's trial, which has this id in Optuna; `projector` records its runs."""
        self._config, self._claims, self._lease = config, claims, lease
        self._study, self._storage, self._trial_id = study, storage, trial_id
        self._trial = optuna.trial.Trial(study, trial_id)
        self._number = self._trial.number
        self._runs = list(lease.claim.trial.runs)
        self._reported: set[int] = set()
        """Evaluations that Optuna has, once they were read."""
        self._seed = 0
        """Index of the present run."""
        self._parent_run_id: str | None = None
        """MLflow's id of the run above those of the trial."""
        self._projector = projector

    def make(self) -> Trial:
        """Make the missing runs of the trial.

        Raises:
            TakenOver: another worker has the trial now.
            Interrupted: the process was asked to end.
            RunFailed: the database has not answered for too long.
        """
        overrides = self._overrides()
        with TemporaryDirectory(prefix="trial-", ignore_cleanup_errors=True) as above:
            self._parent_run_id = self._mlflow_parent(overrides, Path(above))
            ended = self._ended(overrides)
            self._track(ended, Path(above))
        return ended

    def failed(self, reason: str, trace: str) -> Trial:
        """Return a trial that failed outside its runs."""
        self._runs[self._seed :] = [
            _as_failed(self._run or SeedRun(seed=self._seed), reason, trace or reason)
        ]
        return self._as_trial("FAIL")

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Keep the claim and ask the pruners."""
        row = trainer.row
        self._lease.confirm()
        _, spent = trainer.budget.used(*trainer.usage)
        self._show(spent, {name: row.get(name) for name in _SHOWN})
        value = intermediate_value(row, self._config.config.objectives[0], self._config.protocol.time_s)
        if value is None or self._seed > 0:
            return
        decision = self._patiently(lambda: self._pruned(value))
        if decision is not None:
            trainer.request_stop(Ending.by_rule(*decision, STOPPED_EARLY))

    def summary(self, trainer: Trainer) -> dict[str, Any]:
        """Name the trial, and check its claim before the end of the run is written: pictures take a second to draw."""
        self._lease.confirm()
        return {"study": self._config.study, "trial": self._number}

    def _begin(self, run_dir: Path) -> None:
        """Record the folder of the run."""
        self._show(0.0, {})
        tried = self._run or SeedRun(seed=self._seed)
        folder = str(run_dir.resolve())
        self._record(SeedRun(seed=self._seed, run_dir=folder, tries=tried.tries, tried_at=tried.tried_at))
        # The report draws the curves of running trials.
        self._patiently(lambda: self._trial.set_user_attr("runs", runs_as_json(self._runs)))

    def _show(self, spent: float, row: dict[str, Any]) -> None:
        """Update the live view, after this share of the present run's budget."""
        share = (self._seed + min(spent, 1.0)) / self._config.config.seeds
        self._lease.progress = {**row, "params": self._trial.params, "share": share}

    def _pruned(self, value: float) -> PruneDecision | None:
        """Report an evaluation to Optuna, and return the pruners' decision."""
        if len(self._config.config.objectives) > 1:
            return None  # Optuna compares trials by one number only.
        rows = _rows(self._runs[0].folder(self._config.folder))
        step = 1 + sum(row["eval_completion"] is not None for row in rows)
        if not self._reported:
            self._reported |= self._storage.get_trial(self._trial_id).intermediate_values.keys()
        if step not in self._reported:
            self._trial.report(value, step)
            self._reported.add(step)
        assert isinstance(self._study.pruner, FirstOf)
        return self._study.pruner.decide(self._study, self._storage.get_trial(self._trial_id))

    def _ended(self, overrides: list[str]) -> Trial:
        for seed in range(self._config.config.seeds):
            self._seed = seed
            if self._run is None or self._run.status is None:
                self._record(self._made(overrides))
            run = self._runs[seed]
            if run.status in _STATES:
                return self._as_trial(_STATES[run.status])
        by_seed = [run.values for run in self._runs if run.values]
        return self._as_trial(
            "COMPLETE", [sum(column) / len(column) for column in zip(*by_seed, strict=True)]
        )

    def _overrides(self) -> list[str]:
        """Return the trial as overrides of `deepracer-exp train` (of a clone: `clone`)."""
        stored = self._trial.user_attrs.get("overrides")
        if stored is not None:
            return list(stored)
        # Before anything is drawn: the study's cache knows a trial that another process made only once it has read all
        # of them, and not every sampler reads them.
        self._patiently(lambda: self._study.get_trials(deepcopy=False))
        drawn = self._patiently(lambda: self._config.space.suggest(self._trial))
        self._lease.confirm()
        database = resolve_database(self._config.config.storage, self._config.runs_dir)

        def decided() -> list[str]:
            # One worker at a time: two that drew the same together would train the same run.
            with database.creation_lock(self._storage.engine):
                trials = self._study.get_trials(deepcopy=False)
                others = [trial for trial in trials if trial.number != self._number]
                overrides = self._with_own_seed(drawn, others)
                self._trial.set_user_attr("drawn", drawn)
                self._trial.set_user_attr("overrides", overrides)
            return overrides

        return self._patiently(decided)

    def _with_own_seed(self, drawn: list[str], others: Sequence[FrozenTrial]) -> list[str]:
        """Return the drawn overrides, with the next seed if another trial drew the same: it would be the same run."""
        again = sum(trial.user_attrs.get("drawn") == drawn for trial in others)
        if not again:
            return drawn
        seed = self._planned(drawn).experiment.seed
        return [*drawn, f"seed={seed + again * self._config.config.seeds}"]

    def _made(self, overrides: Sequence[str]) -> SeedRun:
        """Make the run of the present seed, and evaluate it."""
        began = time.monotonic()
        if self._run is not None and (lost := self._count_attempt(self._run)) is not None:
            return lost
        outcome = (self._run and self._resumed(self._run)) or self._trained(overrides)
        if outcome.status == INTERRUPTED:
            raise Interrupted
        run = replace(
            self._runs[self._seed],
            status=outcome.status,
            reason=outcome.reason,
            ending=outcome.ending.rule or FINISHED,
            env_steps=outcome.summary["env_steps"],
            wall_clock_s=outcome.summary["wall_clock_s"],
        )
        if outcome.status == FAILED:
            error = outcome.error
            trace = "".join(traceback.format_exception(error)) if error else outcome.reason
            run = _as_failed(run, outcome.reason, trace)
        else:
            try:
                run = replace(run, **self._evaluated(outcome.folder))
            except RunFailed as error:
                run = _as_failed(run, f"evaluation: {error}", traceback.format_exc())
        return replace(run, took_s=round(time.monotonic() - began, 1))

    def _trained(self, overrides: Sequence[str]) -> TrainResult:
        lines = [*overrides, f"name={self._config.study}", f"runs_dir={self._config.runs_dir}"]
        # Where a trial's cars drive is no part of it, and left out of the command that repeats it.
        keys = {key_of(override) for override in overrides}
        where: list[str] = []
        if not keys & {"collector", "collector.mode", "collector.processes"}:
            where = ["collector.mode=in_process", "collector.processes=null"]
        if "collector.threads" not in keys:
            where.append(f"collector.threads={self._config.cores}")
        lines += [*where, *(f"{key}={value}" for key, value in _KEEPS.items() if key not in keys)]
        plan = self._planned(lines)
        experiment = plan.experiment
        if experiment.observation.camera is not None:
            # Several threads update such networks, and the last digits depend on how many.
            self._patiently(lambda: self._trial.set_user_attr("where", where))
        if self._seed:
            plan = self._planned([*lines, f"seed={experiment.seed + self._seed}"])
        title, tags = self._title_and_tags()
        return run_training(
            plan,
            None,
            [self],
            RunReport(),
            run_name=title,
            tags=tags,
            created=self._begin,
            projector=self._projector,
        )

    def _resumed(self, run: SeedRun) -> TrainResult | None:
        """Resume a run that was begun; None if there is nothing to resume."""
        # By its name: a study never leads to a folder elsewhere.
        run_dir = self._config.folder / Path(run.run_dir or "").name
        if not is_run(run_dir):
            return None
        if is_held(run_dir):
            # Its process is suspended or slow and may continue: it keeps the folder.
            run_dir = copy_run(run_dir, self._lease.claim.attempt)
            self._begin(run_dir)
        title, tags = self._title_and_tags()
        try:
            plan = plan_resume(run_dir, [])
            return run_training(
                plan, None, [self], RunReport(), run_name=title, tags=tags, projector=self._projector
            )
        except RunEnded:
            summary = read_object(run_dir / SUMMARY)
            ending = Ending.stored(summary)
            assert ending is not None
            return TrainResult(ending, 0, run_dir, summary)

    def _count_attempt(self, run: SeedRun) -> SeedRun | None:
        """Count another attempt at a run; return it as failed if its process was lost each time so far."""
        run_dir = run.folder(self._config.folder)
        checkpoints = kept_checkpoints(run_dir / CHECKPOINTS)
        iteration = max((int(path.name) for path in checkpoints if path.name.isdecimal()), default=0)
        lost = run.tries if run.tried_at == iteration else 0
        self._record(replace(run, tried_at=iteration, tries=lost + 1))
        if lost < _MOST_TRIES:
            return None
        reason = (
            f"its worker was lost {lost} times after iteration {iteration}: killed, or ended by what it ran"
        )
        last = (_rows(run_dir) or [{}])[-1]
        env_steps, wall_clock_s = last.get("env_steps", 0), last.get("wall_clock_s", 0.0)
        return _as_failed(replace(run, env_steps=env_steps, wall_clock_s=wall_clock_s), reason, reason)

    def _planned(self, overrides: list[str]) -> TrainPlan:
        return plan_trial(overrides, self._config.parent, stored=True)

    def _evaluated(self, folder: Path) -> dict[str, Any]:
        run = StoredRun(folder).with_checkpoint()
        stored = run.read_policy()
        evaluation = Evaluator(run.experiment, self._config.protocol)(stored.networks.policy)
        self._lease.confirm()
        write_evaluation(run.path, evaluation, self._config.protocol, stored)
        usual = evaluation.on(USUAL)
        held_out = evaluation.on(HELD_OUT).completion if HELD_OUT in evaluation.conditions else None
        return {
            "values": objective_values(
                evaluation, self._config.config.objectives, self._config.protocol.time_s
            ),
            "lap_time_s": usual.mean_lap_time_s,
            "completion": usual.completion,
            "held_out_completion": held_out,
            "mlflow_run_id": read_run_id(folder),
        }

    def _title_and_tags(self) -> tuple[str, dict[str, str]]:
        """Return the name and the tags of the present run in MLflow."""
        title = f"trial {self._number}" + (f" s{self._seed}" if self._config.config.seeds > 1 else "")
        tags = {STUDY: self._config.study, TRIAL: str(self._number)}
        return title, tags if self._parent_run_id is None else {**tags, PARENT: self._parent_run_id}

    def _mlflow_parent(self, overrides: Sequence[str], above: Path) -> str | None:
        """Return MLflow's id of the run above those of the trial: the study's, with several seeds one of the trial.

        The latter is described in the folder `above`.
        """
        store, study_run_id = self._config.store, self._config.study_run_id
        if store is not None and self._config.config.seeds == 1:
            # The driver has started the workers before MLflow answered.
            return study_run_id or self._patiently(lambda: self._study.user_attrs.get(RUN_ID))
        if store is None or study_run_id is None:
            return study_run_id
        trial_run_id = open_trial_run(
            above, store, self._config.study, self._number, study_run_id, overrides, self._projector
        )
        return trial_run_id or study_run_id

    def _track(self, ended: Trial, above: Path) -> None:
        """Record the trial's result in MLflow, beside the logs of its runs."""
        if self._config.store is None:
            return
        if self._config.config.seeds > 1:
            folder, is_there = above, self._parent_run_id not in (None, self._config.study_run_id)
        else:
            folder = self._runs[0].folder(self._config.folder)
            is_there = (folder / SUMMARY).exists()
        if not is_there:
            return
        values: dict[str, float | None] = {
            "lap_time": ended.lap_time_s,
            "completion": ended.completion,
            **dict(zip(self._config.config.objectives, ended.values or (), strict=False)),
        }
        status: Status = "FAILED" if ended.state == "FAIL" else "FINISHED"
        end = f"{ended.state.lower()}: {ended.reason}"
        end_trial_run(folder, self._config.store, status, end, trial_metrics(values), self._projector)

    def _patiently(self, call: Callable[[], Value]) -> Value:
        return patiently(call, self._config.config.patience_s)

    def _record(self, run: SeedRun) -> None:
        """Store the present run for a later owner."""
        self._runs[self._seed :] = [run]
        claim = self._lease.claim
        # With the drawn values: a short trial ends before the first renewal.
        progress = self._lease.progress or None
        self._lease.held(lambda: self._claims.record(claim, self._runs, progress))

    @property
    def _run(self) -> SeedRun | None:
        """The run of the present seed, None before it is begun."""
        return self._runs[self._seed] if self._seed < len(self._runs) else None

    def _as_trial(self, state: str, values: list[float] | None = None) -> Trial:
        return Trial(number=self._number, state=state, values=values, runs=tuple(self._runs))


def _as_failed(run: SeedRun, reason: str, trace: str) -> SeedRun:
    return replace(run, status=FAILED, ending=FAILED, reason=reason, traceback=trace)


def _rows(run_dir: Path) -> list[dict[str, Any]]:
    """Return the rows of metrics.jsonl, none before there is a first."""
    metrics = run_dir / METRICS
    return read_metrics(metrics) if metrics.is_file() else []
