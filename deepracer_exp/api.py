"""The commands as Python functions: the names that `deepracer_exp` exports."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from tensordict.nn import TensorDictModuleBase

from deepracer_exp.config.compose import Composition, compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.stored import request_evaluation
from deepracer_exp.env.others.rival import refuse_rivals
from deepracer_exp.env.race import Race
from deepracer_exp.env.race_env import RaceEnv
from deepracer_exp.env.setup import build_setup
from deepracer_exp.evaluation.plan import plan_evaluation
from deepracer_exp.evaluation.results import Evaluation
from deepracer_exp.evaluation.run_evaluation import evaluate_run
from deepracer_exp.reports.pages.run_page import RunReport
from deepracer_exp.runs.recording import read_run_recording
from deepracer_exp.runs.run_files import METRICS, SUMMARY, read_config, read_metrics, read_object
from deepracer_exp.tracking.resolve import resolve
from deepracer_exp.training.plan import plan_resume, plan_training
from deepracer_exp.training.run import run_training
from deepracer_exp.training.train_result import TrainResult
from deepracer_exp.training.trainer import Callback


@dataclass(frozen=True)
class ComposedExperiment:
    """A validated experiment, with the origin of its values."""

    config: Experiment
    """Values as attributes: `config.algorithm.lr`."""
    composition: Composition

    def yaml(self) -> str:
        """Return all values as YAML, as `deepracer-exp train --cfg` prints them."""
        return self.composition.yaml()


def compose(*overrides: str) -> ComposedExperiment:
    """Compose an experiment, as `deepracer-exp train` does.

    Args:
        overrides: as on the command line, e.g. ``track=Oval_track``, ``algorithm.lr=3e-4``.

    Raises:
        BadInput: an override cannot be parsed, names something unknown or gives a value that is not accepted.
    """
    return ComposedExperiment(*compose_experiment(overrides))


def make_env(experiment: ComposedExperiment, n_cars: int = 1, threads: int = 1) -> RaceEnv:
    """Build the TorchRL environment of an experiment, batch size [n_cars].

    Args:
        experiment: chooses track, car, action space, observation, randomization and reward.
        n_cars: cars stepped together.
        threads: of the physics; 0: one per core.

    Raises:
        BadInput: a file of the experiment is missing or malformed, or the reward function cannot be used.
    """
    setup = refuse_rivals(build_setup(experiment.config), "an environment of its own")
    return RaceEnv(Race(setup, n_cars, threads))


def train(
    experiment: ComposedExperiment, callbacks: Sequence[Callback] = (), console: Console | None = None
) -> TrainResult:
    """Train an experiment; the run folder is `result.folder`.

    Workers are started as new processes, so a script calls this below ``if __name__ == "__main__":`` unless the
    experiment has ``collector=in_process``.

    Args:
        experiment: to train.
        callbacks: called beside the standard ones.
        console: for the progress; None: nothing is shown.

    Raises:
        BadInput: before anything was started; no folder is left.
    """
    plan = plan_training(experiment.config, experiment.composition)
    return run_training(plan, console, callbacks, RunReport())


def resume(
    run: str | Path,
    *overrides: str,
    callbacks: Sequence[Callback] = (),
    console: Console | None = None,
    runs_dir: str | Path = "runs",
) -> TrainResult:
    """Resume a run that was killed, interrupted or failed, as `deepracer-exp resume` does.

    Args:
        run: as for `evaluate`.
        overrides: as on the command line, e.g. ``budget.env_steps=5000000``.
        callbacks: as for `train`; pass those of the first start again.
        console: as for `train`.
        runs_dir: where to look for runs.

    Raises:
        BadInput: it has ended, is being trained, or was started with other values.
    """
    plan = plan_resume(resolve(str(run), Path(runs_dir), None).path, overrides)
    return run_training(plan, console, callbacks, RunReport())


def evaluate(run: str | Path, *overrides: str) -> Evaluation:
    """Race a stored policy, as `deepracer-exp evaluate` does; the results are also written into the run's folder.

    Args:
        run: its folder, its name or the beginning of it, or another name the command takes.
        overrides: as on the command line, e.g. ``checkpoint=last``, ``evaluation=summit``, ``runs_dir=DIR``.

    Raises:
        BadInput: the run, the checkpoint, a track or a condition cannot be used.
        RunFailed: a car's state became NaN, or a file cannot be written.
    """
    quiet = Console(quiet=True)
    return evaluate_run(plan_evaluation(str(run), request_evaluation(overrides)), None, quiet, quiet)


def load_policy(
    run: str | Path, checkpoint: str | None = None, runs_dir: str | Path = "runs"
) -> TensorDictModuleBase:
    """Return a stored policy: a TorchRL module that reads its keys of a `RaceEnv` and writes `action`.

    It samples actions; within `torchrl.envs.utils.set_exploration_type(ExplorationType.DETERMINISTIC)` it takes the
    most likely one, as evaluations do.

    Args:
        run: as for `evaluate`.
        checkpoint: `best`, `last`, `fastest` or the number of an iteration; None: the best, or that of the alias.
        runs_dir: where to look for runs.

    Raises:
        BadInput: there is no such run or checkpoint, or it is corrupt.
    """
    return resolve(str(run), Path(runs_dir), None).with_policy(checkpoint).read_policy().networks.policy


@dataclass(frozen=True)
class RunTables:
    """The recorded tables of a run."""

    path: Path
    config: dict[str, Any]
    """Contents of config.yaml."""
    summary: dict[str, Any]
    """Contents of summary.json; empty until the run has ended."""

    @cached_property
    def metrics(self) -> pd.DataFrame:
        """One row per iteration, the columns of metrics.jsonl."""
        return pd.DataFrame(read_metrics(self.path / METRICS))

    @cached_property
    def steps(self) -> pd.DataFrame:
        """One row per control step of the trace, columns `aws.logs.recorded.STEP_COLUMNS`."""
        return read_run_recording(self.path).recording.steps


def read_run(run: str | Path, runs_dir: str | Path = "runs") -> RunTables:
    """Read the tables of a run.

    Args:
        run: as for `evaluate`.
        runs_dir: where to look for runs.

    Raises:
        BadInput: there is no such run, or a file of it cannot be read.
    """
    path = resolve(str(run), Path(runs_dir), None).path
    return RunTables(path, read_config(path), read_object(path / SUMMARY))
