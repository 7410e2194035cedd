"""The trainer: the loop of a training, and the hooks around it."""

import contextlib
import json
import logging
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from deepracer_exp.agents.algorithm import UpdateMetrics
from deepracer_exp.agents.build import build_agent
from deepracer_exp.collectors.collector import Collector, frames_per_batch
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.others.placement import placements_table
from deepracer_exp.env.setup import RaceSetup, usual_cars
from deepracer_exp.env.trace_columns import PACKED, to_table
from deepracer_exp.errors import RunFailed, reading
from deepracer_exp.evaluation.results import NOT_EVALUATED, Evaluation
from deepracer_exp.evaluation.rival_run import kept_rival
from deepracer_exp.runs.checkpoints import CheckpointStore, networks_of, read_agent
from deepracer_exp.runs.fingerprint import fingerprint
from deepracer_exp.runs.folder import RunFolder, write_crash_dump
from deepracer_exp.runs.run_files import SUMMARY, TRACE
from deepracer_exp.runs.run_result import FAILED, FINISHED, INTERRUPTED, Ending, fastest_reliable
from deepracer_exp.runs.trace import trace_writer
from deepracer_exp.sim.batch import cores

from .best_policy import BestPolicy
from .budget import Budget
from .metrics import Finished, RunMetrics, track_names
from .rival_pool import RivalPool
from .signals import Interruption
from .train_result import TrainResult

logger = logging.getLogger("deepracer_exp")

_LAST_EVERY, _LAST_EVERY_S = 10, 5.0
"""Iterations and seconds between two checkpoints `last`, whichever is shorter."""


class Callback:
    """Base class of callbacks around the training loop; each hook does nothing unless overridden.

    The trainer calls a hook of all its callbacks in the order of its list. A hook may read all public attributes of
    the trainer, add columns to `trainer.row` (in `on_iteration_end`, ahead of the callback that records it), and call
    `trainer.request_stop` and `trainer.request_save`. An exception from a hook ends the run as failed.
    """

    hurries_when_interrupted = False
    """Whether `on_train_end` is skipped when the run is interrupted, because another process resumes it at once."""

    def on_replay(self, trainer: "Trainer") -> None:
        """`trainer.row` is a row of metrics.jsonl that a resumed run has up to its checkpoint; called for each."""

    def on_fit_start(self, trainer: "Trainer") -> None:
        """The loop is about to start; a stop requested here ends it before any car drives.

        Contexts entered into `trainer.running` here are left once the loop has ended, however it ended.
        """

    def on_iteration_end(self, trainer: "Trainer") -> None:
        """The networks are updated and `trainer.row` is measured."""

    def on_train_end(self, trainer: "Trainer") -> None:
        """The run came to its end or was interrupted, but did not fail; its results are written next."""

    def on_run_end(self, trainer: "Trainer", result: TrainResult) -> None:
        """summary.json is written; the last hook of a run."""

    def on_release(self, trainer: "Trainer") -> None:
        """Another process has taken the run over: write nothing more. In place of `on_run_end`."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run: tensors, arrays and JSON types, under keys no other callback uses."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from the state of all callbacks of the run."""

    def summary(self, trainer: "Trainer") -> dict[str, Any]:
        """Return entries for summary.json, JSON types."""
        return {}


class Trainer:
    """Trains one run: collects, updates, measures, and calls its callbacks after every iteration.

    Attributes:
        experiment: the trained experiment.
        setup: its files, read.
        folder: the run's folder.
        callbacks: in the order in which they are called.
        networks: policy and value.
        agent: the algorithm.
        rivals: of its cars; None: they are alone.
        metrics: episodes and laps so far.
        budget: the limits and how much of them is used.
        checkpoints: the run's own.
        iteration: updates made.
        env_steps: control steps driven by all cars.
        row: metrics of the last iteration, a line of metrics.jsonl.
        evaluation: of the policy after the last iteration, None if it was not evaluated.
        best: which policy is the best so far.
        fastest: the row of the policy whose evaluated laps are the fastest of the reliable ones so far, if any.
        saved_steps: env steps of the last checkpoint from which the run can be resumed, 0 before there is one.
        running: the contexts of the loop, its cars among them.
        ending: how the run ends, None while it continues.
    """

    def __init__(
        self,
        experiment: Experiment,
        setup: RaceSetup,
        folder: RunFolder,
        config: Mapping[str, Any],
        callbacks: Sequence[Callback],
    ):
        """Build networks, algorithm and metrics.

        `config` are all values, as in config.yaml; the callbacks are called in their order.

        Raises:
            BadInput: the networks do not fit into memory.
            OSError: the folder cannot be written.
        """
        self.experiment, self.setup, self.folder = experiment, setup, folder
        self.callbacks = callbacks
        kept = experiment.checkpoints
        self.checkpoints = CheckpointStore(folder.path, kept.keep, kept.every)
        self.budget = Budget(experiment.budget)
        collector = experiment.collector
        self.metrics = RunMetrics(
            track_names(setup),
            collector.cars,
            experiment.car.control_period_s,
            experiment.stopping,
            usual_cars(setup.weights, experiment.randomization.car_share, collector.cars),
        )
        self._trace = trace_writer(folder.path / TRACE, experiment.trace)
        # More threads do not speed up networks of features, and on a busy machine they wait for one another: an
        # update took 25 times as long. Convolutions are worth them while the workers wait for the update, but a trial
        # of a sweep has only the cores that its worker gives it (`collector.threads`).
        share = collector.threads if collector.mode == "in_process" else 0
        self._update_threads = 1 if experiment.observation.camera is None else share or cores()
        torch.set_num_threads(1)
        generator = torch.Generator().manual_seed(experiment.seed)
        with reading(f"network={experiment.network}", "a network that fits into memory"):
            self.networks = networks_of(experiment, generator)
        self.agent = build_agent(
            self.networks,
            experiment.algorithm,
            experiment.lr_schedule,
            experiment.seed,
            torch.device(experiment.device),
        )
        self.agent.threads = share or cores()
        rivals = experiment.race.rivals
        self.rivals = (
            None
            if rivals is None
            else RivalPool(rivals, setup, self.networks.policy, kept_rival(experiment, folder.path))
        )
        self.iteration, self.env_steps = 0, 0
        self.row: dict[str, Any] = {}
        self.evaluation: Evaluation | None = None
        self.best = BestPolicy(experiment, setup)
        self.fastest: dict[str, Any] | None = None
        self.saved_steps = 0
        self.running = contextlib.ExitStack()
        self.ending: Ending | None = None
        self._interruption = Interruption()
        self._save_requested = False
        self._fingerprint = fingerprint(config, setup)
        self._cars: dict[str, Any] | None = None
        self._first_lap: dict[str, float] | None = None
        self._spent_s = 0.0
        self._began_at: float | None = None
        self._saved_at = time.monotonic()
        # A racer counts from the start of the command, not of the loop.
        self._process_began = psutil.Process().create_time()
        folder.open_log()

    def fit(self, interruption: Interruption) -> Ending:
        """Train until there is a reason to stop, and return it.

        `interruption` must have been entered; a signal to it ends the loop after the iteration in progress, or without
        it if that takes long.

        Raises:
            RunFailed: a worker was lost, a number became NaN or infinite, or the disk is full.
            TakenOver: another process continues the run.
        """
        self._interruption = interruption
        with self.running:
            collector = self._start()
            self._began_at = self._saved_at = time.monotonic()
            while collector is not None and self.ending is None:
                interruption.may_leave_out = self.saved_steps == self.env_steps

                # 1. Collect: count steps and episodes; the networks are still those that drove.
                batch, collect_s = collector.collect(self.experiment.algorithm)
                rows, finished = self.metrics.enter(batch["next", "trace"].numpy())
                self.env_steps += batch.numel()
                if self.best.drove_best(finished, self.counters()):
                    self.checkpoints.save(self.agent, self.counters(), best=True)

                # 2. Update the networks, pass them to the cars, and let these drive on during the next phases.
                began = time.monotonic()
                update = self._update(batch)
                collector.publish_policy()
                update_s = time.monotonic() - began
                self.iteration += 1
                if self.rivals is None:
                    collector.begin_next()

                # 3. Measure: one row of metrics, the steps of the trace.
                self.row = self._measure(finished, update, batch.numel(), collect_s, update_s)
                self.evaluation, self._save_requested = None, False

                # 4. Callbacks: evaluate, stop?, prune?, budget?, record, track, display.
                self._call("on_iteration_end")
                is_best = self.best.evaluated_best(self.evaluation, self.counters())
                is_fastest = self._laps_fastest()
                self._write_trace(rows)
                self._check_interruption()
                # After the evaluation, whose rivals are thus those of the training so far.
                if self.rivals is not None and self.rivals.take(self.iteration):
                    collector.publish_rivals(self.rivals.driving)

                # 5. Save when due and at the end.
                interruption.may_leave_out = False
                is_due = (
                    self.iteration % _LAST_EVERY == 0 or time.monotonic() > self._saved_at + _LAST_EVERY_S
                )
                if self.ending or self._save_requested or is_due:
                    self.save(collector, best=is_best, fastest=is_fastest)
        assert self.ending is not None
        hurry = any(callback.hurries_when_interrupted for callback in self.callbacks)
        if interruption.signum is None or not hurry:
            self.evaluation = None
            self._call("on_train_end")
            is_best = self.best.evaluated_best(self.evaluation, self.counters())
            self.checkpoints.mark(self.iteration, best=is_best, fastest=self._laps_fastest())
        return self.ending

    def request_stop(self, reason: str | Ending, status: str = FINISHED) -> None:
        """End the run after this iteration; the first request counts.

        `reason` is for the last line of the run and summary.json, `status` FINISHED or STOPPED_EARLY.
        """
        if self.ending is None:
            self.ending = reason if isinstance(reason, Ending) else Ending(status, reason)

    def _laps_fastest(self) -> bool:
        """Return whether the row's evaluation has the fastest reliable lap so far, and remember it."""
        lap = fastest_reliable([row for row in (self.fastest, self.row) if row])
        if lap is None or lap.iteration != self.row["iteration"]:
            return False
        self.fastest = self.row
        return True

    def _write_trace(self, rows: NDArray[np.float64]) -> None:
        """Write the steps of an iteration, with the placements of boxes, bots and rivals."""
        if self._trace is None:
            return
        extra, rows = rows[:, len(PACKED) :], rows[:, : len(PACKED)]
        others = placements_table(self.setup, rows, extra) if extra.shape[1] else None
        self._trace.add(self.iteration, to_table(rows, self.iteration, self.metrics.track_names), others)

    def request_save(self) -> None:
        """Write a checkpoint after this iteration."""
        self._save_requested = True

    def save(self, collector: Collector | None = None, *, best: bool = False, fastest: bool = False) -> None:
        """Write a checkpoint from which the run can be resumed.

        Args:
            collector: whose cars are stored; None: before the first iteration, so that a run which is killed before
                its first checkpoint can begin again.
            best: whether the checkpoint becomes `best`.
            fastest: whether it becomes `fastest`.

        Raises:
            RunFailed: the disk is full, or a worker was lost.
        """
        cars = None if collector is None else collector.state_dict()
        state = {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "wall_clock_s": self.wall_clock_s,
            "results": self.metrics.state_dict(),
            "first_lap": self._first_lap,
            "cars": cars,
            **self._fingerprint,
        }
        for callback in self.callbacks:
            state |= callback.state_dict()
        if self.rivals is not None:
            state |= self.rivals.state_dict()
        state |= self.best.state_dict()
        if self._trace is not None:
            self._trace.flush()
        self.checkpoints.save(self.agent, self.counters(), state, best=best, fastest=fastest)
        if collector is not None:
            self.saved_steps = self.env_steps
            self._saved_at = time.monotonic()

    def load(self, checkpoint: Path, state: Mapping[str, Any]) -> None:
        """Restore a run from a checkpoint.

        `state` is the result of `read_training`.

        Raises:
            BadInput: it does not fit the experiment.
        """
        read_agent(checkpoint, self.agent)
        self.iteration, self.env_steps = state["iteration"], state["env_steps"]
        self.saved_steps = self.env_steps
        self.metrics.load_state_dict(state["results"])
        self._first_lap, self._cars = state["first_lap"], state["cars"]
        self._spent_s = state["wall_clock_s"]
        self._process_began -= state["wall_clock_s"]
        for callback in self.callbacks:
            callback.load_state_dict(state)
        if self.rivals is not None:
            self.rivals.load_state_dict(state)
        self.best.load_state_dict(state)
        if self._trace is not None:
            self._trace.resume(self.iteration)

    def replay(self, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Pass the rows of metrics.jsonl up to the checkpoint to the callbacks again; return them as they left them."""
        replayed = []
        for row in rows:
            self.ending = None  # the last row decides
            self.row = dict(row)
            self._call("on_replay")
            self._laps_fastest()
            replayed.append(self.row)
        return replayed

    def end(self, ending: Ending, exit_code: int, error: BaseException | None = None) -> TrainResult:
        """Write summary.json and release the run.

        Raises:
            OSError: the file cannot be written; not if the run failed.
        """
        summary = {
            **asdict(ending),
            **self.counters(),
            "seed": self.experiment.seed,
            "wall_clock_s": round(self.wall_clock_s, 3),
            **self.metrics.summary(),
            "first_lap": self._first_lap,
            "last": self.row,
        }
        for callback in self.callbacks:
            summary |= callback.summary(self)
        summary["best"] = self.best.record
        logger.log(logging.ERROR if error else logging.INFO, "%s", ending, exc_info=error)
        try:
            if self._trace is not None:
                self._trace.flush()
            self.folder.write(SUMMARY, json.dumps(summary, indent=2) + "\n")
        except (OSError, RunFailed):
            if ending.status != FAILED:
                raise
        result = TrainResult(ending, exit_code, self.folder.path, summary, error)
        self._call("on_run_end", result)
        self.folder.release()
        return result

    def fail(self, reason: str, error: BaseException, exit_code: int = RunFailed.exit_code) -> TrainResult:
        """Write a crash dump and end the run as failed."""
        write_crash_dump(self.folder.path, error)
        return self.end(Ending(FAILED, reason), exit_code, error)

    def release(self) -> None:
        """Hand the run over to the process that continues it: nothing more is written into its folder."""
        self._call("on_release")
        self.folder.release()

    @property
    def wall_clock_s(self) -> float:
        """Seconds since the cars were ready for the first step, those before a resume included."""
        return self._spent_s + (0.0 if self._began_at is None else time.monotonic() - self._began_at)

    @property
    def usage(self) -> tuple[int, int, float]:
        """Env steps, iterations and seconds used, which the budget counts."""
        return self.env_steps, self.iteration, self.wall_clock_s

    @property
    def is_interrupted(self) -> bool:
        """Whether a signal asked the run to end."""
        return self._interruption.signum is not None

    def moment(self) -> dict[str, float]:
        """Return the env steps so far and the seconds since the command started."""
        return {
            "env_steps": self.env_steps,
            "since_process_start_s": round(time.time() - self._process_began, 3),
        }

    def counters(self) -> dict[str, int]:
        """Return iteration, env steps, episodes and laps so far."""
        episodes = self.metrics.all
        return {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "episodes": episodes.finished,
            "laps": episodes.laps,
        }

    def _start(self) -> Collector | None:
        """Start callbacks and cars; None if there is a reason to stop before that."""
        # There is one already if the run was killed while it was ending, or Ctrl-C came while it began.
        self._check_interruption()
        self._call("on_fit_start")
        if self.ending is not None:
            return None
        experiment = self.experiment
        if self.rivals is not None and not self.iteration:
            self.rivals.take(0)
        return self.running.enter_context(
            Collector(
                experiment.collector,
                self.setup,
                self.networks.policy,
                frames_per_batch(experiment.collector, experiment.algorithm),
                self.folder.path,
                self._cars,
                None if self.rivals is None else self.rivals.rivals,
            )
        )

    def _check_interruption(self) -> None:
        if self.is_interrupted:
            how = "by Ctrl-C" if self._interruption.signum == signal.SIGINT else "by SIGTERM"
            self.ending = Ending(INTERRUPTED, how)

    def _call(self, hook: str, *arguments: Any) -> None:
        for callback in self.callbacks:
            getattr(callback, hook)(self, *arguments)

    def _update(self, batch: TensorDictBase) -> UpdateMetrics:
        fraction = self.budget.scheduled(*self.usage)
        torch.set_num_threads(self._update_threads)
        try:
            return self.agent.update(batch, self.iteration, fraction)
        except RunFailed as error:
            error.arrays = {  # type: ignore[attr-defined]
                "observation": batch["observation"].numpy(),
                "action": batch["action"].numpy(),
                "reward": batch["next", "reward"].numpy(),
            }
            raise
        finally:
            torch.set_num_threads(1)

    def _measure(
        self, finished: Finished, update: UpdateMetrics, frames: int, collect_s: float, update_s: float
    ) -> dict[str, Any]:
        """Return the iteration's row of metrics.jsonl."""
        if self._first_lap is None and self.metrics.all.laps:
            self._first_lap = self.moment()
        return {
            **self.counters(),
            **self.metrics.row(finished),
            **{name: None if value is None else float(value) for name, value in vars(update).items()},
            **NOT_EVALUATED,
            "wall_clock_s": round(self.wall_clock_s, 3),
            "collect_s": round(collect_s, 4),
            "update_s": round(update_s, 4),
            "env_steps_per_s": round(frames / (collect_s + update_s), 1),
            **self.metrics.row_of_tracks(finished),
        }
