"""Runs read back from their folders."""

import logging
from dataclasses import dataclass
from pathlib import Path

from deepracer_exp.config.compose import validate
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.run_files import read_config

from .references import resolve

logger = logging.getLogger("deepracer_exp")


@dataclass(frozen=True)
class StoredRun:
    """A run as its folder tells it."""

    path: Path
    experiment: Experiment
    checkpoint: str | None
    """Name of the checkpoint that is meant, if the run was given by a registered model's alias."""
    registered: str | None
    """That alias, as MODEL@ALIAS."""

    @property
    def checkpoints(self) -> Path:
        """Return the folder of its checkpoints."""
        return self.path / "checkpoints"

    def meant(self, given: str | None) -> str:
        """Return the name of the checkpoint that is meant.

        Args:
            given: `best`, `last` or an iteration; None: what the alias names, or the best. A run that ended before its
                first evaluation has no best: its last is taken, and a warning says so.
        """
        name = given or self.checkpoint
        if (
            name is None
            and not (self.checkpoints / "best").is_symlink()
            and (self.checkpoints / "last").exists()
        ):
            logger.warning(
                "%s: ended before its policy was evaluated, so checkpoint=last is used", self.path.name
            )
            return "last"
        return name or "best"


def read_run(run: str, runs_dir: Path, tracking_uri: str | None) -> StoredRun:
    """Find a run and read its configuration.

    Args:
        run: its folder, the folder's name or the beginning of it; MLflow's id; `best:EXPERIMENT`; or the alias of a
            registered model, `MODEL@ALIAS` or, where exactly one model has it, `ALIAS`.
        runs_dir: where runs are.
        tracking_uri: where ids and aliases are looked up; None: in `runs_dir`.

    Raises:
        BadInput: no run, or several, are meant, its configuration is not one of this version, or a registered
            checkpoint is not what it was.
    """
    meant = resolve(run, runs_dir, tracking_uri)
    mapping = read_config(meant.path)
    try:
        experiment = validate(mapping)
    except BadInput as error:
        file = meant.path / "config.yaml"
        raise BadInput(f"{file}: {error}; was the run made by another version?") from None
    return StoredRun(meant.path, experiment, meant.checkpoint, meant.registered)


def find_run(run: str, runs_dir: Path, tracking_uri: str | None) -> Path:
    """Return the folder of a run; arguments as in `read_run`.

    Raises:
        BadInput: no run, or several, are meant.
    """
    return resolve(run, runs_dir, tracking_uri).path
