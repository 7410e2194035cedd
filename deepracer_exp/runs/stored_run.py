"""A run on disk, its configuration and the checkpoint chosen of it."""

import contextlib
import hashlib
import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.config import acting
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.own_class import OF_POLICY
from deepracer_exp.config.parse import import_own_classes, parse_experiment, take_over_files
from deepracer_exp.errors import BadInput
from deepracer_exp.files import read_bytes

from .checkpoint_files import find_checkpoint, restore_links
from .run_files import CHECKPOINTS, CONFIG, PROVENANCE, read_config, read_object

if TYPE_CHECKING:
    from .checkpoints import StoredPolicy

logger = logging.getLogger("deepracer_exp")


@dataclass(frozen=True)
class StoredRun:
    """A run found on disk."""

    path: Path
    checkpoint: str | None = None
    """Name of the chosen checkpoint: `best`, `last`, `fastest` or an iteration; None: not chosen."""
    was_never_evaluated: bool = False
    """Whether the checkpoint is `last` only because the run ended before it had a best one."""
    registered: str | None = None
    """The registered alias of the checkpoint, as MODEL@ALIAS."""

    @cached_property
    def experiment(self) -> Experiment:
        """Configuration of the run, without values that act and are not the user's own (`config.acting`).

        A warning names each file of a track that has changed since the run began.

        Raises:
            BadInput: it cannot be read, or was written by another version.
        """
        mapping = read_config(self.path)
        acting.leave_out_foreign(mapping, self.path.name)
        try:
            take_over_files(mapping)  # an earlier version has kept their paths alone
            experiment = parse_experiment(mapping)
        except BadInput as error:
            raise BadInput(self.path / CONFIG, f"{error}; was the run made by another version?") from None
        recorded = read_object(self.path / PROVENANCE).get("tracks", {})
        for file, sha256 in track_hashes(experiment).items():
            if recorded.get(file, sha256) != sha256:
                logger.warning("%s: %s has other contents than when the run began", self.path.name, file)
        return experiment

    @property
    def checkpoints(self) -> Path:
        """The folder of its checkpoints."""
        restore_links(self.path / CHECKPOINTS)
        return self.path / CHECKPOINTS

    def with_checkpoint(self, name: str | None = None) -> "StoredRun":
        """Return the run with the checkpoint to use.

        `name` is `best`, `last`, `fastest` or an iteration; None: the alias's, or the best. A run that ended before its
        first evaluation has no best: its last is used, with a warning when it is read.

        Raises:
            BadInput: there is no such checkpoint.
        """
        folder, name = self.checkpoints, name or self.checkpoint
        best, last = folder / "best", folder / "last"
        only_last = name is None and not (best.is_symlink() or best.exists()) and last.exists()
        name = "last" if only_last else name or "best"
        find_checkpoint(folder, name)
        return replace(self, checkpoint=name, was_never_evaluated=only_last)

    def with_policy(self, checkpoint: str | None = None) -> "StoredRun":
        """Return the run as `with_checkpoint` does; import the classes of the user's own that its policy needs.

        Raises:
            BadInput: there is no such checkpoint, another version wrote the configuration, or a class is not named
                again or cannot be imported.
        """
        chosen = self.with_checkpoint(checkpoint)
        import_own_classes(chosen.experiment, OF_POLICY)
        return chosen

    def read_policy(self) -> "StoredPolicy":
        """Read the networks of the chosen checkpoint, or of the newest intact one if `best` or `last` is corrupt.

        Raises:
            BadInput: the checkpoint is corrupt or does not fit the configuration.
        """
        from .checkpoints import read_checkpoint  # imports PyTorch

        if self.was_never_evaluated:
            logger.warning(
                "%s: ended before its policy was evaluated, so checkpoint=last is used", self.path.name
            )
        assert self.checkpoint is not None
        return read_checkpoint(self.experiment, self.checkpoints, self.checkpoint)


def track_hashes(experiment: Experiment) -> dict[str, str]:
    """Return the hash of each file that an experiment's tracks are read from, by path; of those that can be read."""
    hashes = {}
    for file in filter(None, (track.file for track in experiment.tracks.values())):
        with contextlib.suppress(BadInput):  # the track's reader says why
            hashes[file] = hashlib.sha256(read_bytes(file, "a track")).hexdigest()
    return hashes
