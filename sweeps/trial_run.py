"""One trial: its runs, one per seed, and its values."""

import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import optuna
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial

from deepracer_exp.agents.actor_critic import ActorCritic
from deepracer_exp.config.compose import Composition, compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import key_of
from deepracer_exp.errors import RunFailed
from deepracer_exp.evaluation.evaluate import write_evaluation
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.result import HELD_OUT, USUAL
from deepracer_exp.runs.checkpoint_files import kept_checkpoints
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
from deepracer_exp.runs.read_checkpoint import read_checkpoint
from deepracer_exp.runs.resolve import resolve
from deepracer_exp.tracking.metadata import PARENT
from deepracer_exp.tracking.metrics import trial_metrics
from deepracer_exp.tracking.study_run import STUDY, TRIAL, end_trial_run, open_trial_run
from deepracer_exp.tracking.tracking_file import Status
from deepracer_exp.training.budget import Budget
from deepracer_exp.training.clone import prepare_clone
from deepracer_exp.training.run import RunEnded, copy_run, resume, train
from deepracer_exp.training.trainer import STOPPED_EARLY, Callback, Trainer, TrainResult

from .claims import Lease, TrialClaims, TrialResult
from .objectives import intermediate_value, values_of
from .pruners import AnyPruner, PruneDecision, is_worse_across_seeds
from .storage import patiently
from .worker_config import WorkerConfig

Value = TypeVar("Value")
Start = tuple[ActorCritic, Lineage]
_MOST_TRIES = 3
"""How often a run is started or resumed at the same checkpoint if its process is lost each time."""
_SHOWN = ("iteration", "env_steps", "completion", "entropy", "eval_completion", "eval_lap_time_s")
"""Columns of metrics.jsonl for the live view."""


class Interrupted(Exception):  # noqa: N818 - reads as what it is at the raise site
    """The worker was asked to end; the trial resumes another time."""


class TrialRun(Callback):
    """Makes the runs of a trial, or resumes those that an earlier worker began.

    It is a callback of each run: keeps the claim, reports evaluations to Optuna and asks the pruners.
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
        """Load what is known of the trial.

        Args:
            config: of the worker.
            claims: of the study.
            lease: of the trial's claim.
            study: with its sampler and pruner.
            storage: of the study.
            trial_id: Optuna's id of the claim's trial.
        """
        self._config, self._claims, self._lease = config, claims, lease
        self._study, self._storage, self._trial_id = study, storage, trial_id
        self._trial = optuna.trial.Trial(study, trial_id)
        self._number = self._trial.number
        self._runs: list[dict[str, Any]] = [dict(run) for run in lease.claim.runs]
        self._seed = 0
        """Index of the present run."""
        self._pruned_by: str | None = None
        self._parent_run_id: str | None = None
        """MLflow's id of the run above those of the trial."""

    @property
    def tags(self) -> dict[str, str]:
        """Tags of the run in MLflow."""
        tags = {STUDY: self._config.study, TRIAL: str(self._number)}
        return tags if self._parent_run_id is None else {**tags, PARENT: self._parent_run_id}

    @property
    def title(self) -> str:
        """Name of the run in MLflow."""
        return f"trial {self._number}" + (f" s{self._seed}" if self._config.config.seeds > 1 else "")

    def make(self) -> TrialResult:
        """Make what is missing of the trial.

        Raises:
            TakenOver: another worker has the trial now.
            Interrupted: the process was asked to end.
            RunFailed: the database has not answered for too long.
        """
        overrides = self._overrides()
        result = self._result(overrides)
        self._track(result)
        return result

    def failed(self, reason: str, trace: str) -> TrialResult:
        """Return the result of a trial that failed outside its runs."""
        run = {"seed": self._seed, "run_dir": None, "status": "failed", "value": None, "env_steps": 0}
        run |= self._runs[self._seed] if self._seed < len(self._runs) else {}
        run |= {"status": "failed", "fate": "failed", "reason": reason, "traceback": trace or reason}
        self._runs[self._seed :] = [{"wall_clock_s": 0.0, **run}]
        return self._with_attrs("FAIL", None, self._trial.user_attrs.get("overrides", []))

    def on_run_created(self, trainer: Trainer) -> None:
        """Record where the run lies, before it is recorded anywhere else."""
        self._begin(trainer.folder.path)

    def _begin(self, run_dir: Path) -> None:
        self._lease.show({"number": self._number, "params": self._trial.params, "share": self._share(0.0)})
        run = {"seed": self._seed, "run_dir": str(run_dir.resolve()), "status": None, "value": None}
        known = self._runs[self._seed] if self._seed < len(self._runs) else {}
        self._record(self._seed, run | {key: known[key] for key in ("tries", "tried_at") if key in known})
        # The entropy pruner reads the run's rows there.
        self._patiently(lambda: self._trial.set_user_attr("run_dir", run["run_dir"]))

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Keep the claim and ask the pruners."""
        row = trainer.row
        self._lease.confirm()
        _, spent = self._budget.used(row["env_steps"], row["iteration"], row["wall_clock_s"])
        known = {"number": self._number, "params": self._trial.params, "share": self._share(spent)}
        self._lease.show({name: row.get(name) for name in _SHOWN} | known)
        value = intermediate_value(row, self._config.config.objectives[0], self._config.protocol.time_s)
        if value is None or self._seed > 0:
            return
        decision = self._patiently(lambda: self._asked(value))
        if decision is not None:
            self._pruned_by, reason = decision
            trainer.request_stop(f"{self._pruned_by}: {reason}", STOPPED_EARLY)

    def _share(self, spent: float) -> float:
        """Return the share of the trial that is made, 0 to 1, after this share of the present run's budget."""
        return (self._seed + min(spent, 1.0)) / self._config.config.seeds

    def _asked(self, value: float) -> PruneDecision | None:
        """Report an evaluation to Optuna, and return what the pruners decide."""
        if len(self._config.config.objectives) == 1:
            # Optuna compares trials by one number only.
            rows = _rows(Path(self._runs[0]["run_dir"]))
            step = 1 + sum(row["eval_completion"] is not None for row in rows)
            if step not in self._storage.get_trial(self._trial_id).intermediate_values:
                self._trial.report(value, step)
        assert isinstance(self._study.pruner, AnyPruner)
        return self._study.pruner.decide(self._study, self._storage.get_trial(self._trial_id))

    def _result(self, overrides: list[str]) -> TrialResult:
        config = self._config.config
        self._parent_run_id = self._mlflow_parent(overrides)
        for index in range(config.seeds):
            self._seed = index
            run = self._runs[index] if index < len(self._runs) else None
            if run is None or run["status"] is None:
                run = self._made(index, overrides)
            if run["status"] == "failed":
                return self._with_attrs("FAIL", None, overrides)
            if run["status"] == "hopeless":
                return self._with_attrs("PRUNED", None, overrides)
            so_far = [run["value"][0] for run in self._runs]
            is_last = len(so_far) == config.seeds
            if not is_last and "wilcoxon" in config.pruners and is_worse_across_seeds(self._study, so_far):
                reason = f"worse than the best trial on {len(so_far)} seeds"
                run |= {"fate": "wilcoxon", "reason": reason}
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

    def _made(self, index: int, overrides: Sequence[str]) -> dict[str, Any]:
        """Make the run of one seed, evaluate it, and record both."""
        began = time.monotonic()
        known = self._runs[index] if index < len(self._runs) else None
        self._pruned_by = None
        if known is not None and (lost := self._lost_again(known)) is not None:
            self._record(index, lost)
            return lost
        self._budget = Budget(self._composed(list(overrides))[0].budget)
        outcome = None if known is None else self._resumed(Path(known["run_dir"]))
        if outcome is None:
            outcome = self._trained(index, overrides)
        if outcome.status == "interrupted":
            raise Interrupted
        decision = outcome.summary.get("stopping") or {}
        run = {
            **self._runs[index],
            "status": outcome.status,
            "reason": outcome.reason,
            "fate": self._pruned_by or decision.get("rule", "finished"),
            "env_steps": outcome.summary["env_steps"],
            "wall_clock_s": outcome.summary["wall_clock_s"],
        }
        if outcome.status == "failed":
            error = outcome.error
            run["fate"] = "failed"
            run["traceback"] = "".join(traceback.format_exception(error)) if error else outcome.reason
        else:
            try:
                run |= self._evaluated(outcome.folder)
            except RunFailed as error:
                run |= {"status": "failed", "fate": "failed", "reason": f"evaluation: {error}"}
                run["traceback"] = traceback.format_exc()
        run["took_s"] = round(time.monotonic() - began, 1)
        self._record(index, run)
        return self._runs[index]

    def _trained(self, index: int, overrides: Sequence[str]) -> TrainResult:
        own = [*overrides, f"name={self._config.study}", f"runs_dir={self._config.runs_dir}"]
        # How a worker runs what was drawn: no part of the trial, and left out of the command that repeats it.
        given = {key_of(override) for override in overrides}
        usual = ("collector=in_process", f"collector.threads={self._config.cores}", "report=false")
        own += [override for override in usual if key_of(override) not in given]
        experiment, composition, start = self._composed(own)
        if index:
            experiment, composition, start = self._composed([*own, f"seed={experiment.seed + index}"])
        return train(experiment, composition, None, start, [self], run_name=self.title, tags=self.tags)

    def _lost_again(self, run: dict[str, Any]) -> dict[str, Any] | None:
        """Count one more attempt at a run; return it as failed if its process was lost each time so far."""
        kept = [
            path for path in kept_checkpoints(Path(run["run_dir"]) / CHECKPOINTS) if path.name.isdecimal()
        ]
        at = int(kept[0].name) if kept else 0
        lost = run.get("tries", 1) if run.get("tried_at", 0) == at else 0
        self._record(self._seed, run | {"tried_at": at, "tries": lost + 1})
        if lost < _MOST_TRIES:
            return None
        reason = f"its worker was lost {lost} times after iteration {at}: killed, or ended by what it ran"
        last = (_rows(Path(run["run_dir"])) or [{}])[-1]
        return {
            **run,
            "status": "failed",
            "fate": "failed",
            "reason": reason,
            "traceback": reason,
            "env_steps": last.get("env_steps", 0),
            "wall_clock_s": last.get("wall_clock_s", 0.0),
        }

    def _composed(self, overrides: list[str]) -> tuple[Experiment, Composition, Start | None]:
        if not self._config.parent:
            return *compose_experiment(overrides), None
        clone = prepare_clone([*self._config.parent, *overrides], self._config.runs_dir, None)
        return clone.experiment, clone.composition, clone.start

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
        try:
            return resume(run_dir, [], None, [self], run_name=self.title, tags=self.tags)
        except RunEnded:
            summary = read_object(run_dir / SUMMARY)
            return TrainResult(summary["status"], summary["reason"], 0, run_dir, summary)

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

    def _record(self, index: int, run: dict[str, Any]) -> None:
        self._runs[index:] = [run]
        claim = self._lease.claim
        self._lease.held(lambda: self._claims.record(claim, runs=self._runs))

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
            "fate": last["fate"],
            "reason": last["reason"],
            "env_steps": sum(run["env_steps"] for run in self._runs),
            "wall_clock_s": sum(run["wall_clock_s"] for run in self._runs),
            "lap_time_s": mean("lap_time_s"),
            "completion": mean("completion"),
            "held_out_completion": mean("held_out_completion"),
            "mlflow_run_id": self._runs[0].get("mlflow_run_id"),
            **({"traceback": last["traceback"]} if "traceback" in last else {}),
        }
        return TrialResult(state=state, values=values, attrs=attrs)


def _rows(run_dir: Path) -> list[dict[str, Any]]:
    """Return the rows of metrics.jsonl, none before there is a first."""
    metrics = run_dir / METRICS
    return read_metrics(metrics) if metrics.is_file() else []
