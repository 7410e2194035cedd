"""One experiment, from its configuration to a folder of results."""

import json
import logging
import time
from dataclasses import dataclass
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
from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.observation import feature_names
from deepracer_exp.env.reward import RewardFunction
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.formats.trace import TraceWriter, to_table
from deepracer_exp.tracking.names import joined, run_params, run_tags
from deepracer_exp.tracking.recorder import open_tracker

from .alerts import Alerts
from .budget import Budget, refuse_spent
from .checkpoints import CheckpointStore
from .collection import Collection, worker_count
from .display import ProgressDisplay, RunHeader
from .episodes import Finished
from .faults import write_fault
from .iterations import frames_per_batch, iterations
from .log_file import log_to
from .ranking import Ranking
from .report import write_report
from .results import Results
from .run_folder import RunFolder
from .signals import Interruption
from .stopping import Decision, Stopping

logger = logging.getLogger("deepracer_exp")

TIMES = ("wall_clock_s", "collect_s", "update_s", "env_steps_per_s")
"""Columns of metrics.jsonl that differ between two runs of the same seed."""
_LAST_EVERY = 10  # iterations between two checkpoints `last`: one costs about 10 ms


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    status: str
    """`finished`, `hopeless` (ended by a stopping rule that expects nothing of it), `interrupted` or `failed`."""
    reason: str
    exit_code: int
    folder: Path
    summary: dict[str, Any]
    error: BaseException | None = None
    """What a failed run failed of."""


class Training:
    """A run in progress: what the loop reads and writes."""

    def __init__(self, experiment: Experiment, composition: Composition, console: Console):
        """Read the experiment's files, make its folder and begin to record.

        Raises:
            BadInput: a file or the run folder cannot be used, or values contradict; no folder is left.
        """
        self.experiment = experiment
        self.setup = read_files(experiment)
        refuse_spent(experiment.budget, Path(experiment.runs_dir) / experiment.name)
        self._alerts = Alerts(experiment.budget)
        self._tracker = open_tracker(experiment.tracking, Path(experiment.runs_dir))
        courses = self.setup.courses
        # One track is called by its own name, which may stand in a file; several by their options.
        self._tracks = [course.name for course in courses] if len(courses) > 1 else [self.setup.track.name]
        self.names = _names(composition, joined(self._tracks), self.setup.reward.name)
        label = f"{self.names['track']}-{self.names['reward']}-seed{experiment.seed}"
        self.folder = RunFolder(experiment.runs_dir, experiment.name, label)
        try:
            commit = self.folder.describe(composition, self.setup.reward, experiment.seed)
            self._log_file = log_to(self.folder.path / "log.txt")
            for note in composition.notes:
                logger.info(note)
            self.checkpoints = CheckpointStore(self.folder.path)
        except OSError as error:
            self.folder.remove()
            raise BadInput(
                f"runs_dir={experiment.runs_dir}: cannot write {error.filename}: {error.strerror}; give a folder with "
                "room"
            ) from error
        self._tracker.start(
            # MLflow's table shows some 20 characters; the folder's name is in the tag run_dir.
            f"{self.names['reward']} s{experiment.seed} {time.strftime('%H:%M:%S')}",
            experiment.name,
            run_params(self.names, composition.mapping),
            run_tags(self.names, commit, self.setup.reward.sha256, self.folder.path.resolve()),
        )
        self.budget = Budget(experiment.budget, self.folder.path)
        self._stopping = Stopping(experiment.stopping, self.setup.actions.n)
        self._decision: Decision | None = None
        cars = max(1, worker_count(experiment.collector)) * experiment.collector.cars
        self.results = Results(self._tracks, cars, experiment.car.control_period_s, experiment.stopping)
        self.ranking = Ranking([course.tracks[0].length_m for course in courses])
        self.trace = TraceWriter(self.folder.path / "trace")
        self.display = ProgressDisplay(console, self._header())
        # More threads do not speed up networks of this size, and on a busy machine they wait for one another: an
        # update took 25 times as long.
        torch.set_num_threads(1)
        generator = torch.Generator().manual_seed(experiment.seed)
        actor_critic = build_actor_critic(
            experiment.network, len(feature_names(experiment.observation)), self.setup.actions.n, generator
        )
        self.policy = actor_critic.policy
        self.agent = PPO(
            actor_critic, experiment.algorithm, Schedule(experiment.lr_schedule), experiment.seed
        )
        self.env_steps = 0
        self.iteration = 0
        self._began = time.monotonic()
        # The clock of a racer starts with the command, not with the loop.
        self._process_began = psutil.Process().create_time()
        self._first_lap: dict[str, float] | None = None
        self._reliable: dict[str, float] | None = None
        self._row: dict[str, Any] = {}

    def loop(self, collection: Collection, interruption: Interruption) -> str:
        """Collect, learn and record until there is a reason to stop; return it."""
        algorithm = self.experiment.algorithm
        self.budget.alerts(*self._usage())  # what was used before this loop needs no alert
        for batch, collect_s in iterations(collection, algorithm, self.experiment.collector.mode == "async"):
            rows, finished = self.results.book.enter(batch["next", "trace"].numpy())
            self.env_steps += batch.numel()
            rank = self.ranking.rank(finished)
            if self.checkpoints.is_better(rank):  # these weights drove; the update makes others
                self.checkpoints.save(self.agent, self._counters(), rank)
            began = time.monotonic()
            update = self._learn(batch)
            collection.publish_policy()
            self.iteration += 1
            self._record(rows, finished, update, batch.numel(), collect_s, time.monotonic() - began)
            if self.iteration % _LAST_EVERY == 0:
                self.checkpoints.save(self.agent, self._counters(), None)
            reason = self._reason_to_stop(interruption)
            if reason is not None:
                return reason
        raise RunFailed("the collector ended without a reason")

    @property
    def verdict(self) -> str:
        """What a run is that was not interrupted: `finished`, or `hopeless` by its stopping rule."""
        return "hopeless" if self._decision is not None and self._decision.hopeless else "finished"

    def close(self, status: str, reason: str, exit_code: int) -> Outcome:
        """Write what a run has at its end: checkpoint, pictures, summary.

        Raises:
            OSError, RunFailed: the folder takes no more.
        """
        if self.iteration:
            self.checkpoints.save(self.agent, self._counters(), None)
        write_report(self.folder.path, self.setup.courses)
        return self._end(status, reason, exit_code)

    def fail(self, reason: str, error: BaseException) -> Outcome:
        """Write what is known of a failure; a disk that takes no more leaves no summary, and keeps no one waiting."""
        write_fault(self.folder.path, error)
        return self._end("failed", reason, RunFailed.exit_code, error)

    def break_off(self, exit_code: int) -> Outcome:
        """End at once: no checkpoint, which might be of a half-made update, and no pictures."""
        return self._end("interrupted", "ended at once by a second signal", exit_code)

    def _end(self, status: str, reason: str, exit_code: int, error: BaseException | None = None) -> Outcome:
        """Write the summary and let go of the tracker and the log."""
        path = self.folder.path
        summary = {
            "status": status,
            "reason": reason,
            **self._counters(),
            "seed": self.experiment.seed,
            "wall_clock_s": round(time.monotonic() - self._began, 3),
            "cost": self.budget.cost(time.monotonic() - self._began),
            **self.results.summary(),
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
        for name in ("config.yaml", "overrides.yaml", "provenance.json", "reward_function.py"):
            self._tracker.log_artifact(path / name)
        for name in ("summary.json", "metrics.jsonl", "log.txt", "best_lap.png", "learning.png", "faults"):
            if (path / name).exists():
                self._tracker.log_artifact(path / name, "faults" if name == "faults" else None)
        for name in ("best", "last"):
            if (self.checkpoints.folder / name).exists():
                self._tracker.log_artifact((self.checkpoints.folder / name).resolve(), f"checkpoints/{name}")
        tags = self._decision.tags() if self._decision else {}
        for tag, value in {**tags, "end": f"{status}: {reason}"}.items():
            self._tracker.set_tag(tag, value)
        ends = {"finished": "FINISHED", "hopeless": "FINISHED", "failed": "FAILED"}
        self._tracker.finish(ends.get(status, "KILLED"))  # type: ignore[arg-type]
        self._alerts.close()
        logger.removeHandler(self._log_file)
        self._log_file.close()
        return Outcome(status, reason, exit_code, path, summary, error)

    def _learn(self, batch: TensorDictBase) -> UpdateMetrics:
        _, fraction = self._spent()
        try:
            return self.agent.update(batch, self.iteration, min(fraction, 1.0))
        except RunFailed as error:
            error.arrays = {  # type: ignore[attr-defined]
                "observation": batch["observation"].numpy(),
                "action": batch["action"].numpy(),
                "reward": batch["next", "reward"].numpy(),
            }
            raise

    def _record(
        self,
        rows: np.ndarray,
        finished: Finished,
        update: UpdateMetrics,
        frames: int,
        collect_s: float,
        update_s: float,
    ) -> None:
        if self._first_lap is None and self.results.book.all.laps:
            self._first_lap = self._moment()
        self._row = {
            **self._counters(),
            **self.results.metrics(finished),
            **{name: float(value) for name, value in vars(update).items()},
            "wall_clock_s": round(time.monotonic() - self._began, 3),
            "collect_s": round(collect_s, 4),
            "update_s": round(update_s, 4),
            "env_steps_per_s": round(frames / (collect_s + update_s), 1),
            **self.results.metrics_of_tracks(finished),
        }
        self._decision = self._stopping.observe(self._row)
        if self._decision is not None and self._decision.rule == "reliable":
            self._reliable = self._moment()
        self.folder.append_metrics(self._row)
        self.trace.write(self.iteration - 1, to_table(rows, self.iteration - 1, self._tracks))
        self._tracker.log(
            {key: value for key, value in self._row.items() if key != "env_steps"}, step=self.env_steps
        )
        self._send_alerts()
        _, fraction = self._spent()
        wall_clock_s = self._row["wall_clock_s"]
        self.display.update(
            self._row, min(fraction, 1.0), wall_clock_s * (1 / fraction - 1) if fraction else None
        )

    def _reason_to_stop(self, interruption: Interruption) -> str | None:
        if interruption.signum is not None:
            return "interrupted"
        if self._decision is not None:
            return str(self._decision)
        limit, fraction = self._spent()
        return f"budget reached: {limit}" if fraction >= 1 else None

    def _moment(self) -> dict[str, float]:
        return {
            "env_steps": self.env_steps,
            "since_process_start_s": round(time.time() - self._process_began, 3),
        }

    def _spent(self) -> tuple[str, float]:
        return self.budget.used(*self._usage())

    def _usage(self) -> tuple[int, int, float]:
        return self.env_steps, self.iteration, time.monotonic() - self._began

    def _send_alerts(self) -> None:
        for alert in self.budget.alerts(*self._usage()):
            logger.info(alert.message)
            self._tracker.set_tag(f"budget.{alert.limit}", f"{alert.percent} %")
            self._alerts.send(alert.message, self.folder.path)

    def _counters(self) -> dict[str, int]:
        return {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "episodes": self.results.book.all.finished,
            "laps": self.results.book.all.laps,
        }

    def _header(self) -> RunHeader:
        return RunHeader(
            name=self.folder.name,
            track=joined([course.tracks[0].title for course in self.setup.courses], " + "),
            track_labels=tuple(self.results.labels),
            remembered=self.results.remembered,
            reward=self.names["reward"],
            network=self.names["network"],
            actions=self.names["action_space"],
            budget=str(self.budget),
            folder=str(self.folder.path),
        )


def train(experiment: Experiment, composition: Composition, console: Console) -> Outcome:
    """Train the experiment.

    Args:
        experiment: validated.
        composition: where it came from.
        console: for the view of the progress.

    Returns:
        How it ended; a failed run's line is its `reason`.

    Raises:
        BadInput: before anything was started.
    """
    # From here on, so that Ctrl-C during the start leaves a whole folder, too.
    with Interruption() as interruption:
        training = Training(experiment, composition, console)
        try:
            reason = _drive_and_learn(training, interruption)
            code = interruption.exit_code
            return training.close(training.verdict if code is None else "interrupted", reason, code or 0)
        except RunFailed as error:
            return training.fail(str(error), error)
        except OSError as error:
            return training.fail(
                f"{error.filename or training.folder.path}: {error.strerror or error}", error
            )
        except KeyboardInterrupt:
            return training.break_off(interruption.exit_code or 130)
        except Exception as error:
            # A fault of ours: told with its traceback, but the run must not look as if it went on.
            training.fail(f"{type(error).__name__}: {error}", error)
            raise


def read_files(experiment: Experiment) -> RaceSetup:
    """Read the files an experiment names and run the reward function's module once.

    Raises:
        BadInput: a file is missing or malformed, or values contradict.
    """
    setup = build_setup(experiment)
    RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    return setup


def _drive_and_learn(training: Training, interruption: Interruption) -> str:
    experiment = training.experiment
    frames = frames_per_batch(experiment)
    # The view first: workers take a second or two to start.
    with (
        training.display,
        Collection(
            experiment.collector, training.setup, training.policy, frames, training.folder.path
        ) as collection,
    ):
        return training.loop(collection, interruption)


def _names(composition: Composition, track: str, reward: str) -> dict[str, str]:
    """Return what a racer calls the run's choices: an option's name, a file's stem, the folder of custom_files."""
    choices, mapping = composition.choices, composition.mapping
    actions_file = mapping["action_space"].get("file")
    return {
        "track": track,
        "reward": reward,
        "action_space": Path(actions_file).stem if actions_file else choices["action_space"],
        "network": choices["network"],
        "lr_schedule": choices["lr_schedule"],
    } | dict(composition.names)
