"""The callbacks of every training, in their order: one concern each."""

import json
import logging
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import RunFailed
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.results import AMONG_OTHERS, NOT_EVALUATED, eval_columns
from deepracer_exp.runs.run_result import Ending
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.tracking.delivery import ENDS
from deepracer_exp.tracking.metadata import END_TAG, joined
from deepracer_exp.tracking.mlflow_metrics import now_ms
from deepracer_exp.tracking.tracker import FINISH_S, Tracker
from deepracer_exp.training.stopping.stopping_rules import Decision, StoppingRule, build_rule

from .budget import Alerts
from .display import ProgressDisplay, RunHeader
from .machine import machine_use
from .train_result import TrainResult
from .trainer import Callback, Trainer

logger = logging.getLogger("deepracer_exp")


def standard_callbacks(
    experiment: Experiment,
    setup: RaceSetup,
    names: Mapping[str, str],
    tracker: Tracker,
    console: Console,
    users: Sequence[Callback] = (),
    report: Callback | None = None,
    rival: StoredRun | None = None,
) -> list[Callback]:
    """Return the callbacks of a run in the order in which they are called.

    `users` are the caller's, called after evaluation and stopping rule and before anything is recorded: columns that
    they add to `trainer.row` are recorded, and an iteration at which one raises is not. `report` makes
    pictures and pages of what is recorded, which are tracked like the rest. `rival` is the other run that the
    evaluation races against, too; None: it has none, or its own snapshots.

    Raises:
        BadInput: files or values of the evaluation or the alerts cannot be used.
    """
    return [
        EvalCallback(experiment, console, rival),
        StoppingCallback(build_rule(experiment.stopping, setup.actions.n), tracker),
        *users,
        BudgetCallback(Alerts(experiment.budget), tracker),
        RecordCallback(),
        *([] if report is None else [report]),
        TrackingCallback(tracker, console),
        DisplayCallback(names, console),
    ]


class EvalCallback(Callback):
    """Evaluates the policy every few iterations, always on the same trials of the group `evaluation`."""

    def __init__(self, experiment: Experiment, console: Console, rival: StoredRun | None = None):
        """Read the protocol of the evaluation; `rival` as for `standard_callbacks`.

        Raises:
            BadInput: a track or a condition is unknown or malformed.
        """
        self._every = experiment.checkpoints.every
        self._console = console
        sees = None if rival is None else rival.experiment.observation
        # Cars in this process wait for the evaluation; workers drive the next batch during it.
        collector = experiment.collector
        threads = collector.threads if collector.mode == "in_process" else 1
        self._evaluator = (
            None
            if self._every is None
            else Evaluator(experiment, experiment.evaluation, threads, rival_sees=sees)
        )

    def on_replay(self, trainer: Trainer) -> None:
        """Remove an evaluation that was made only because the run had ended."""
        if not self._is_due(trainer.row["iteration"]):
            trainer.row |= NOT_EVALUATED
            for column in AMONG_OTHERS:
                trainer.row.pop(column, None)

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Evaluate when due, and keep a checkpoint of the evaluated policy."""
        if self._is_due(trainer.iteration):
            self._evaluate(trainer)
            trainer.request_save()

    def on_train_end(self, trainer: Trainer) -> None:
        """Evaluate the last policy even if no evaluation is due: it may be the best.

        The evaluation is written to metrics.jsonl and the summary but to no checkpoint, so that a resumed run equals an
        uninterrupted one.
        """
        if self._evaluator is not None and trainer.iteration and not self._is_due(trainer.iteration):
            self._console.print(f"evaluating the policy of iteration {trainer.iteration}")
            self._evaluate(trainer)

    def _is_due(self, iteration: int) -> bool:
        return self._every is not None and iteration % self._every == 0

    def _evaluate(self, trainer: Trainer) -> None:
        assert self._evaluator is not None
        rival = None if trainer.rivals is None else trainer.rivals.newest_policy(trainer.iteration)
        trainer.evaluation = self._evaluator(trainer.networks.policy, rival=rival)
        trainer.row |= eval_columns(trainer.evaluation)


class StoppingCallback(Callback):
    """Ends the run by its stopping rule."""

    def __init__(self, rule: StoppingRule, tracker: Tracker):
        self._rule, self._tracker = rule, tracker
        self._decision: Decision | None = None
        self._reliable: dict[str, float] | None = None

    def on_replay(self, trainer: Trainer) -> None:
        """Pass a row that the rule has seen before."""
        self._observe(trainer)

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Apply the rule to the new row."""
        self._observe(trainer)
        if self._decision is not None and self._decision.rule == "reliable":
            self._reliable = trainer.moment()

    def on_run_end(self, trainer: Trainer, result: TrainResult) -> None:
        """Tag the run with the decision."""
        for tag, value in (self._decision.tags() if self._decision else {}).items():
            self._tracker.set_tag(tag, value)

    def state_dict(self) -> dict[str, Any]:
        """Return when the run became reliable."""
        return {"reliable": self._reliable}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore it."""
        self._reliable = state["reliable"]

    def summary(self, trainer: Trainer) -> dict[str, Any]:
        """Return the decision."""
        return {"stopping": self._decision and self._decision.as_dict(), "reliable": self._reliable}

    def _observe(self, trainer: Trainer) -> None:
        decision = self._rule.observe(trainer.row)
        try:  # before it is part of the summary, which is written even of a run that fails
            json.dumps(decision and decision.as_dict())
        except (AttributeError, TypeError) as error:
            raise RunFailed(
                f"{self._rule.__class__.__name__}.observe returned {decision!r}: {error}"
            ) from error
        self._decision = decision
        if self._decision is not None:
            trainer.request_stop(self._decision.ending)


class BudgetCallback(Callback):
    """Ends the run when a limit is reached, and sends alerts on the way."""

    def __init__(self, alerts: Alerts, tracker: Tracker):
        self._alerts, self._tracker = alerts, tracker

    def on_fit_start(self, trainer: Trainer) -> None:
        """Stop if the budget is used up; earlier use needs no alert."""
        self._check(trainer)
        trainer.budget.alerts(*trainer.usage)

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Compare the use with the limits."""
        self._check(trainer)
        for alert in trainer.budget.alerts(*trainer.usage):
            logger.info(alert.message)
            self._tracker.set_tag(f"budget.{alert.limit}", f"{alert.percent}%")
            self._alerts.send(alert.message, trainer.folder.path)

    def on_run_end(self, trainer: Trainer, result: TrainResult) -> None:
        """Wait for alerts still on their way."""
        self._alerts.close()

    def on_release(self, trainer: Trainer) -> None:
        """Wait for alerts still on their way."""
        self._alerts.close()

    def _check(self, trainer: Trainer) -> None:
        limit, fraction = trainer.budget.used(*trainer.usage)
        if fraction >= 1:
            trainer.request_stop(Ending.by_budget(limit))


class RecordCallback(Callback):
    """Writes metrics.jsonl."""

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Append the row."""
        trainer.folder.append_metrics(trainer.row)

    def on_train_end(self, trainer: Trainer) -> None:
        """Put the last evaluation into the last row."""
        if trainer.evaluation is not None:
            trainer.folder.write_metrics([*trainer.folder.metrics()[:-1], trainer.row])


class TrackingCallback(Callback):
    """Passes rows and tags to the tracker, and writes machine.jsonl."""

    def __init__(self, tracker: Tracker, console: Console):
        self._tracker, self._console = tracker, console

    def on_replay(self, trainer: Trainer) -> None:
        """Log the row again: the tracker may lack some."""
        self._log(trainer)

    def on_fit_start(self, trainer: Trainer) -> None:
        """Begin to measure the use of the machine."""
        machine_use(trainer.experiment.device)

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Log the row, and write the use of the machine, which is not part of the record, beside it."""
        self._log(trainer)
        use = machine_use(trainer.experiment.device)
        trainer.folder.append_machine_use({"env_steps": trainer.env_steps, "time_ms": now_ms(), **use})

    def on_train_end(self, trainer: Trainer) -> None:
        """Log the last evaluation of a run that is over; of one that may be resumed, the tracker would keep it."""
        if trainer.evaluation is not None and not trainer.is_interrupted:
            self._tracker.log(eval_columns(trainer.evaluation), step=trainer.env_steps)

    def on_run_end(self, trainer: Trainer, result: TrainResult) -> None:
        """Let the tracker end the run; the result names missing records."""
        self._tracker.set_tag(END_TAG, str(result.ending))
        if self._tracker.outage is not None:
            line = f"{self._tracker.outage}; waiting for at most {FINISH_S:g} s"
            self._console.print(line, soft_wrap=True)
        self._tracker.finish(ENDS.get(result.status, "KILLED"))
        result.unrecorded = self._tracker.failure

    def on_release(self, trainer: Trainer) -> None:
        """End the run in the store as killed."""
        self._tracker.set_tag(END_TAG, "taken over")
        self._tracker.finish("KILLED")

    def _log(self, trainer: Trainer) -> None:
        metrics = {key: value for key, value in trainer.row.items() if key != "env_steps"}
        self._tracker.log(metrics, step=trainer.row["env_steps"])


class DisplayCallback(Callback):
    """Shows the progress in the terminal."""

    def __init__(self, names: Mapping[str, str], console: Console):
        self._names, self._console = names, console
        self._display: ProgressDisplay | None = None

    def on_fit_start(self, trainer: Trainer) -> None:
        """Show the view before the cars: workers take a second or two to start."""
        if trainer.ending is None:
            names, metrics = self._names, trainer.metrics
            header = RunHeader(
                name=trainer.folder.name,
                track=joined([course.tracks[0].title for course in trainer.setup.courses], " + "),
                track_labels=tuple(metrics.labels),
                remembered=metrics.remembered,
                reward=names["reward"],
                network=names["network"],
                actions=names["action_space"],
                algorithm=str(trainer.agent),
                budget=str(trainer.budget),
                folder=str(trainer.folder.path),
            )
            self._display = trainer.running.enter_context(ProgressDisplay(self._console, header))

    def on_iteration_end(self, trainer: Trainer) -> None:
        """Show the row, and how long the rest of the budget takes."""
        assert self._display is not None
        _, fraction = trainer.budget.used(*trainer.usage)
        left_s = trainer.row["wall_clock_s"] * (1 / fraction - 1) if fraction else None
        self._display.update(trainer.row, min(fraction, 1.0), left_s)
