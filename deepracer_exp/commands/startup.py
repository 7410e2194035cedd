"""What a command does before the imports that take seconds: check what it was given, start the workers' server."""

import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.runs.files import read_config

if TYPE_CHECKING:
    from collections.abc import Sequence

    from deepracer_exp.config.evaluation import EvaluationConfig
    from deepracer_exp.config.experiment import Experiment
    from deepracer_exp.config.sweep import SweepRequest
    from deepracer_exp.lookup.resolve import StoredRun


def check_files(experiment: "Experiment") -> list[str]:
    """Read the files that an experiment names, without running any of them.

    Returns:
        A line for each thing about its action space that a racer may not have meant.

    Raises:
        BadInput: one is missing or malformed.
    """
    from deepracer_exp.env.action_space import action_remarks, build_action_space
    from deepracer_exp.rewards.source import load_reward_source

    load_reward_source(experiment.reward)
    actions = build_action_space(experiment.action_space)
    if experiment.evaluation.real_car is not None:
        from deepracer_exp.env.real_car import require_car

        require_car(experiment)
    files = [track for track in experiment.tracks.values() if track.file is not None]
    if files:
        from deepracer_exp.tracks.track import Track

        for track in files:
            Track.from_config(track)
    return action_remarks(actions, experiment.car)


def check_teacher(experiment: "Experiment") -> None:
    """Find the run that an experiment's policy learns from, if there is one.

    Raises:
        BadInput: as for `check_policy`.
    """
    if experiment.teacher is not None:
        check_policy(experiment.teacher, experiment.runs_dir, getattr(experiment.tracking, "uri", None), None)


def check_policy(
    run: str,
    runs_dir: str,
    tracking_uri: str | None,
    checkpoint: str | None,
    evaluation: "EvaluationConfig | None" = None,
) -> "StoredRun":
    """Return a run as `check_run` does; import the classes of the user's own that its policy needs.

    Raises:
        BadInput: as `check_run`, or a class is not named again or cannot be imported, or `evaluation` is that of the
            physical car and it could not run the policy.
    """
    from deepracer_exp.config.own_class import OF_POLICY
    from deepracer_exp.config.parse import import_own_classes

    stored = check_run(run, runs_dir, tracking_uri, checkpoint)
    import_own_classes(stored.experiment, OF_POLICY)
    if evaluation is not None and evaluation.real_car is not None:
        from deepracer_exp.env.real_car import require_car

        require_car(stored.experiment)
    return stored


def check_run(run: str, runs_dir: str, tracking_uri: str | None, checkpoint: str | None) -> "StoredRun":
    """Find a run that has the checkpoint, or any checkpoint if none is named.

    Raises:
        BadInput: there is no such run or checkpoint, or its configuration is not one of this version.
    """
    from deepracer_exp.lookup.resolve import resolve
    from deepracer_exp.runs.checkpoint_files import find_checkpoint

    stored = resolve(run, Path(runs_dir), tracking_uri)
    stored.experiment  # noqa: B018 - refuses what another version wrote
    find_checkpoint(stored.checkpoints, checkpoint or stored.checkpoint or "last")
    return stored


def check_changes(run_dir: Path, overrides: "Sequence[str]") -> "Experiment":
    """Return the experiment of a stored run with overrides applied.

    Raises:
        BadInput: an override names something unknown or gives a value that is not accepted.
    """
    from deepracer_exp.config.parse import parse_experiment
    from deepracer_exp.config.stored import with_overrides

    return parse_experiment(with_overrides(read_config(run_dir), {}, overrides).mapping)


def check_sweep(request: "SweepRequest") -> list[str]:
    """Check the files and options that all trials of a sweep share; its values are checked with its search space.

    Returns:
        As `check_files`.

    Raises:
        BadInput: there is no such file or option.
    """
    from deepracer_exp.config import custom_files
    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.config.options import groups
    from deepracer_exp.config.overrides import key_of

    named = [
        line
        for line in request.base
        if (key := key_of(line)) in (*groups(), custom_files.KEY, "teacher", "runs_dir")
        or key.endswith(".file")
    ]
    experiment, _ = compose_experiment(named)
    remarks = check_files(experiment)
    check_teacher(experiment)
    return remarks


def start_workers_early(wanted: bool, module: str = "deepracer_exp.collectors.worker") -> None:
    """Start the server that workers are forked from; it imports torch, in `module`, while this process does."""
    if not wanted or not sys.platform.startswith("linux"):
        return
    import multiprocessing
    from multiprocessing import forkserver

    multiprocessing.set_start_method("forkserver", force=True)
    multiprocessing.set_forkserver_preload(["deepracer_exp.collectors.fork_server", module])
    # Workers share the cores among themselves already; a linear-algebra thread pool in each would only compete.
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    # Signals to the process group are for the training process alone. The server inherits what is ignored now.
    handlers = {signum: signal.signal(signum, signal.SIG_IGN) for signum in (signal.SIGINT, signal.SIGTERM)}
    forkserver.ensure_running()
    for signum, handler in handlers.items():
        signal.signal(signum, handler)
    if before is None:
        del os.environ["OMP_NUM_THREADS"]
    else:
        os.environ["OMP_NUM_THREADS"] = before
