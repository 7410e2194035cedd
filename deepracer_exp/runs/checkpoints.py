"""Checkpoints of a run: the best, the last and the newest few."""

import contextlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

from deepracer_exp.agents.ppo import Algorithm
from deepracer_exp.errors import RunFailed

from .checkpoint_files import pinned, write_hashes
from .files import CHECKPOINTS
from .read_checkpoint import AGENT, TRAINING, State


class CheckpointStore:
    """`checkpoints/` of a run folder: one directory per kept iteration, and the links `best` and `last`.

    A directory is written aside with the hashes of its files and moved into place whole (torchrl.checkpoint: tensors
    and JSON, no pickle); a link changes in one step, and what is older is removed after that. So whenever the run is
    killed, both names lead to a complete checkpoint.
    """

    def __init__(self, run_dir: Path, keep: int, every: int | None = None):
        """Open the folder, make it if there is none, and clear away what a kill left unfinished.

        Args:
            run_dir: folder of the run.
            keep: how many of the newest checkpoints stay.
            every: iterations between two evaluations: only evaluated checkpoints stay, so that all that are there at
                the end compare; None: there are no evaluations, and any checkpoint stays.

        Raises:
            BadInput: it is not known which checkpoints must stay.
            OSError: the folder takes no more.
        """
        self.folder = run_dir / CHECKPOINTS
        self.folder.mkdir(exist_ok=True)
        self._keep, self._every = keep, every or 1
        for path in self.folder.glob(".*"):
            _remove(path)
        pinned(self.folder)

    def save(
        self,
        agent: Algorithm,
        counters: Mapping[str, Any],
        training: Mapping[str, Any] | None = None,
        *,
        best: bool = False,
    ) -> None:
        """Save the agent under the number of its iteration.

        Args:
            agent: networks, optimizer and schedule.
            counters: iteration, env steps and the like, JSON types.
            training: the rest of what a resumed training needs: tensors, arrays and JSON types; None: no training
                can resume from here, and the checkpoint is not `last`.
            best: it is the best so far.

        Raises:
            OSError, RunFailed: the disk takes no more; what was there before is as it was.
        """
        name = checkpoint_name(counters["iteration"])
        if not (self.folder / name).exists():  # nothing is learned between two updates
            self._write(name, agent, counters, training)
        if best:
            self._link("best", name)
        if training is not None:
            self._link("last", name)
        self._prune()

    def mark_best(self, iteration: int) -> None:
        """Let `best` lead to an iteration's checkpoint; the one before stays, for a run that resumes with it."""
        self._link("best", checkpoint_name(iteration))

    def rewind(self, iteration: int, best: int | None) -> None:
        """Go back to an iteration: `last` is its checkpoint, and what came later goes, unless it must stay.

        Args:
            iteration: it has a checkpoint.
            best: iteration of the best checkpoint up to there, None if there was none.
        """
        pins = pinned(self.folder)
        for path in self._own():
            if int(path.name) > iteration and path.name not in pins:
                _remove(path)
        for label, number in (("last", iteration), ("best", best)):
            if number is not None and (self.folder / checkpoint_name(number)).is_dir():
                self._link(label, checkpoint_name(number))
            else:
                (self.folder / label).unlink(missing_ok=True)

    def _write(
        self, name: str, agent: Algorithm, counters: Mapping[str, Any], training: Mapping[str, Any] | None
    ) -> None:
        # Memory-mapped tensors, the default, would end the process by SIGBUS on a full disk.
        archive = StateDictCheckpointAdapter("archive")
        checkpoint = Checkpoint().register(AGENT, agent, adapter=archive)
        if training is not None:
            checkpoint.register(TRAINING, State(training), adapter=archive)
        aside = self.folder / f".{name}"
        try:
            checkpoint.save(aside, metadata=dict(counters))
            write_hashes(aside)
            aside.rename(self.folder / name)
        except (RuntimeError, OSError) as error:  # RuntimeError: torch's word for a full disk
            with contextlib.suppress(OSError):
                _remove(aside)
            reason = str(error).splitlines()[0]
            raise RunFailed(f"{self.folder / name}: the checkpoint cannot be written: {reason}") from error

    def _link(self, label: str, name: str) -> None:
        aside = self.folder / f".{label}"
        aside.unlink(missing_ok=True)
        aside.symlink_to(name, target_is_directory=True)
        aside.replace(self.folder / label)

    def _prune(self) -> None:
        own = self._own()
        kept = {str(path.readlink()) for path in self.folder.iterdir() if path.is_symlink()}
        # The one of the start is of no use once there is another.
        evaluated = [path.name for path in own if int(path.name) and int(path.name) % self._every == 0]
        kept |= {*evaluated[-self._keep :]} | pinned(self.folder).keys()
        for path in own:
            if path.name not in kept:
                _remove(path)

    def _own(self) -> list[Path]:
        """Return the checkpoints, the oldest first."""
        found = (path for path in self.folder.iterdir() if path.name.isdigit() and path.is_dir())
        return sorted(found, key=lambda path: int(path.name))


def checkpoint_name(iteration: int) -> str:
    """Return the name of the folder of an iteration's checkpoint."""
    return f"{iteration:06d}"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
