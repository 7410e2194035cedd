"""The parent of a study: the checkpoint that each of its trials clones."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from deepracer_exp.errors import BadInput

if TYPE_CHECKING:
    from deepracer_exp.training.clone import Clone


@dataclass(frozen=True)
class Parent:
    """A run and its checkpoint, found when a study is begun: `best:NAME` and aliases may mean another run later."""

    run_dir: str
    checkpoint: int

    @classmethod
    def find(cls, run: str, study: str, runs_dir: Path) -> Self:
        """Return the parent that a study's `parent=RUN` means now.

        Raises:
            BadInput: the run or its checkpoint cannot be used.
        """
        from deepracer_exp.training.clone import prepare_clone

        try:
            _, lineage = prepare_clone([f"run={run}", f"name={study}"], runs_dir, None).start
        except BadInput as error:
            raise BadInput(f"parent={run}", error.without(run)) from error
        return cls(lineage.parent_dir, int(lineage.checkpoint))

    def clone(self, overrides: Sequence[str], runs_dir: Path, *, stored: bool) -> "Clone":
        """Return what a trial with these overrides is trained with; `stored` as of `prepare_clone`."""
        from deepracer_exp.training.clone import prepare_clone

        reference = [f"run={self.run_dir}", f"checkpoint={self.checkpoint}"]
        return prepare_clone([*reference, *overrides], runs_dir, None, stored=stored)
