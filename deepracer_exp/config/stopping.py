"""Stopping rules, which end a run before its budget does (`conf/stopping/`)."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, Tag

from .bounds import Count, Fraction, Natural, NonNegative
from .own_class import OURS_OR_OWN, OwnClass

Percent = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class NoStopping:
    """Only the budget ends the run."""

    kind: Literal["none"]


@dataclass(frozen=True, kw_only=True)
class ReliableStopping:
    """Stop once the car drives reliably: a share of the last episodes completed the lap."""

    kind: Literal["reliable"]
    lap_share: Fraction
    episodes: Count
    """Number of the last finished episodes that count."""


@dataclass(frozen=True, kw_only=True)
class PlateauStopping:
    """Stop once a metric no longer improves."""

    kind: Literal["plateau"]
    metric: Literal["completion", "mean_return", "eval_completion", "held_out_completion"]
    window: Count
    """Iterations of the moving average."""
    warmup: Natural
    """Iterations before the rule applies."""
    patience: Count
    """Iterations without improvement."""
    gain: NonNegative
    """Improvement that counts, as a share of the range so far."""


@dataclass(frozen=True, kw_only=True)
class ConvergedRule:
    """The policy no longer improves."""

    warmup: Natural
    patience: Count
    completion_near: Percent
    """How far completion may be below its best, in percentage points."""
    completion_gain: Percent
    """Percentage points of completion that count as improvement."""
    return_gain: Fraction
    """Improvement of the return that counts, as a share of the range so far."""
    laps_gain: Fraction
    """Improvement of the laps per step that counts, as a share of their best."""
    entropy_change: NonNegative
    """Change of the normalised entropy up to which it counts as constant."""
    best_patience: Count
    """Iterations without a better policy, if policies are evaluated."""
    best_gain: Fraction
    """Improvement of the race score (usual and held-out) that counts, as a share."""


@dataclass(frozen=True, kw_only=True)
class OverfittingRule:
    """The policy improves on the training's conditions only."""

    warmup: Natural
    patience: Count
    held_out_drop: Percent
    """Drop of held-out completion below its best, in percentage points."""
    return_drop: Fraction
    """How far the return may be below its best and still count as stable, as a share of the range so far."""


@dataclass(frozen=True, kw_only=True)
class LapsSlowerRule:
    """The evaluated laps of the policy become slower while its return holds."""

    warmup: Natural
    patience: Count
    slower: Fraction
    """How much slower than the fastest laps all later ones are, as a share of the speed."""
    return_drop: Fraction
    """How far the return may be below its best and still count as stable, as a share of the range so far."""


@dataclass(frozen=True, kw_only=True)
class CollapsedRule:
    """The policy has become almost deterministic and drives badly."""

    warmup: Natural
    patience: Count
    entropy_floor: NonNegative
    completion_poor: Percent


@dataclass(frozen=True, kw_only=True)
class NotLearningRule:
    """The policy has hardly changed since the start."""

    warmup: Natural
    patience: Count
    entropy_near: Fraction
    """Normalised entropy above which the policy counts as unchanged."""
    completion_gain: Percent
    """Percentage points of completion since the start that count as learning."""
    completion_poor: Percent
    """Completion from which on the rule no longer applies."""


@dataclass(frozen=True, kw_only=True)
class EntropyStopping:
    """Stop trainings that have converged, overfit, become slower, collapsed or do not learn."""

    kind: Literal["entropy"]
    window: Count
    """Iterations of the moving averages."""
    converged: ConvergedRule | None
    """null: this rule never stops a run; likewise for the others."""
    overfitting: OverfittingRule | None
    collapsed: CollapsedRule | None
    not_learning: NotLearningRule | None
    laps_slower: LapsSlowerRule | None


PresetStopping = NoStopping | ReliableStopping | PlateauStopping | EntropyStopping
StoppingConfig = Annotated[
    Annotated[PresetStopping, Field(discriminator="kind"), Tag("ours")] | Annotated[OwnClass, Tag("own")],
    OURS_OR_OWN,
]
