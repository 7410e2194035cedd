"""A policy of another run that a run keeps in its own folder, so that it can be resumed wherever it is moved to."""

import shutil
from pathlib import Path

from deepracer_exp.errors import BadInput
from deepracer_exp.lookup.resolve import StoredRun
from deepracer_exp.runs.checkpoints import StoredPolicy, check, read_policy
from deepracer_exp.runs.files import CHECKPOINTS, CONFIG


def keep_policy(run: StoredRun, target: Path) -> None:
    """Copy configuration and checkpoint of a run into a folder within a new run's.

    Raises:
        OSError: they cannot be copied.
    """
    assert run.checkpoint is not None
    shutil.copytree(run.checkpoints / run.checkpoint, target / CHECKPOINTS / run.checkpoint)
    shutil.copy(run.path / CONFIG, target / CONFIG)


def read_kept_policy(folder: Path) -> StoredPolicy:
    """Return the policy that is kept in a folder.

    Raises:
        BadInput: it is missing or corrupt.
    """
    kept = StoredRun(folder)
    try:
        (checkpoint,) = kept.checkpoints.iterdir()
    except (OSError, ValueError) as error:
        raise BadInput(
            kept.checkpoints, f"is not one checkpoint, which a run with a {folder.name} has there"
        ) from error
    return read_policy(kept.experiment, check(checkpoint))
