"""Another run's policy in a run's own folder, so that the run can be resumed wherever it is moved to."""

import shutil
from pathlib import Path

from deepracer_exp.errors import BadInput
from deepracer_exp.runs.files import CHECKPOINTS, CONFIG

from .resolve import StoredRun


def keep_policy(run: StoredRun, target: Path) -> None:
    """Copy configuration and checkpoint of a run into a folder within a new run's.

    Raises:
        OSError: they cannot be copied.
    """
    assert run.checkpoint is not None
    shutil.copytree(run.checkpoints / run.checkpoint, target / CHECKPOINTS / run.checkpoint)
    shutil.copy(run.path / CONFIG, target / CONFIG)


def kept_run(folder: Path) -> StoredRun:
    """Return the run with the checkpoint that `keep_policy` has copied into a folder.

    Raises:
        BadInput: it is missing, or as for `StoredRun.with_policy`.
    """
    kept = StoredRun(folder)
    try:
        (checkpoint,) = kept.checkpoints.iterdir()
    except (OSError, ValueError) as error:
        raise BadInput(
            kept.checkpoints, f"is not one checkpoint, which a run with a {folder.name} has there"
        ) from error
    return kept.with_policy(checkpoint.name)
