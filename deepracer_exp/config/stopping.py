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
    """Stop once the car drives reliably: it completed a share of the last episodes, or of the last evaluated laps.

    `held_out_completion`, per cent of the lap, is the mean that these evaluations must also reach under held-out
    conditions.
    """

    kind: Literal["reliable"]
    lap_share: Fraction
    episodes: Count
    evaluations: Count | None = None
    held_out_completion: Percent | None = None


@dataclass(frozen=True, kw_only=True)
class PlateauStopping:
    """Stop once a metric no longer improves."""

    kind: Literal["plateau"]
    metric: Literal["completion", "mean_return", "eval_completion", "held_out_completion"]
    window: Count
    warmup: Natural
    patience: Count
    gain: NonNegative


@dataclass(frozen=True, kw_only=True)
class ConvergedRule:
    """The policy no longer improves."""

    warmup: Natural
    patience: Count
    completion_near: Percent
    completion_gain: Percent
    return_gain: Fraction
    laps_gain: Fraction
    entropy_change: NonNegative
    best_patience: Count
    best_gain: Fraction


@dataclass(frozen=True, kw_only=True)
class OverfittingRule:
    """The policy becomes less sure on held-out conditions, and its laps hardly faster."""

    warmup: Natural
    patience: Count
    held_out_drop: Percent
    lap_gain: Fraction = 1.0
    return_drop: Fraction


@dataclass(frozen=True, kw_only=True)
class LapsSlowerRule:
    """The evaluated laps of the policy become slower while its return holds."""

    warmup: Natural
    patience: Count
    slower: Fraction
    return_drop: Fraction


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
    completion_gain: Percent
    completion_poor: Percent


@dataclass(frozen=True, kw_only=True)
class EntropyStopping:
    """Stop trainings that have converged, overfit, become slower, collapsed or do not learn."""

    kind: Literal["entropy"]
    window: Count
    converged: ConvergedRule | None
    overfitting: OverfittingRule | None
    collapsed: CollapsedRule | None
    not_learning: NotLearningRule | None
    laps_slower: LapsSlowerRule | None


PresetStopping = NoStopping | ReliableStopping | PlateauStopping | EntropyStopping
StoppingConfig = Annotated[
    Annotated[PresetStopping, Field(discriminator="kind"), Tag("ours")] | Annotated[OwnClass, Tag("own")],
    OURS_OR_OWN,
]
