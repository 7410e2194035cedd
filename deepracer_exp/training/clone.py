"""A run that begins with another run's policy."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepracer_exp.agents.actor_critic import ActorCritic
from deepracer_exp.config import acting
from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import group_of, key_of
from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.config.stored import with_overrides
from deepracer_exp.lookup.resolve import StoredRun, resolve
from deepracer_exp.runs.checkpoint_files import checkpoint_sha256, pin
from deepracer_exp.runs.checkpoints import read_checkpoint
from deepracer_exp.runs.files import (
    CHECKPOINTS,
    PROVENANCE,
    REWARD,
    SUMMARY,
    read_config,
    read_object,
    read_run_id,
)
from deepracer_exp.runs.lineage import Lineage, read_lineage, refuse_other_networks

SLOWER = 0.1
"""A clone's learning rate over its parent's, where none is given: what racers do with a good model."""
_OWN = ("run", "checkpoint")
_AS_USUAL = ("report=true", "collector.mode=sync", "collector.processes=null", "collector.threads=0")
"""Settings for the clone of a sweep's trial, which had one core and no report, because others ran beside it."""
_ALLOWED = {
    "track": "the policy has to find its way on another road",
    "reward": "values learned for another reward are wrong at first",
    "car": "the policy knows another car",
}


@dataclass(frozen=True)
class Clone:
    """Everything that a clone is trained with."""

    experiment: Experiment
    composition: Composition
    start: tuple[ActorCritic, Lineage]
    """The networks to begin with, and whose they were."""
    notes: tuple[str, ...]
    """Notes for the user, a line each."""


def prepare_clone(
    overrides: Sequence[str], runs_dir: Path, tracking_uri: str | None, *, stored: bool = False
) -> Clone:
    """Read the parent and its checkpoint, and change its configuration; the checkpoint is pinned.

    Args:
        overrides: `run=` (required), perhaps `checkpoint=`, and what differs from the parent.
        runs_dir: where the parent is.
        tracking_uri: where ids and aliases are looked up; None: in `runs_dir`.
        stored: whether a study holds the overrides; the user's own words otherwise.

    Raises:
        BadInput: the parent or its checkpoint cannot be used, what the overrides ask for does not fit its networks, or
            its reward function is not the user's own.
    """
    options = dict(override.split("=", 1) for override in overrides if override.split("=", 1)[0] in _OWN)
    changes = [override for override in overrides if override.split("=", 1)[0] not in _OWN]
    parent = resolve(options["run"], runs_dir, tracking_uri)
    name = parent.choose_checkpoint(options.get("checkpoint"))
    checkpoint = read_checkpoint(parent.experiment, parent.checkpoints, name)
    composition = _changed(parent, changes, stored)
    experiment = parse_experiment(composition.mapping)
    acting.refuse_reward(experiment.reward.file, parent.path.name, parent.path / REWARD)
    refuse_other_networks(parent.experiment, experiment)
    above = read_lineage(parent.path)
    lineage = Lineage(
        parent=parent.path.name,
        parent_dir=str(parent.path.resolve()),
        parent_run_id=read_run_id(parent.path),
        checkpoint=checkpoint.path.name,
        sha256=checkpoint_sha256(checkpoint.path),
        generation=1 + (above.generation if above else 0),
        registered=parent.registered,
    )
    pin(parent.path / CHECKPOINTS, checkpoint.path.name, f"cloned into {experiment.name}")
    return Clone(
        experiment,
        composition,
        (checkpoint.networks, lineage),
        (*_notes(parent, experiment, checkpoint.path.name), *composition.notes),
    )


def _changed(parent: StoredRun, changes: Sequence[str], stored: bool) -> Composition:
    names = read_object(parent.path / PROVENANCE).get("names", {})
    keys = {key_of(change) for change in changes}
    is_trial = "trial" in read_object(parent.path / SUMMARY)
    usual = [line for line in _AS_USUAL if is_trial and group_of(line) not in keys]
    composition = with_overrides(read_config(parent.path), names, [*usual, *changes], stored=stored)
    if not keys & {"algorithm", "algorithm.lr"}:
        composition.mapping["algorithm"]["lr"] = parent.experiment.algorithm.lr * SLOWER
    if "runs_dir" not in keys:
        composition.mapping["runs_dir"] = str(parent.path.parent.parent)
    if parent.experiment.teacher is not None and "teacher" not in keys:
        # The parent has already learned from it.
        composition.mapping["teacher"] = None
        composition.mapping["algorithm"]["teacher_iterations"] = 0
    return composition


def _notes(parent: StoredRun, clone: Experiment, checkpoint: str) -> list[str]:
    before: dict[str, Any] = vars(parent.experiment)
    notes = [
        f"clone of {parent.path.name}, checkpoint {checkpoint}; learning rate {clone.algorithm.lr:g} "
        f"(the parent's: {parent.experiment.algorithm.lr:g})"
    ]
    for group, why in _ALLOWED.items():
        if vars(clone)[group] != before[group]:
            notes.append(f"warning: {group} is not the parent's: {why}")
    return notes
