"""The configuration of a worker process, its name, the run that its trials clone, and the plan of a trial."""

import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import psutil

from deepracer_exp.addresses import taken_out
from deepracer_exp.config import acting
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoint_files import pin
from deepracer_exp.runs.run_files import CHECKPOINTS
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.sweeps.search.space import SearchSpace
from deepracer_exp.tracking.resolve import resolve
from deepracer_exp.tracking.store import Store
from deepracer_exp.training.clone import plan_clone, read_parent
from deepracer_exp.training.plan import TrainPlan, plan_training

RUN_ID = "mlflow_run_id"
"""Attribute of a study in Optuna: MLflow's id of its run, once it is known."""


@dataclass(frozen=True)
class Parent:
    """A run and its checkpoint, resolved when a study begins: `best:NAME` and aliases may mean another run later."""

    run_dir: str
    checkpoint: int

    @classmethod
    def find(cls, run: str, study: str, runs_dir: Path, uri: str | None) -> Self:
        """Return the parent that a study's `parent=RUN` means now; its checkpoint is pinned.

        Raises:
            BadInput: the run or its checkpoint cannot be used.
        """
        try:
            parent = resolve(run, runs_dir, uri).with_checkpoint()
            plan_clone(parent, [f"name={study}"])
            _, lineage = read_parent(parent)
            pin(parent.path / CHECKPOINTS, lineage.checkpoint, f"cloned by the study {study}")
        except BadInput as error:
            raise BadInput(f"parent={run}", error.without(run)) from error
        return cls(lineage.parent_dir, int(lineage.checkpoint))


@dataclass(frozen=True, kw_only=True)
class WorkerConfig:
    """A sweep as each of its workers knows it."""

    study: str
    runs_dir: Path
    config: SweepConfig
    protocol: EvaluationConfig
    space: SearchSpace
    parent: Parent | None
    """The run that all trials are clones of; None if they start from scratch."""
    store: Store | None
    """The MLflow that records the runs; None with `tracking=off`."""
    study_run_id: str | None
    """MLflow's id of the study's run, None if it has none, or none yet."""
    evaluations: int | None
    """Evaluations of a trial before its end, None where that depends on the trial."""
    cores: int
    """Per worker."""
    named: Mapping[str, str] = field(default_factory=acting.named, repr=False)
    """The acting values that the user of the sweep has named, see `acting`."""
    addresses: Mapping[str, str] = field(default_factory=taken_out, repr=False)
    """Addresses of servers and databases with their passwords, by the redacted form the other fields hold."""

    @property
    def folder(self) -> Path:
        """The folder of the study's runs."""
        return self.runs_dir / self.study


def owner_name(pid: int, token: str) -> str:
    """Return a worker's unique name; the token is random, because process ids are reused."""
    return f"{socket.gethostname()}:{pid}:{token}"


def is_gone(owner: str) -> bool:
    """Return whether a worker ran on this machine and its process no longer exists.

    If two machines share a name, a live worker may be taken for dead. It then loses its trial and notices that, as
    after an expired lease.
    """
    host, pid, _ = owner.rsplit(":", 2)
    return host == socket.gethostname() and not psutil.pid_exists(int(pid))


def plan_trial(overrides: Sequence[str], parent: Parent | None, *, stored: bool) -> TrainPlan:
    """Plan the run of a trial: a training from scratch, or a clone of the study's parent.

    Arguments and errors as for `compose_experiment`, `plan_training` and `plan_clone`. Each worker is a process of its
    own, and reads the files again.
    """
    if parent is None:
        return plan_training(*compose_experiment(overrides, stored=stored))
    run = StoredRun(Path(parent.run_dir)).with_checkpoint(str(parent.checkpoint))
    return plan_clone(run, overrides, stored=stored)
