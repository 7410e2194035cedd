"""What is checked before the imports that take seconds: files, and the runs and checkpoints that are named."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from deepracer_exp.config.experiment import Experiment
    from deepracer_exp.config.sweep import SweepRequest
    from deepracer_exp.evaluation.run import StoredRun


def check_files(experiment: "Experiment") -> None:
    """Read the files that an experiment names; nothing of them is run.

    Raises:
        BadInput: one is missing or malformed.
    """
    from deepracer_exp.env.action_space import build_action_space
    from deepracer_exp.env.reward_source import load_reward_source

    load_reward_source(experiment.reward)
    build_action_space(experiment.action_space)
    files = [track for track in experiment.tracks.values() if track.file is not None]
    if files:
        from deepracer_exp.tracks.track import Track

        for track in files:
            Track.from_config(track)


def check_run(run: str, runs_dir: str, tracking_uri: str | None, checkpoint: str | None) -> "StoredRun":
    """Return the run that is meant; the checkpoint, or one if none is named, is there.

    Raises:
        BadInput: there is no such run or checkpoint, or its configuration is none of this version.
    """
    from deepracer_exp.evaluation.run import read_run
    from deepracer_exp.formats.checkpoint_files import find_checkpoint

    stored = read_run(run, Path(runs_dir), tracking_uri)
    find_checkpoint(stored.checkpoints, checkpoint or stored.checkpoint or "last")
    return stored


def check_changes(run_dir: Path, overrides: "Sequence[str]") -> "Experiment":
    """Return the experiment that a run's configuration makes with overrides.

    Raises:
        BadInput: an override names something unknown or gives a value that is not accepted.
    """
    from deepracer_exp.config.compose import validate
    from deepracer_exp.config.stored import with_overrides
    from deepracer_exp.formats.run_files import read_config

    return validate(with_overrides(read_config(run_dir), {}, overrides).mapping)


def check_sweep(request: "SweepRequest") -> None:
    """Read the files and find the options that every trial of a sweep has; its values are checked with its space.

    Raises:
        BadInput: there is no such file, option or parent.
    """
    from deepracer_exp.config import custom_files
    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.config.options import groups
    from deepracer_exp.config.overrides import key_of

    named = [
        line
        for line in request.base
        if (key := key_of(line)) in (*groups(), custom_files.KEY) or key.endswith(".file")
    ]
    check_files(compose_experiment(named)[0])
