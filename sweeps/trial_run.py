"""One trial: its runs, one a seed, and what they are worth."""

import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import optuna
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial
from rich.console import Console

from deepracer_exp.agents.actor_critic import ActorCritic
from deepracer_exp.config.compose import Composition, compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import key_of
from deepracer_exp.errors import RunFailed
from deepracer_exp.evaluation.checkpoint import read_checkpoint
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.report import write_json
from deepracer_exp.evaluation.result import HELD_OUT, USUAL
from deepracer_exp.evaluation.run import read_run
from deepracer_exp.formats.checkpoint_files import kept_checkpoints
from deepracer_exp.formats.lineage_file import Lineage
from deepracer_exp.formats.run_files import read_metrics, read_object, read_run_id
from deepracer_exp.tracking.names import PARENT, trial_metrics
from deepracer_exp.tracking.study_run import STUDY, TRIAL, end_trial_run, open_trial_run
from deepracer_exp.tracking.tracking_file import Status
from deepracer_exp.training.budget import Budget
from deepracer_exp.training.clone import prepare_clone
from deepracer_exp.training.outcome import Outcome
from deepracer_exp.training.run import RunEnded, resume, train
from deepracer_exp.training.run_folder import is_held
from deepracer_exp.training.watching import copied

from .lease import Lease
from .ledger import Ledger
from .plan import Plan
from .pruners import AnyPruner, is_beaten_across_seeds
from .score import value_on_the_way, values_of
from .storage import patiently
from .verdict import Verdict

Value = TypeVar("Value")
Start = tuple[ActorCritic, Lineage]
_MOST_TRIES = 3
"""How often a run is begun or gone on with at the same checkpoint, if each time its process is lost."""
_SHOWN = ("iteration", "env_steps", "completion", "entropy", "eval_completion", "eval_lap_time_s")
"""Columns of metrics.jsonl for the live table."""


class Interrupted(Exception):  # noqa: N818 - reads as what it is at the raise site
    """The worker was told to end; the trial goes on another time."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What is told of a trial that has come to its end."""

    outcome: str
    """COMPLETE, PRUNED or FAIL."""
    values: list[float] | None
    attrs: dict[str, Any]
    """User attributes of the trial."""


class TrialRun:
    """Makes the runs of a trial, or goes on with those that somebody else began.

    It watches each of them (`Watch`): keeps the claim, tells Optuna of evaluations on the way and ends what the
    pruners end.
    """

    def __init__(
        self,
        plan: Plan,
        ledger: Ledger,
        lease: Lease,
        study: optuna.Study,
        storage: BaseStorage,
        trial_id: int,
    ):
        """Take what is known of the trial.

        Args:
            plan: of the sweep.
            ledger: where its claim stands.
            lease: of that claim.
            study: with its sampler and pruner.
            storage: of the study.
            trial_id: of Optuna's trial, the one that belongs to the claim.
        """
        self._plan, self._ledger, self._lease = plan, ledger, lease
        self._study, self._storage, self._trial_id = study, storage, trial_id
        self._trial = optuna.trial.Trial(study, trial_id)
        self._slot = lease.claim.slot
        self._runs: list[dict[str, Any]] = [dict(run) for run in lease.claim.runs]
        self._pruned_by: str | None = None
        self._now = 0
        self._number = self._trial.number
        self._above: str | None = None
        """MLflow's id of the run above those of the trial."""

    @property
    def tags(self) -> dict[str, str]:
        """What the run is tagged with in MLflow."""
        tags = {STUDY: self._plan.study, TRIAL: str(self._number)}
        return tags if self._above is None else {**tags, PARENT: self._above}

    @property
    def title(self) -> str:
        """What the run is called in MLflow."""
        return f"trial {self._number}" + (f" s{self._now}" if self._plan.config.seeds > 1 else "")

    def make(self) -> Result:
        """Make what is missing of the trial.

        Raises:
            TakenOver: somebody else has the trial now.
            Interrupted: the process was told to end.
            RunFailed: the database has not answered for too long.
        """
        overrides, attempt = self._overrides(), self._lease.claim.attempt
        attrs = {"slot": self._slot, "number": self._number, "overrides": overrides, "attempt": attempt}
        result = self._result(overrides, attrs)
        self._record(result)
        return result

    def _result(self, overrides: Sequence[str], attrs: Mapping[str, Any]) -> Result:
        self._above = self._recorded_above(overrides)
        for index in range(self._plan.config.seeds):
            self._now = index
            done = self._runs[index] if index < len(self._runs) else None
            if done is None or done["status"] is None:
                done = self._made(index, overrides)
            if done["status"] == "failed":
                return Result(outcome="FAIL", values=None, attrs=self._told(attrs))
            if done["status"] == "hopeless":
                return Result(outcome="PRUNED", values=None, attrs=self._told(attrs))
            so_far = [run["value"][0] for run in self._runs]
            left = self._plan.config.seeds - len(so_far)
            if (
                left
                and "wilcoxon" in self._plan.config.pruners
                and is_beaten_across_seeds(self._study, so_far)
            ):
                done |= {"fate": "wilcoxon", "reason": f"beaten on {len(so_far)} seeds by the best trial"}
                return Result(outcome="PRUNED", values=None, attrs=self._told(attrs))
        by_seed = [run["value"] for run in self._runs]
        values = [sum(column) / len(column) for column in zip(*by_seed, strict=True)]
        return Result(outcome="COMPLETE", values=values, attrs=self._told(attrs))

    def failed(self, reason: str, trace: str) -> Result:
        """Return the result of a trial that failed outside its runs."""
        run = {"seed": self._now, "run_dir": None, "status": "failed", "value": None, "env_steps": 0}
        run |= self._runs[self._now] if self._now < len(self._runs) else {}
        run |= {"status": "failed", "fate": "failed", "reason": reason, "traceback": trace or reason}
        self._runs[self._now :] = [{"wall_clock_s": 0.0, **run}]
        overrides = self._trial.user_attrs.get("overrides", [])
        attempt = self._lease.claim.attempt
        attrs = {"slot": self._slot, "number": self._number, "overrides": overrides, "attempt": attempt}
        return Result(outcome="FAIL", values=None, attrs=self._told(attrs))

    def begins(self, run_dir: Path) -> None:
        """Note where the run lies, before it is recorded anywhere."""
        self._lease.show({"number": self._number, "params": self._trial.params, "share": self._share(0.0)})
        run = {"seed": self._now, "run_dir": str(run_dir.resolve()), "status": None, "value": None}
        known = self._runs[self._now] if self._now < len(self._runs) else {}
        self._note(self._now, run | {key: known[key] for key in ("tries", "tried_at") if key in known})
        # The entropy pruner reads the run's rows there.
        self._patiently(lambda: self._trial.set_user_attr("run_dir", run["run_dir"]))

    def sees(self, row: Mapping[str, Any]) -> str | None:
        """Keep the claim and ask the pruners."""
        self._lease.confirm()
        _, spent = self._budget.used(row["env_steps"], row["iteration"], row["wall_clock_s"])
        known = {"number": self._number, "params": self._trial.params, "share": self._share(spent)}
        self._lease.show({name: row.get(name) for name in _SHOWN} | known)
        value = value_on_the_way(row, self._plan.config.objectives[0], self._plan.protocol.time_s)
        if value is None or self._now > 0:
            return None
        verdict = self._patiently(lambda: self._compared(value))
        if verdict is None:
            return None
        self._pruned_by, reason = verdict
        return f"{self._pruned_by}: {reason}"

    def _share(self, spent: float) -> float:
        """Return how much of the trial is made, 0 to 1, where `spent` is that share of the present run's budget."""
        return (self._now + min(spent, 1.0)) / self._plan.config.seeds

    def _compared(self, value: float) -> Verdict | None:
        """Tell Optuna of an evaluation, and return what the pruners say."""
        if len(self._plan.config.objectives) == 1:
            # Optuna compares trials by one number only.
            rows = _rows(Path(self._runs[0]["run_dir"]))
            step = 1 + sum(row["eval_completion"] is not None for row in rows)
            if step not in self._storage.get_trial(self._trial_id).intermediate_values:
                self._trial.report(value, step)
        assert isinstance(self._study.pruner, AnyPruner)
        return self._study.pruner.verdict(self._study, self._storage.get_trial(self._trial_id))

    def _overrides(self) -> list[str]:
        """Return what the trial is, as told to `deepracer-exp train` (of a clone: `clone`)."""
        told = self._trial.user_attrs.get("overrides")
        if told is None:
            # Before anything is drawn: the study's cache knows a trial that it has not made itself once it has read all
            # of them, and not every sampler asks for them.
            trials = self._patiently(lambda: self._study.get_trials(deepcopy=False))
            drawn = self._patiently(lambda: self._plan.space.suggest(self._trial))
            told = self._with_own_seed(drawn, [one for one in trials if one.number < self._number])
            self._lease.confirm()
            self._patiently(lambda: self._trial.set_user_attr("drawn", drawn))
            self._patiently(lambda: self._trial.set_user_attr("overrides", told))
        return list(told)

    def _with_own_seed(self, drawn: list[str], earlier: Sequence[FrozenTrial]) -> list[str]:
        """Return what was drawn, with the next seed if an earlier trial drew the same: it would be the same run."""
        again = sum(trial.user_attrs.get("drawn") == drawn for trial in earlier)
        if not again:
            return drawn
        experiment, _, _ = self._composed(drawn)
        return [*drawn, f"seed={experiment.seed + again * self._plan.config.seeds}"]

    def _made(self, index: int, overrides: Sequence[str]) -> dict[str, Any]:
        """Make the run of one seed, evaluate it, and note both."""
        began = time.monotonic()
        known = self._runs[index] if index < len(self._runs) else None
        self._pruned_by = None
        if known is not None and (lost := self._lost_again(known)) is not None:
            self._note(index, lost)
            return lost
        self._budget = Budget(self._composed(list(overrides))[0].budget)
        outcome = None if known is None else self._gone_on(Path(known["run_dir"]))
        if outcome is None:
            outcome = self._trained(index, overrides)
        if outcome.status == "interrupted":
            raise Interrupted
        decision = outcome.summary.get("stopping") or {}
        run = {
            **self._runs[index],
            "status": outcome.status,
            "reason": outcome.reason,
            "fate": "failed"
            if outcome.status == "failed"
            else self._pruned_by or decision.get("rule", "finished"),
            "env_steps": outcome.summary["env_steps"],
            "wall_clock_s": outcome.summary["wall_clock_s"],
        }
        if outcome.status == "failed":
            error = outcome.error
            run["traceback"] = "".join(traceback.format_exception(error)) if error else outcome.reason
        else:
            try:
                run |= self._evaluated(outcome.folder)
            except RunFailed as error:
                run |= {"status": "failed", "fate": "failed", "reason": f"evaluation: {error}"}
                run["traceback"] = traceback.format_exc()
        run["took_s"] = round(time.monotonic() - began, 1)
        self._note(index, run)
        return self._runs[index]

    def _trained(self, index: int, overrides: Sequence[str]) -> Outcome:
        own = [*overrides, f"name={self._plan.study}", f"runs_dir={self._plan.runs_dir}"]
        # How a worker runs what was drawn: no part of the trial, and left out of the line that repeats it.
        given = {key_of(override) for override in overrides}
        usual = ("collector=in_process", f"collector.threads={self._plan.cores}", "report=false")
        own += [override for override in usual if key_of(override) not in given]
        experiment, composition, start = self._composed(own)
        if index:
            experiment, composition, start = self._composed([*own, f"seed={experiment.seed + index}"])
        return train(experiment, composition, Console(quiet=True), start, self)

    def _lost_again(self, run: dict[str, Any]) -> dict[str, Any] | None:
        """Count that a run is gone on with; return it as failed where it takes its process with it each time."""
        kept = [
            path for path in kept_checkpoints(Path(run["run_dir"]) / "checkpoints") if path.name.isdecimal()
        ]
        at = int(kept[0].name) if kept else 0
        lost = run.get("tries", 1) if run.get("tried_at", 0) == at else 0
        self._note(self._now, run | {"tried_at": at, "tries": lost + 1})
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
        if not self._plan.parent:
            return *compose_experiment(overrides), None
        clone = prepare_clone([*self._plan.parent, *overrides], self._plan.runs_dir, None)
        return clone.experiment, clone.composition, clone.start

    def _gone_on(self, run_dir: Path) -> Outcome | None:
        """Go on with a run that was begun; None if there is nothing to go on with."""
        if not (run_dir / "config.yaml").is_file():
            return None
        if is_held(run_dir):
            # Its process is stopped or slow, and may wake up: it keeps the folder.
            run_dir = copied(run_dir, self._lease.claim.attempt)
            self.begins(run_dir)
        else:
            self._patiently(lambda: self._trial.set_user_attr("run_dir", str(run_dir)))
        try:
            return resume(run_dir, [], Console(quiet=True), self)
        except RunEnded:
            summary = read_object(run_dir / "summary.json")
            return Outcome(summary["status"], summary["reason"], 0, run_dir, summary)

    def _evaluated(self, folder: Path) -> dict[str, Any]:
        run = read_run(str(folder), folder.parent, None)
        stored = read_checkpoint(run.experiment, run.checkpoints, run.meant(None))
        evaluation = Evaluator(run.experiment, self._plan.protocol)(stored.networks.policy)
        self._lease.confirm()
        write_json(run.path, evaluation, self._plan.protocol, stored)
        usual = evaluation.on(USUAL)
        held_out = evaluation.on(HELD_OUT).completion if HELD_OUT in evaluation.conditions else None
        return {
            "value": values_of(evaluation, self._plan.config.objectives, self._plan.protocol.time_s),
            "lap_time_s": usual.mean_lap_time_s,
            "completion": usual.completion,
            "held_out_completion": held_out,
            "mlflow_run_id": read_run_id(folder),
        }

    def _recorded_above(self, overrides: Sequence[str]) -> str | None:
        """Return MLflow's id of the run that those of the trial stand under."""
        store, study_run_id = self._plan.store, self._plan.study_run_id
        if store is None or study_run_id is None or self._plan.config.seeds == 1:
            return study_run_id
        found = open_trial_run(store, self._plan.study, self._number, study_run_id, overrides)
        return found or study_run_id

    def _record(self, result: Result) -> None:
        """Let MLflow have what came out of the trial, beside what its runs have told."""
        if self._plan.store is None:
            return
        above = self._above if self._plan.config.seeds > 1 else self._runs[0].get("mlflow_run_id")
        if above is None or above == self._plan.study_run_id:
            return
        values: dict[str, float | None] = {
            "lap_time": result.attrs["lap_time_s"],
            "completion": result.attrs["completion"],
            **dict(zip(self._plan.config.objectives, result.values or (), strict=False)),
        }
        metrics = trial_metrics(values)
        status: Status = "FAILED" if result.outcome == "FAIL" else "FINISHED"
        told = f"{result.outcome.lower()}: {result.attrs['reason']}"
        end_trial_run(self._plan.store, self._plan.study, above, status, told, metrics)

    def _patiently(self, call: Callable[[], Value]) -> Value:
        return patiently(call, self._plan.config.patience_s)

    def _note(self, index: int, run: dict[str, Any]) -> None:
        self._runs[index:] = [run]
        claim = self._lease.claim
        self._lease.held(lambda: self._ledger.note(claim, runs=self._runs))

    def _told(self, attrs: Mapping[str, Any]) -> dict[str, Any]:
        """Return the trial's attributes: sums and means over its runs; how it ended is said by the last one."""
        last = self._runs[-1]

        def mean(key: str) -> float | None:
            known = [run[key] for run in self._runs if run.get(key) is not None]
            return sum(known) / len(known) if known else None

        return {
            **attrs,
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


def _rows(run_dir: Path) -> list[dict[str, Any]]:
    """Return the rows of metrics.jsonl, none before there is a first."""
    metrics = run_dir / "metrics.jsonl"
    return read_metrics(metrics) if metrics.is_file() else []
