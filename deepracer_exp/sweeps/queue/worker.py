"""A worker: makes trial after trial until a study has all of them; a trial is one run per seed."""

import logging
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import optuna
from optuna.storages import BaseStorage, RDBStorage
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.agents.actor_critic import ActorCritic
from deepracer_exp.config.compose import Composition, compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import key_of
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.evaluation.evaluate import write_evaluation
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.result import HELD_OUT, USUAL
from deepracer_exp.lookup.resolve import resolve
from deepracer_exp.runs.checkpoint_files import kept_checkpoints
from deepracer_exp.runs.checkpoints import read_checkpoint
from deepracer_exp.runs.files import (
    CHECKPOINTS,
    METRICS,
    SUMMARY,
    is_run,
    read_metrics,
    read_object,
    read_run_id,
)
from deepracer_exp.runs.folder import is_held
from deepracer_exp.runs.lineage import Lineage
from deepracer_exp.runs.result import FAILED, FINISHED, INTERRUPTED, STOPPED_EARLY
from deepracer_exp.sweeps.search.objectives import intermediate_value, values_of
from deepracer_exp.sweeps.search.pruners import FirstOf, PruneDecision, build_pruner, is_worse_across_seeds
from deepracer_exp.sweeps.search.samplers import build_sampler
from deepracer_exp.tracking.metadata import PARENT, STUDY
from deepracer_exp.tracking.metrics import trial_metrics
from deepracer_exp.tracking.study_run import TRIAL, end_trial_run, open_trial_run
from deepracer_exp.tracking.tracking_file import Status
from deepracer_exp.training.budget import RunEnded
from deepracer_exp.training.clone import prepare_clone
from deepracer_exp.training.run import copy_run, resume, run_training
from deepracer_exp.training.signals import Interruption
from deepracer_exp.training.trainer import Callback, TakenOver, Trainer, TrainResult

from .claims import Claim, Lease, TrialClaims, TrialResult, report_results
from .storage import patiently
from .worker_config import WorkerConfig

Value = TypeVar("Value")
Start = tuple[ActorCritic, Lineage]
Run = dict[str, Any]
"""A run of a trial, as the claim stores it for a later owner."""

_log = logging.getLogger("deepracer_exp")

_WAIT_S = 1.0
"""Between two attempts to claim a trial: another worker's lease may run out."""
_MOST_TRIES = 3
"""How often a run is started or resumed at the same checkpoint if its process is lost each time."""
_SHOWN = ("iteration", "env_steps", "completion", "entropy", "eval_completion", "eval_lap_time_s")
"""Columns of metrics.jsonl for the live view."""


class Interrupted(Exception):  # noqa: N818 - reads as what it is at the raise site
    """The worker was asked to end; the trial resumes another time."""


class Worker:
    """Claims and makes trials of one study, and reports their results."""

    def __init__(self, config: WorkerConfig, storage: RDBStorage, owner: str):
        """Connect to the study; `owner` is this worker's name."""
        self._config, self._storage, self._owner = config, storage, owner
        self._claims = TrialClaims(storage.engine, config.study)
        self._patience_s = config.config.patience_s

    def work(self, interruption: Interruption) -> None:
        """Make trials until all are made or this process is asked to end.

        Raises:
            RunFailed: the database has not answered for too long.
        """
        total, lease_s = self._config.config.trials, self._config.config.lease_s
        while interruption.signum is None:
            self._patiently(lambda: report_results(self._claims, self._storage))
            claim = self._patiently(lambda: self._claims.claim(self._owner, total, lease_s))
            if claim is not None:
                self._make(claim)
            elif self._patiently(lambda: self._claims.is_done(total)):
                return
            else:
                time.sleep(_WAIT_S)
        self._patiently(lambda: self._claims.release(self._owner))

    def _make(self, claim: Claim) -> None:
        with Lease(self._claims, claim, self._config.config.lease_s, self._patience_s) as lease:
            try:
                result = self._result(lease)
                lease.held(lambda: self._claims.settle(claim, result))
            except TakenOver as error:
                _log.warning("%s", error)
                return
            except Interrupted:
                return
        self._patiently(lambda: report_results(self._claims, self._storage))

    def _result(self, lease: Lease) -> TrialResult:
        sampler = build_sampler(self._config.config, self._config.space)
        pruner = build_pruner(self._config.config, self._config.evaluations)
        name, storage = self._config.study, self._storage
        study = self._patiently(
            lambda: optuna.load_study(study_name=name, storage=storage, sampler=sampler, pruner=pruner)
        )
        trial_id = self._trial_id(lease)
        run = self._patiently(lambda: TrialRun(self._config, self._claims, lease, study, storage, trial_id))
        try:
            return run.make()
        except BadInput as error:
            # No run was begun: the drawn values do not go together.
            return run.failed(str(error), "")
        except Exception as error:
            if isinstance(error, TakenOver | Interrupted | RunFailed):
                raise
            # A bug of ours ends this trial, with its traceback, and not the others.
            return run.failed(f"{type(error).__name__}: {error}", traceback.format_exc())

    def _trial_id(self, lease: Lease) -> int:
        """Return the id of the claim's trial in Optuna; create the trial if there is none.

        A trial that is created and not recorded, because its worker is killed in between, is failed at the end of the
        sweep: Optuna is never asked which trials there are.
        """
        if lease.claim.trial_id is not None:
            return lease.claim.trial_id
        lease.confirm()
        storage, index = self._storage, lease.claim.index
        template = optuna.trial.create_trial(state=TrialState.RUNNING, user_attrs={"slot": index})
        trial_id = self._patiently(
            lambda: storage.create_new_trial(storage.get_study_id_from_name(self._config.study), template)
        )
        lease.held(lambda: self._claims.record(lease.claim, trial_id=trial_id))
        return trial_id

    def _patiently(self, call: Callable[[], Value]) -> Value:
        return patiently(call, self._patience_s)


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
        storage: BaseStorage,
        trial_id: int,
    ):
        """Load what is known of the claim's trial, which has this id in Optuna."""
        self._config, self._claims, self._lease = config, claims, lease
        self._study, self._storage, self._trial_id = study, storage, trial_id
        self._trial = optuna.trial.Trial(study, trial_id)
        self._number = self._trial.number
        self._runs: list[Run] = [dict(run) for run in lease.claim.runs]
        self._seed = 0
        """Index of the present run."""
        self._pruned_by: str | None = None
        self._parent_run_id: str | None = None
        """MLflow's id of the run above those of the trial."""

    def make(self) -> TrialResult:
        """Make what is missing of the trial.

        Raises:
            TakenOver: another worker has the trial now.
            Interrupted: the process was asked to end.
            RunFailed: the database has not answered for too long.
        """
        overrides = self._overrides()
        self._parent_run_id = self._mlflow_parent(overrides)
        result = self._result(overrides)
        self._track(result)
        return result

    def failed(self, reason: str, trace: str) -> TrialResult:
        """Return the result of a trial that failed outside its runs."""
        run = {"seed": self._seed, "run_dir": None, "value": None, "env_steps": 0, "wall_clock_s": 0.0}
        run |= self._runs[self._seed] if self._seed < len(self._runs) else {}
        self._runs[self._seed :] = [_as_failed(run, reason, trace or reason)]
        return self._with_attrs("FAIL", None, self._trial.user_attrs.get("overrides", []))

    def on_run_created(self, trainer: Trainer) -> None:
        """Record where the run lies, before it is recorded anywhere else."""
        self._begin(trainer.folder.path)

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Keep the claim and ask the pruners."""
        row = trainer.row
        self._lease.confirm()
        _, spent = trainer.budget.used(*trainer.usage)
        self._show(spent, {name: row.get(name) for name in _SHOWN})
        value = intermediate_value(row, self._config.config.objectives[0], self._config.protocol.time_s)
        if value is None or self._seed > 0:
            return
        decision = self._patiently(lambda: self._asked(value))
        if decision is not None:
            self._pruned_by, reason = decision
            trainer.request_stop(f"{self._pruned_by}: {reason}", STOPPED_EARLY)

    def summary(self, trainer: Trainer) -> dict[str, Any]:
        """Name the trial, and check its claim before the end of the run is written: pictures take a second to draw."""
        self._lease.confirm()
        return {"study": self._config.study, "trial": self._number}

    def _begin(self, run_dir: Path) -> None:
        self._show(0.0, {})
        run = {"seed": self._seed, "run_dir": str(run_dir.resolve()), "status": None, "value": None}
        known = self._runs[self._seed] if self._seed < len(self._runs) else {}
        self._record(run | {key: known[key] for key in ("tries", "tried_at") if key in known})
        # The report draws the curves of running trials.
        self._patiently(lambda: self._trial.set_user_attr("run_dir", run["run_dir"]))

    def _show(self, spent: float, row: dict[str, Any]) -> None:
        """Set what the live view shows, after this share of the present run's budget."""
        share = (self._seed + min(spent, 1.0)) / self._config.config.seeds
        known = {"number": self._number, "params": self._trial.params, "share": share}
        self._lease.progress = {**row, **known}

    def _asked(self, value: float) -> PruneDecision | None:
        """Report an evaluation to Optuna, and return what the pruners decide."""
        if len(self._config.config.objectives) > 1:
            return None  # Optuna compares trials by one number only.
        rows = _rows(Path(self._runs[0]["run_dir"]))
        step = 1 + sum(row["eval_completion"] is not None for row in rows)
        if step not in self._storage.get_trial(self._trial_id).intermediate_values:
            self._trial.report(value, step)
        assert isinstance(self._study.pruner, FirstOf)
        return self._study.pruner.decide(self._study, self._storage.get_trial(self._trial_id))

    def _result(self, overrides: list[str]) -> TrialResult:
        config = self._config.config
        for index in range(config.seeds):
            self._seed = index
            run = self._runs[index] if index < len(self._runs) else None
            if run is None or run["status"] is None:
                run = self._made(index, overrides)
            if run["status"] == FAILED:
                return self._with_attrs("FAIL", None, overrides)
            if run["status"] == STOPPED_EARLY:
                return self._with_attrs("PRUNED", None, overrides)
            so_far = [run["value"][0] for run in self._runs]
            is_last = len(so_far) == config.seeds
            if not is_last and "wilcoxon" in config.pruners and is_worse_across_seeds(self._study, so_far):
                reason = f"worse than the best trial on {len(so_far)} seeds"
                run |= {"outcome": "wilcoxon", "reason": reason}
                return self._with_attrs("PRUNED", None, overrides)
        by_seed = [run["value"] for run in self._runs]
        values = [sum(column) / len(column) for column in zip(*by_seed, strict=True)]
        return self._with_attrs("COMPLETE", values, overrides)

    def _overrides(self) -> list[str]:
        """Return the trial as overrides of `deepracer-exp train` (of a clone: `clone`)."""
        stored = self._trial.user_attrs.get("overrides")
        if stored is not None:
            return list(stored)
        # Before anything is drawn: the study's cache knows a trial that another process made only once it has read all
        # of them, and not every sampler reads them.
        trials = self._patiently(lambda: self._study.get_trials(deepcopy=False))
        drawn = self._patiently(lambda: self._config.space.suggest(self._trial))
        overrides = self._with_own_seed(drawn, [one for one in trials if one.number < self._number])
        self._lease.confirm()
        self._patiently(lambda: self._trial.set_user_attr("drawn", drawn))
        self._patiently(lambda: self._trial.set_user_attr("overrides", overrides))
        return overrides

    def _with_own_seed(self, drawn: list[str], earlier: Sequence[FrozenTrial]) -> list[str]:
        """Return what was drawn, with the next seed if an earlier trial drew the same: it would be the same run."""
        again = sum(trial.user_attrs.get("drawn") == drawn for trial in earlier)
        if not again:
            return drawn
        experiment, _, _ = self._composed(drawn)
        return [*drawn, f"seed={experiment.seed + again * self._config.config.seeds}"]

    def _made(self, index: int, overrides: Sequence[str]) -> Run:
        """Make the run of one seed, evaluate it, and record both."""
        began = time.monotonic()
        known = self._runs[index] if index < len(self._runs) else None
        self._pruned_by = None
        if known is not None and (lost := self._lost_again(known)) is not None:
            self._record(lost)
            return lost
        # By its name: a study never leads to a folder elsewhere.
        outcome = None if known is None else self._resumed(self._config.folder / Path(known["run_dir"]).name)
        if outcome is None:
            outcome = self._trained(index, overrides)
        if outcome.status == INTERRUPTED:
            raise Interrupted
        decision = outcome.summary.get("stopping") or {}
        run = {
            **self._runs[index],
            "status": outcome.status,
            "reason": outcome.reason,
            "outcome": self._pruned_by or decision.get("rule", FINISHED),
            "env_steps": outcome.summary["env_steps"],
            "wall_clock_s": outcome.summary["wall_clock_s"],
        }
        if outcome.status == FAILED:
            error = outcome.error
            trace = "".join(traceback.format_exception(error)) if error else outcome.reason
            run = _as_failed(run, outcome.reason, trace)
        else:
            try:
                run |= self._evaluated(outcome.folder)
            except RunFailed as error:
                run = _as_failed(run, f"evaluation: {error}", traceback.format_exc())
        run["took_s"] = round(time.monotonic() - began, 1)
        self._record(run)
        return run

    def _trained(self, index: int, overrides: Sequence[str]) -> TrainResult:
        own = [*overrides, f"name={self._config.study}", f"runs_dir={self._config.runs_dir}"]
        # Where a trial's cars drive is no part of it, and left out of the command that repeats it.
        given = {key_of(override) for override in overrides}
        where: list[str] = []
        if not given & {"collector", "collector.mode", "collector.processes"}:
            where = ["collector.mode=in_process", "collector.processes=null"]
        if "collector.threads" not in given:
            where.append(f"collector.threads={self._config.cores}")
        own += where if "report" in given else [*where, "report=false"]
        experiment, composition, start = self._composed(own)
        if experiment.observation.camera is not None:
            # Several threads update such networks, and the last digits depend on how many.
            self._patiently(lambda: self._trial.set_user_attr("where", where))
        if index:
            experiment, composition, start = self._composed([*own, f"seed={experiment.seed + index}"])
        title, tags = self._title_and_tags()
        return run_training(experiment, composition, None, start, [self], run_name=title, tags=tags)

    def _resumed(self, run_dir: Path) -> TrainResult | None:
        """Resume a run that was begun; None if there is nothing to resume."""
        if not is_run(run_dir):
            return None
        if is_held(run_dir):
            # Its process is suspended or slow and may wake up: it keeps the folder.
            run_dir = copy_run(run_dir, self._lease.claim.attempt)
            self._begin(run_dir)
        else:
            self._patiently(lambda: self._trial.set_user_attr("run_dir", str(run_dir)))
        title, tags = self._title_and_tags()
        try:
            return resume(run_dir, [], None, [self], run_name=title, tags=tags)
        except RunEnded:
            summary = read_object(run_dir / SUMMARY)
            return TrainResult(summary["status"], summary["reason"], 0, run_dir, summary)

    def _lost_again(self, run: Run) -> Run | None:
        """Count one more attempt at a run; return it as failed if its process was lost each time so far."""
        checkpoints = kept_checkpoints(Path(run["run_dir"]) / CHECKPOINTS)
        at = max((int(path.name) for path in checkpoints if path.name.isdecimal()), default=0)
        lost = run.get("tries", 1) if run.get("tried_at", 0) == at else 0
        self._record(run | {"tried_at": at, "tries": lost + 1})
        if lost < _MOST_TRIES:
            return None
        reason = f"its worker was lost {lost} times after iteration {at}: killed, or ended by what it ran"
        last = (_rows(Path(run["run_dir"])) or [{}])[-1]
        spent = {"env_steps": last.get("env_steps", 0), "wall_clock_s": last.get("wall_clock_s", 0.0)}
        return _as_failed(run | spent, reason, reason)

    def _composed(self, overrides: list[str]) -> tuple[Experiment, Composition, Start | None]:
        if not self._config.parent:
            return *compose_experiment(overrides, stored=True), None
        clone = prepare_clone([*self._config.parent, *overrides], self._config.runs_dir, None, stored=True)
        return clone.experiment, clone.composition, clone.start

    def _evaluated(self, folder: Path) -> dict[str, Any]:
        run = resolve(str(folder), folder.parent, None)
        stored = read_checkpoint(run.experiment, run.checkpoints, run.choose_checkpoint(None))
        evaluation = Evaluator(run.experiment, self._config.protocol)(stored.networks.policy)
        self._lease.confirm()
        write_evaluation(run.path, evaluation, self._config.protocol, stored)
        usual = evaluation.on(USUAL)
        held_out = evaluation.on(HELD_OUT).completion if HELD_OUT in evaluation.conditions else None
        return {
            "value": values_of(evaluation, self._config.config.objectives, self._config.protocol.time_s),
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

    def _mlflow_parent(self, overrides: Sequence[str]) -> str | None:
        """Return MLflow's id of the run above those of the trial: the study's, with several seeds one of the trial."""
        store, study_run_id = self._config.store, self._config.study_run_id
        if store is None or study_run_id is None or self._config.config.seeds == 1:
            return study_run_id
        found = open_trial_run(store, self._config.study, self._number, study_run_id, overrides)
        return found or study_run_id

    def _track(self, result: TrialResult) -> None:
        """Write the trial's result to MLflow, beside what its runs have logged."""
        if self._config.store is None:
            return
        run_id = self._parent_run_id if self._config.config.seeds > 1 else self._runs[0].get("mlflow_run_id")
        if run_id is None or run_id == self._config.study_run_id:
            return
        values: dict[str, float | None] = {
            "lap_time": result.attrs["lap_time_s"],
            "completion": result.attrs["completion"],
            **dict(zip(self._config.config.objectives, result.values or (), strict=False)),
        }
        status: Status = "FAILED" if result.state == "FAIL" else "FINISHED"
        end = f"{result.state.lower()}: {result.attrs['reason']}"
        end_trial_run(self._config.store, self._config.study, run_id, status, end, trial_metrics(values))

    def _patiently(self, call: Callable[[], Value]) -> Value:
        return patiently(call, self._config.config.patience_s)

    def _record(self, run: Run) -> None:
        """Store the present run for a later owner."""
        self._runs[self._seed :] = [run]
        claim = self._lease.claim
        # With what was drawn: a short trial ends before the first renewal.
        progress = self._lease.progress or None
        self._lease.held(lambda: self._claims.record(claim, runs=self._runs, progress=progress))

    def _with_attrs(self, state: str, values: list[float] | None, overrides: list[str]) -> TrialResult:
        """Return a result with attributes: sums and means over the runs; the last one gives outcome and reason."""
        last = self._runs[-1]

        def mean(key: str) -> float | None:
            known = [run[key] for run in self._runs if run.get(key) is not None]
            return sum(known) / len(known) if known else None

        attrs = {
            "slot": self._lease.claim.index,
            "number": self._number,
            "overrides": overrides,
            "attempt": self._lease.claim.attempt,
            "runs": self._runs,
            "run_dir": self._runs[0]["run_dir"],
            "outcome": last["outcome"],
            "reason": last["reason"],
            "env_steps": sum(run["env_steps"] for run in self._runs),
            "wall_clock_s": sum(run["wall_clock_s"] for run in self._runs),
            **{key: mean(key) for key in ("lap_time_s", "completion", "held_out_completion")},
            "mlflow_run_id": self._runs[0].get("mlflow_run_id"),
            **({"traceback": last["traceback"]} if "traceback" in last else {}),
        }
        return TrialResult(state=state, values=values, attrs=attrs)


def _as_failed(run: Run, reason: str, trace: str) -> Run:
    return {**run, "status": FAILED, "outcome": FAILED, "reason": reason, "traceback": trace}


def _rows(run_dir: Path) -> list[dict[str, Any]]:
    """Return the rows of metrics.jsonl, none before there is a first."""
    metrics = run_dir / METRICS
    return read_metrics(metrics) if metrics.is_file() else []
