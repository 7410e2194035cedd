"""A run in progress: its loop, its records and its end."""

import json
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from rich.console import Console
from tensordict import TensorDictBase

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.ppo import PPO, UpdateMetrics
from deepracer_exp.agents.schedules import Schedule
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.observation import feature_names
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import RunFailed, reading
from deepracer_exp.formats.trace import TraceWriter, to_table
from deepracer_exp.tracking.delivery import ENDS
from deepracer_exp.tracking.names import END_TAG
from deepracer_exp.tracking.recorder import Tracker

from .alerts import Alerts
from .batches import Batches
from .best import Best
from .budget import Budget
from .checkpoints import CheckpointStore, read_agent
from .collection import open_collection, worker_count
from .display import ProgressDisplay
from .episodes import Finished
from .examination import NOT_EVALUATED, Examination, Mark
from .faults import write_fault
from .header import run_header, track_names
from .iterations import frames_per_batch, iterations
from .log_file import log_to
from .origin import origin
from .outcome import Outcome
from .ranking import Ranking
from .report import write_pictures, write_run_page
from .results import Results
from .run_folder import RunFolder
from .signals import Interruption
from .stopping import Decision, Stopping
from .watching import Watch

logger = logging.getLogger("deepracer_exp")

TIMES = ("wall_clock_s", "collect_s", "update_s", "env_steps_per_s")
"""Columns of metrics.jsonl that differ between two runs of the same seed."""
SPENT = "budget reached"
"""How the reason of a run begins that has used its budget."""
_OVER = ("finished", "hopeless")
"""How runs end that do not go on: the only ones whose page is worth the time."""
_RESULTS = ("summary.json", "metrics.jsonl", "log.txt", "report.html", "best_lap.png", "learning.png")
_LAST_EVERY, _LAST_EVERY_S = 10, 5.0
"""Iterations and seconds after which there is a new checkpoint `last`, whichever comes first."""


class Training:
    """A run in progress: what the loop reads and writes."""

    def __init__(
        self,
        experiment: Experiment,
        setup: RaceSetup,
        folder: RunFolder,
        config: Mapping[str, Any],
        names: Mapping[str, str],
        tracker: Tracker,
        console: Console,
        watch: Watch | None,
    ):
        """Build the networks and everything that watches over them.

        Args:
            experiment: what is trained.
            setup: its files, read.
            folder: where everything is written.
            config: all values, as in config.yaml.
            names: what a racer calls the choices.
            tracker: has begun.
            console: for the view of the progress.
            watch: looks on.

        Raises:
            BadInput: files or values of the evaluation or the budget cannot be used.
            OSError: the folder cannot be written.
        """
        self.experiment, self.setup, self.folder = experiment, setup, folder
        self._names, self._tracker, self._watch = names, tracker, watch
        self._beaten: str | None = None
        kept = experiment.checkpoints
        self.checkpoints = CheckpointStore(folder.path, kept.keep, kept.every)
        self._alerts = Alerts(experiment.budget)
        self._budget = Budget(experiment.budget, folder.path)
        self._examination = Examination(experiment)
        self._stopping = Stopping(experiment.stopping, setup.actions.n)
        self._decision: Decision | None = None
        cars = max(1, worker_count(experiment.collector)) * experiment.collector.cars
        self._tracks = track_names(setup)
        self._results = Results(self._tracks, cars, experiment.car.control_period_s, experiment.stopping)
        self._ranking = Ranking([course.tracks[0].length_m for course in setup.courses])
        self._trace = TraceWriter(folder.path / "trace")
        self._console = console
        self._display = ProgressDisplay(
            console, run_header(folder, setup, names, self._results, self._budget)
        )
        # More threads do not speed up networks of this size, and on a busy machine they wait for one another: an
        # update took 25 times as long.
        torch.set_num_threads(1)
        generator = torch.Generator().manual_seed(experiment.seed)
        with reading(f"network.hidden={list(experiment.network.hidden)}", "a network that fits into memory"):
            self.networks = build_actor_critic(
                experiment.network, len(feature_names(experiment.observation)), setup.actions.n, generator
            )
        self.agent = PPO(
            self.networks, experiment.algorithm, Schedule(experiment.lr_schedule), experiment.seed
        )
        self._origin = origin(config, setup)
        self._cars: dict[str, Any] | None = None
        self._env_steps = 0
        self._iteration = 0
        self._began = time.monotonic()
        # The clock of a racer starts with the command, not with the loop.
        self._process_began = psutil.Process().create_time()
        self._saved_at = self._began
        self._best = Best(experiment.checkpoints.metric)
        self._first_lap: dict[str, float] | None = None
        self._reliable: dict[str, float] | None = None
        self._row: dict[str, Any] = {}
        self._log_file = log_to(folder.path / "log.txt")

    def drive_and_learn(self, interruption: Interruption) -> str:
        """Collect, learn and record until there is a reason to stop, evaluate the last policy, return the reason."""
        # There is one already if the run was killed while it was ending, or Ctrl-C came while it began.
        reason = self._reason_to_stop(interruption) or self._trained(interruption)
        # A trial that is interrupted is made again from its checkpoint, and its worker is waited for.
        if interruption.signum is None or self._watch is None:
            self._evaluate_last(interruption.signum is None)
        return reason

    def _trained(self, interruption: Interruption) -> str:
        experiment = self.experiment
        frames = frames_per_batch(experiment)
        # The view first: workers take a second or two to start.
        with (
            self._display,
            open_collection(
                experiment.collector,
                self.setup,
                self.networks.policy,
                frames,
                self.folder.path,
                state=self._cars,
            ) as collection,
        ):
            return self._loop(collection, interruption)

    def save_start(self) -> None:
        """Save the policy as it is before the first iteration: a run that is killed before its second resumes there.

        Raises:
            RunFailed: the disk takes no more.
        """
        self.checkpoints.save(self.agent, self._counters(), self._state(None))

    def rows_until(self, iteration: int) -> list[dict[str, Any]]:
        """Return the rows of metrics.jsonl up to an iteration, as an uninterrupted run has them."""
        rows = [row for row in self.folder.metrics() if row["iteration"] <= iteration]
        return [self._examination.without_the_last(row) for row in rows]

    def resume_from(
        self, checkpoint: Path, state: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]
    ) -> None:
        """Take over what a checkpoint holds of a run that ended too early.

        Args:
            checkpoint: its folder.
            state: what `read_training` found in it.
            rows: those up to the checkpoint's iteration.

        Raises:
            BadInput: it does not fit the experiment.
        """
        read_agent(checkpoint, self.agent)
        self._iteration, self._env_steps = state["iteration"], state["env_steps"]
        self._results.load_state_dict(state["results"])
        self._ranking.load_state_dict(state["ranking"])
        self._best.policy = state["best"]
        self._first_lap, self._reliable = state["first_lap"], state["reliable"]
        self._cars = state["cars"]
        self._began -= state["wall_clock_s"]
        self._process_began -= state["wall_clock_s"]
        for row in rows:
            self._decision = self._stopping.observe(row)
            self._row = dict(row)

    def tell_again(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Tell the tracker, which has the run open again, all rows up to the checkpoint: it may lack some."""
        for row in rows:
            self._tell(row)
        self._tracker.safe_until(self._env_steps)

    def close(self, status: str, reason: str, exit_code: int) -> Outcome:
        """Write what a run has at its end: pictures, summary.

        Raises:
            OSError, RunFailed: the folder takes no more.
        """
        if (
            self._watch is None or not exit_code
        ):  # an interrupted trial of a sweep resumes, and has seconds to end
            write_pictures(self.folder.path, self.setup.courses)
        return self._end(status, reason, exit_code)

    def fail(self, reason: str, error: BaseException) -> Outcome:
        """Write what is known of a failure; a disk that takes no more leaves no summary, and keeps no one waiting."""
        write_fault(self.folder.path, error)
        return self._end("failed", reason, RunFailed.exit_code, error)

    def let_go(self) -> None:
        """Leave the run to whoever goes on with it: nothing more is written into its folder."""
        self._tracker.set_tag(END_TAG, "taken over")
        self._tracker.finish("KILLED")
        self._let_go()

    def break_off(self, exit_code: int) -> Outcome:
        """End at once: no checkpoint, which might be of a half-made update, and no pictures."""
        return self._end("interrupted", "ended at once by a second signal", exit_code)

    @property
    def verdict(self) -> str:
        """What a run is that was not interrupted: `finished`, or `hopeless` by its stopping rule or its watch."""
        hopeless = self._beaten if self._decision is None else self._decision.hopeless
        return "hopeless" if hopeless else "finished"

    def _loop(self, collection: Batches, interruption: Interruption) -> str:
        algorithm = self.experiment.algorithm
        self._budget.alerts(*self._usage())  # what was used before this loop needs no alert
        for batch, collect_s in iterations(collection, algorithm, self.experiment.collector.mode == "async"):
            rows, finished = self._results.book.enter(batch["next", "trace"].numpy())
            self._env_steps += batch.numel()
            if not self._examination.is_held:
                rank = self._ranking.rank(finished)
                if self._best.beaten_by_driving(rank, self._counters()):
                    # The weights are still those that drove; the update makes others.
                    self.checkpoints.save(self.agent, self._counters(), best=True)
            began = time.monotonic()
            update = self._learn(batch)
            collection.publish_policy()
            update_s = time.monotonic() - began
            self._iteration += 1
            self._row = self._measured(finished, update, batch.numel(), collect_s, update_s)
            due = self._examination.is_due(self._iteration)
            mark = self._evaluated() if due else None
            if self._watch is not None:
                self._beaten = self._watch.sees(self._row)
            self._decision = self._stopping.observe(self._row)
            reason = self._reason_to_stop(interruption)
            self._record(rows)
            better = self._best.beaten_by(mark, self._counters())
            if reason is not None or due or self._is_time_to_save():
                self._save(collection, better)
            self._send_alerts()
            if reason is not None:
                return reason
        raise RunFailed("the collector ended without a reason")

    def _evaluate_last(self, is_over: bool) -> None:
        """Evaluate the policy of the last iteration, if that was not due: the best one may be that.

        It stands in metrics.jsonl and in the summary and in no checkpoint, so that a run which resumes here is the
        one that was never interrupted. MLflow, which forgets nothing, has it only of a run that is over.
        """
        if not self._iteration or not self._examination.is_held or self._examination.is_due(self._iteration):
            return
        self._console.print(f"evaluating the policy of iteration {self._iteration}", highlight=False)
        mark = self._evaluated()
        self.folder.write_metrics([*self.folder.metrics()[:-1], self._row])
        if is_over:
            self._tracker.log(mark.columns(), step=self._env_steps)
        if self._best.beaten_by(mark, self._counters()):
            self.checkpoints.mark_best(self._iteration)

    def _save(self, collection: Batches, best: bool) -> None:
        self.checkpoints.save(self.agent, self._counters(), self._state(collection.state_dict()), best=best)
        self._tracker.safe_until(self._env_steps)
        self._saved_at = time.monotonic()

    def _state(self, cars: dict[str, Any] | None) -> dict[str, Any]:
        """Return what `resume_from` needs beside the agent; `cars` are None before the first iteration."""
        return {
            "iteration": self._iteration,
            "env_steps": self._env_steps,
            "wall_clock_s": time.monotonic() - self._began,
            "results": self._results.state_dict(),
            "ranking": self._ranking.state_dict(),
            "best": self._best.policy,
            "first_lap": self._first_lap,
            "reliable": self._reliable,
            "cars": cars,
            **self._origin,
        }

    def _end(self, status: str, reason: str, exit_code: int, error: BaseException | None = None) -> Outcome:
        """Write the summary and let go of the tracker and the log."""
        path = self.folder.path
        summary = {
            "status": status,
            "reason": reason,
            **self._counters(),
            "seed": self.experiment.seed,
            "wall_clock_s": round(time.monotonic() - self._began, 3),
            "cost": self._budget.cost(time.monotonic() - self._began),
            **self._results.summary(),
            "best": self._best.policy,
            "stopping": self._decision and self._decision.as_dict(),
            "first_lap": self._first_lap,
            "reliable": self._reliable,
            "last": self._row,
        }
        logger.log(logging.ERROR if error else logging.INFO, "%s: %s", status, reason, exc_info=error)
        try:
            self.folder.write("summary.json", json.dumps(summary, indent=2) + "\n")
        except OSError:
            if status != "failed":
                raise
        note = write_run_page(path) if self.experiment.report and status in _OVER else None
        for name in ("config.yaml", "overrides.yaml", "provenance.json", "reward_function.py"):
            self._tracker.log_artifact(path / name)
        for name in (*_RESULTS, "faults"):
            if (path / name).exists():
                self._tracker.log_artifact(path / name, "faults" if name == "faults" else None)
        for name in ("best", "last"):
            if (self.checkpoints.folder / name).exists():
                self._tracker.log_artifact((self.checkpoints.folder / name).resolve(), f"checkpoints/{name}")
        tags = self._decision.tags() if self._decision else {}
        for tag, value in {**tags, END_TAG: f"{status}: {reason}"}.items():
            self._tracker.set_tag(tag, value)
        self._tracker.finish(ENDS.get(status, "KILLED"))
        self._let_go()
        return Outcome(status, reason, exit_code, path, summary, error, note)

    def _let_go(self) -> None:
        self._alerts.close()
        self.folder.release()
        logger.removeHandler(self._log_file)
        self._log_file.close()

    def _learn(self, batch: TensorDictBase) -> UpdateMetrics:
        _, fraction = self._spent()
        try:
            return self.agent.update(batch, self._iteration, min(fraction, 1.0))
        except RunFailed as error:
            error.arrays = {  # type: ignore[attr-defined]
                "observation": batch["observation"].numpy(),
                "action": batch["action"].numpy(),
                "reward": batch["next", "reward"].numpy(),
            }
            raise

    def _measured(
        self, finished: Finished, update: UpdateMetrics, frames: int, collect_s: float, update_s: float
    ) -> dict[str, Any]:
        """Return the iteration's row of metrics.jsonl."""
        if self._first_lap is None and self._results.book.all.laps:
            self._first_lap = self._moment()
        return {
            **self._counters(),
            **self._results.metrics(finished),
            **{name: float(value) for name, value in vars(update).items()},
            **NOT_EVALUATED,
            "wall_clock_s": round(time.monotonic() - self._began, 3),
            "collect_s": round(collect_s, 4),
            "update_s": round(update_s, 4),
            "env_steps_per_s": round(frames / (collect_s + update_s), 1),
            **self._results.metrics_of_tracks(finished),
        }

    def _evaluated(self) -> Mark:
        """Evaluate the policy and put what came out into the row."""
        mark = self._examination(self.networks.policy)
        self._row |= mark.columns()
        return mark

    def _record(self, rows: np.ndarray) -> None:
        if self._decision is not None and self._decision.rule == "reliable":
            self._reliable = self._moment()
        self.folder.append_metrics(self._row)
        self._trace.write(self._iteration, to_table(rows, self._iteration, self._tracks))
        self._tell(self._row)
        _, fraction = self._spent()
        wall_clock_s = self._row["wall_clock_s"]
        self._display.update(
            self._row, min(fraction, 1.0), wall_clock_s * (1 / fraction - 1) if fraction else None
        )

    def _is_time_to_save(self) -> bool:
        return self._iteration % _LAST_EVERY == 0 or time.monotonic() > self._saved_at + _LAST_EVERY_S

    def _tell(self, row: Mapping[str, Any]) -> None:
        self._tracker.log(
            {key: value for key, value in row.items() if key != "env_steps"}, step=row["env_steps"]
        )

    def _reason_to_stop(self, interruption: Interruption) -> str | None:
        if interruption.signum is not None:
            return "interrupted"
        if self._decision is not None:
            return str(self._decision)
        if self._beaten is not None:
            return self._beaten
        limit, fraction = self._spent()
        return f"{SPENT}: {limit}" if fraction >= 1 else None

    def _moment(self) -> dict[str, float]:
        return {
            "env_steps": self._env_steps,
            "since_process_start_s": round(time.time() - self._process_began, 3),
        }

    def _spent(self) -> tuple[str, float]:
        return self._budget.used(*self._usage())

    def _usage(self) -> tuple[int, int, float]:
        return self._env_steps, self._iteration, time.monotonic() - self._began

    def _send_alerts(self) -> None:
        for alert in self._budget.alerts(*self._usage()):
            logger.info(alert.message)
            self._tracker.set_tag(f"budget.{alert.limit}", f"{alert.percent} %")
            self._alerts.send(alert.message, self.folder.path)

    def _counters(self) -> dict[str, int]:
        return {
            "iteration": self._iteration,
            "env_steps": self._env_steps,
            "episodes": self._results.book.all.finished,
            "laps": self._results.book.all.laps,
        }
