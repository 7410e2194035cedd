"""Plans of trainings: experiment, files and runs, resolved before PyTorch is imported."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.parse import import_own_classes, parse_experiment
from deepracer_exp.config.stored import with_overrides
from deepracer_exp.env.race_files import RaceFiles, read_race_files
from deepracer_exp.env.real_car import require_car
from deepracer_exp.evaluation.rival_run import find_rival, kept_rival
from deepracer_exp.runs.run_files import PROVENANCE, read_config, read_object
from deepracer_exp.runs.stored_run import StoredRun

from .budget import refuse_ended


@dataclass(frozen=True)
class TrainPlan:
    """A new run."""

    experiment: Experiment
    composition: Composition
    """The options that the values of the experiment came from."""
    files: RaceFiles
    rival: StoredRun | None
    """The run and checkpoint whose policy drives the rivals; None: there are none, or the run's own snapshots."""
    parent: StoredRun | None = None
    """The run and checkpoint that a clone starts from; None: this is no clone."""


def plan_training(
    experiment: Experiment, composition: Composition, parent: StoredRun | None = None
) -> TrainPlan:
    """Read the files of an experiment and find its rival; `compose_experiment` returns both arguments.

    Raises:
        BadInput: a file is missing or malformed, there is no such run, the rival has other actions, or the car that the
            evaluation asks for could not run the policy.
    """
    files = read_race_files(experiment)
    rival = None
    if experiment.evaluation.real_car is not None:
        require_car(experiment)
    if experiment.randomization.real_car is not None:
        require_car(experiment, "randomization.real_car")
    runs_dir, uri = Path(experiment.runs_dir), getattr(experiment.tracking, "uri", None)
    rivals = experiment.race.rivals
    if parent is not None and rivals == parent.experiment.race.rivals:
        rival = kept_rival(parent.experiment, parent.path)
    elif rivals is not None and not rivals.is_own:
        rival = find_rival("race.rivals.policy", rivals.policy, rivals.checkpoint, experiment, runs_dir, uri)
    return TrainPlan(experiment, composition, files, rival, parent)


@dataclass(frozen=True)
class ResumePlan:
    """A run to resume."""

    run_dir: Path
    stored: Mapping[str, Any]
    """Contents of its config.yaml."""
    provenance: Mapping[str, Any]
    """Contents of its provenance.json."""
    composition: Composition
    """The stored values, with the overrides."""
    experiment: Experiment


def plan_resume(run_dir: Path, overrides: Sequence[str]) -> ResumePlan:
    """Apply overrides to a run that was killed, interrupted or failed.

    Raises:
        RunEnded: the run has ended.
        BadInput: an override names something unknown or gives a value that is not accepted, or a class is not named
            again.
    """
    stored, provenance = read_config(run_dir), read_object(run_dir / PROVENANCE)
    composition = with_overrides(stored, provenance.get("names", {}), overrides)
    # The folder may have been moved, together with all runs.
    composition.mapping["runs_dir"] = str(run_dir.parent.parent)
    experiment = parse_experiment(composition.mapping)
    refuse_ended(run_dir, experiment.budget, overrides)
    import_own_classes(experiment)
    return ResumePlan(run_dir, stored, provenance, composition, experiment)
