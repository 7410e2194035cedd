"""The run whose policy drives the rivals of a head-to-head race."""

import shutil
from pathlib import Path

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.action_space import build_action_space, describe_actions
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.run_files import CHECKPOINTS, CONFIG, RIVAL
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.tracking.resolve import resolve


def find_rival(
    key: str,
    run: str,
    checkpoint: str | None,
    experiment: Experiment,
    runs_dir: Path,
    tracking_uri: str | None,
) -> StoredRun:
    """Find a rival's run and checkpoint; its policy must have the same actions.

    With other actions, the faster car would win, not the better policy. Its observation may differ.

    Args:
        key: of the configuration, for messages.
        run: as for `resolve`.
        checkpoint: as for `StoredRun.with_checkpoint`.
        experiment: of the policy that races against it.
        runs_dir: where runs are.
        tracking_uri: as for `resolve`.

    Raises:
        BadInput: as for `resolve` and `StoredRun.with_policy`, or the actions differ.
    """
    what = f"{key}={run}"
    try:
        stored = resolve(run, runs_dir, tracking_uri).with_policy(checkpoint)
    except BadInput as error:
        raise BadInput(what, error.without(run)) from None
    theirs, ours = (
        describe_actions(build_action_space(side.action_space)) for side in (stored.experiment, experiment)
    )
    if theirs != ours:
        raise BadInput(what, f"has other actions: {theirs}", f"a run with {ours}")
    return stored


def keep_rival(rival: StoredRun, run_dir: Path) -> None:
    """Copy a rival's configuration and checkpoint into a run's folder, so that it is resumed wherever it is moved.

    Raises:
        OSError: they cannot be copied.
    """
    assert rival.checkpoint is not None
    target = run_dir / RIVAL
    shutil.copytree(rival.checkpoints / rival.checkpoint, target / CHECKPOINTS / rival.checkpoint)
    shutil.copy(rival.path / CONFIG, target / CONFIG)


def kept_rival(experiment: Experiment, run_dir: Path) -> StoredRun | None:
    """Return the other run whose policy `keep_rival` has copied into a run's folder; None: it has none.

    Raises:
        BadInput: the copy is missing, or as for `StoredRun.with_policy`.
    """
    config = experiment.race.rivals
    if config is None or config.is_own:
        return None
    kept = StoredRun(run_dir / RIVAL)
    try:
        (checkpoint,) = kept.checkpoints.iterdir()
    except (OSError, ValueError) as error:
        raise BadInput(
            kept.checkpoints,
            "is not one checkpoint, which a run with another one's policy as its rival has there",
        ) from error
    return kept.with_policy(checkpoint.name)
