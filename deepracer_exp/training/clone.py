"""Clones: runs that start from another run's networks."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from deepracer_exp.config import acting
from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import SACConfig
from deepracer_exp.config.overrides import group_of, key_of
from deepracer_exp.config.parse import import_own_classes, parse_experiment
from deepracer_exp.config.stored import with_overrides
from deepracer_exp.runs.checkpoint_files import checkpoint_sha256, checkpoint_words, find_checkpoint
from deepracer_exp.runs.lineage import Lineage, read_lineage, refuse_other_networks
from deepracer_exp.runs.run_files import (
    METRICS,
    PROVENANCE,
    REWARD,
    SUMMARY,
    read_config,
    read_metrics,
    read_object,
    read_run_id,
)
from deepracer_exp.runs.stored_run import StoredRun

from .plan import TrainPlan, plan_training

if TYPE_CHECKING:
    from deepracer_exp.agents.actor_critic import PolicyNetworks

SLOWER = 0.1
"""Default learning rate of a clone as a share of its parent's: the usual choice of racers for a good model."""
_AS_USUAL = (
    "report=true",
    "trace=full",
    "collector.mode=sync",
    "collector.processes=null",
    "collector.threads=0",
)
"""Settings that a clone does not take from a sweep's trial: one core, no report, a trace of laps only."""
_ALLOWED = {
    "track": "the policy has to find its way on another road",
    "reward": "values learned for another reward are wrong at first",
    "car": "the policy knows another car",
}


def plan_clone(parent: StoredRun, changes: Sequence[str], *, stored: bool = False) -> TrainPlan:
    """Change the configuration of a run and read its files.

    `parent` has the checkpoint to begin with. `stored`: whether the overrides come from a stored study, not from the
    user.

    Raises:
        BadInput: the overrides are not accepted or do not fit the parent's networks, or the reward function or a class
            is not the user's own.
    """
    composition = _changed(parent, changes, stored)
    experiment = parse_experiment(composition.mapping)
    import_own_classes(experiment)
    acting.refuse_reward(experiment.reward.file, parent.path.name, parent.path / REWARD)
    plan = plan_training(experiment, composition, parent)
    refuse_other_networks(parent.experiment, experiment)
    return plan


def read_parent(parent: StoredRun) -> "tuple[PolicyNetworks, Lineage]":
    """Read a clone's initial networks and their lineage.

    Raises:
        BadInput: the checkpoint cannot be used.
    """
    checkpoint, above = parent.read_policy(), read_lineage(parent.path)
    name = checkpoint.path.name
    return checkpoint.networks, Lineage(
        parent=parent.path.name,
        parent_dir=str(parent.path.resolve()),
        parent_run_id=read_run_id(parent.path),
        checkpoint=name,
        sha256=checkpoint_sha256(checkpoint.path),
        generation=1 + (above.generation if above else 0),
        registered=parent.registered,
    )


def describe_clone(parent: StoredRun, clone: Experiment, lineage: Lineage) -> list[str]:
    """Describe a clone's origin, and warn of each group that differs from its parent's, a line each."""
    before: dict[str, Any] = vars(parent.experiment)
    notes = [
        f"clone of {parent.path.name}, {checkpoint_words(lineage.checkpoint)}; learning rate {clone.algorithm.lr:g} "
        f"(the parent's: {parent.experiment.algorithm.lr:g})"
    ]
    for group, why in _ALLOWED.items():
        if vars(clone)[group] != before[group]:
            notes.append(f"warning: {group} is not the parent's: {why}")
    return notes


def _learned_alpha(parent: StoredRun) -> float | None:
    """Return the temperature that soft actor-critic had learned at the parent's checkpoint; None: it learns none."""
    algorithm, file = parent.experiment.algorithm, parent.path / METRICS
    if not (isinstance(algorithm, SACConfig) and algorithm.learn_alpha and file.exists()):
        return None
    checkpoint = find_checkpoint(parent.checkpoints, parent.checkpoint or "best").resolve().name
    learned = {row["iteration"]: row.get("alpha") for row in read_metrics(file)}
    return learned.get(int(checkpoint))


def _changed(parent: StoredRun, changes: Sequence[str], stored: bool) -> Composition:
    names = read_object(parent.path / PROVENANCE).get("names", {})
    keys = {key_of(change) for change in changes}
    is_trial = "trial" in read_object(parent.path / SUMMARY)
    usual = [line for line in _AS_USUAL if is_trial and group_of(line) not in keys]
    composition = with_overrides(read_config(parent.path), names, [*usual, *changes], stored=stored)
    if not keys & {"algorithm", "algorithm.lr"}:
        composition.mapping["algorithm"]["lr"] = parent.experiment.algorithm.lr * SLOWER
    if not keys & {"algorithm", "algorithm.alpha"} and (alpha := _learned_alpha(parent)) is not None:
        composition.mapping["algorithm"]["alpha"] = alpha
    if not keys & {"budget", "budget.schedule_until"}:
        # That of a parent that was resumed with a larger budget; a clone's schedules follow its own.
        composition.mapping["budget"]["schedule_until"] = 1.0
    if "runs_dir" not in keys:
        composition.mapping["runs_dir"] = str(parent.path.parent.parent)
    return composition
