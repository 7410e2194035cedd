"""Checkpoints of a run: the best and the last."""

import contextlib
import shutil
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

from deepracer_exp.agents.ppo import PPO
from deepracer_exp.errors import RunFailed


class CheckpointStore:
    """`checkpoints/` of a run folder: one directory per kept iteration, and the links `best` and `last`.

    A directory is written aside and moved into place whole (torchrl.checkpoint: tensors and JSON, no pickle); a link
    changes in one step. So whenever the run is killed, both names lead to a complete checkpoint.
    """

    def __init__(self, run_dir: Path):
        self.folder = run_dir / "checkpoints"
        self.folder.mkdir()
        self._best_rank: tuple[float, float] | None = None

    def save(self, agent: PPO, counters: dict[str, Any], rank: tuple[float, float] | None) -> bool:
        """Save the agent as `last`, and as `best` if its rank is the highest so far.

        Args:
            agent: networks, optimizer and schedule.
            counters: iteration, env steps and the like, JSON types.
            rank: compared in order, higher is better; None: not to be ranked.

        Returns:
            Whether it is the new best.

        Raises:
            OSError, RunFailed: the disk takes no more.
        """
        name = f"{counters['iteration']:06d}"
        if not (self.folder / name).exists():  # nothing is learned between two updates
            # Memory-mapped tensors, the default, would end the process by SIGBUS on a full disk.
            archive = StateDictCheckpointAdapter("archive")
            checkpoint = Checkpoint().register("agent", agent, adapter=archive)
            try:
                checkpoint.save(self.folder / name, metadata=counters)
            except RuntimeError as error:  # torch's word for a full disk
                reason = str(error).splitlines()[0]
                raise RunFailed(
                    f"{self.folder / name}: the checkpoint cannot be written: {reason}"
                ) from error
        best = self.is_better(rank)
        if best:
            self._best_rank = rank
            self._link("best", name)
        self._link("last", name)
        self._prune()
        return best

    def is_better(self, rank: tuple[float, float] | None) -> bool:
        """Return whether a checkpoint of this rank would be the new best."""
        return rank is not None and (self._best_rank is None or rank > self._best_rank)

    def _link(self, label: str, name: str) -> None:
        aside = self.folder / f".{label}"
        with contextlib.suppress(FileNotFoundError):
            aside.unlink()
        aside.symlink_to(name, target_is_directory=True)
        aside.replace(self.folder / label)

    def _prune(self) -> None:
        kept = {str(path.readlink()) for path in self.folder.iterdir() if path.is_symlink()}
        for path in self.folder.iterdir():
            if path.is_dir() and not path.is_symlink() and path.name not in kept:
                shutil.rmtree(path)
