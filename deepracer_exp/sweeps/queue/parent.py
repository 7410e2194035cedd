"""The parent of a study, the checkpoint that each of its trials clones; and the plan of a trial."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.lookup.resolve import StoredRun, resolve
from deepracer_exp.training.clone import plan_clone, read_parent
from deepracer_exp.training.plan import TrainPlan, plan_training


@dataclass(frozen=True)
class Parent:
    """A run and its checkpoint, found when a study is begun: `best:NAME` and aliases may mean another run later."""

    run_dir: str
    checkpoint: int

    @classmethod
    def find(cls, run: str, study: str, runs_dir: Path) -> Self:
        """Return the parent that a study's `parent=RUN` means now; its checkpoint is pinned.

        Raises:
            BadInput: the run or its checkpoint cannot be used.
        """
        try:
            parent = resolve(run, runs_dir, None).with_checkpoint()
            _, lineage = read_parent(parent, plan_clone(parent, [f"name={study}"]).experiment)
        except BadInput as error:
            raise BadInput(f"parent={run}", error.without(run)) from error
        return cls(lineage.parent_dir, int(lineage.checkpoint))


def plan_trial(overrides: Sequence[str], parent: Parent | None, *, stored: bool) -> TrainPlan:
    """Plan the run of a trial: a training from scratch, or a clone of the study's parent.

    Arguments and errors as for `compose_experiment`, `plan_training` and `plan_clone`. Each worker is a process of its
    own, and reads the files again.
    """
    if parent is None:
        return plan_training(*compose_experiment(overrides, stored=stored))
    run = StoredRun(Path(parent.run_dir)).with_checkpoint(str(parent.checkpoint))
    return plan_clone(run, overrides, stored=stored)
