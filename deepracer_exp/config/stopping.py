"""What ends a run before its budget does (`conf/stopping/`)."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import Count, Fraction, Natural, NonNegative

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
    """How many of the last finished episodes are looked at."""


@dataclass(frozen=True, kw_only=True)
class PlateauStopping:
    """Stop once one number no longer grows."""

    kind: Literal["plateau"]
    metric: Literal["completion", "mean_return", "eval_completion", "held_out_completion"]
    window: Count
    """Iterations of the moving average."""
    warmup: Natural
    """Iterations before any verdict."""
    patience: Count
    """Iterations without growth."""
    gain: NonNegative
    """Growth that counts, as a share of the range seen so far."""


@dataclass(frozen=True, kw_only=True)
class ConvergedRule:
    """There is nothing more to gain."""

    warmup: Natural
    patience: Count
    completion_near: Percent
    """How far below its best completion may lie, in points."""
    completion_gain: Percent
    """Points of completion that count as growth."""
    return_gain: Fraction
    """Growth of the return that counts, as a share of the range seen so far."""
    laps_gain: Fraction
    """Growth of the laps per step that counts, as a share of their best."""
    entropy_change: NonNegative
    """Change of the normalised entropy that is flat."""
    best_patience: Count
    """Iterations without a better policy, as far as policies are evaluated."""
    best_gain: Fraction
    """How much better its race score must be, as a share."""


@dataclass(frozen=True, kw_only=True)
class OverfittingRule:
    """It learns what holds on the training's conditions only."""

    warmup: Natural
    patience: Count
    held_out_drop: Percent
    """Points of completion on held-out conditions below the best."""
    return_drop: Fraction
    """How far below its best the return may lie and still hold, as a share of the range seen so far."""


@dataclass(frozen=True, kw_only=True)
class CollapsedRule:
    """The policy has made up its mind and drives badly."""

    warmup: Natural
    patience: Count
    entropy_floor: NonNegative
    completion_poor: Percent


@dataclass(frozen=True, kw_only=True)
class NotLearningRule:
    """The policy stays what it was at the start."""

    warmup: Natural
    patience: Count
    entropy_near: Fraction
    """Normalised entropy above which the policy counts as unchanged."""
    completion_gain: Percent
    """Points of completion since the start that count as a movement."""
    completion_poor: Percent
    """Completion from which on there is nothing to complain of."""


@dataclass(frozen=True, kw_only=True)
class EntropyStopping:
    """Tell a finished training from a hopeless one by entropy, completion, laps and return."""

    kind: Literal["entropy"]
    window: Count
    """Iterations of the moving averages."""
    converged: ConvergedRule | None
    """A rule of null never stops a run."""
    overfitting: OverfittingRule | None
    collapsed: CollapsedRule | None
    not_learning: NotLearningRule | None


StoppingConfig = Annotated[
    NoStopping | ReliableStopping | PlateauStopping | EntropyStopping, Field(discriminator="kind")
]
