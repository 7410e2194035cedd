"""What a command that races a stored policy was asked, with the answers; nothing here imports PyTorch."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.config.evaluation import EvaluateConfig, EvaluationConfig
from deepracer_exp.config.overrides import group_of
from deepracer_exp.config.own_class import OF_POLICY
from deepracer_exp.config.parse import import_own_classes
from deepracer_exp.env.real_car import require_car
from deepracer_exp.lookup.resolve import StoredRun, resolve


@dataclass(frozen=True)
class EvaluatePlan:
    """A stored policy, and how it is raced."""

    run: StoredRun
    """The run, with its checkpoint."""
    config: EvaluateConfig
    training_protocol: EvaluationConfig
    """The protocol that was named; if none was, the one by which the training evaluated."""


def plan_evaluation(run: str, overrides: Sequence[str], *, has_checkpoint: bool = True) -> EvaluatePlan:
    """Compose an evaluation, and find the run that it races, and its checkpoint if `has_checkpoint`.

    Raises:
        BadInput: as for `compose_evaluation`, `resolve` and `StoredRun.with_policy`, or the physical car could not
            run the policy.
    """
    config, _ = compose_evaluation(overrides)
    stored = resolve(run, Path(config.runs_dir), config.tracking.uri)
    if has_checkpoint:
        stored = stored.with_policy(config.checkpoint)
    else:
        import_own_classes(stored.experiment, OF_POLICY)
    if config.evaluation.real_car is not None:
        require_car(stored.experiment)
    is_named = any(group_of(override) == "evaluation" for override in overrides)
    return EvaluatePlan(stored, config, config.evaluation if is_named else stored.experiment.evaluation)
