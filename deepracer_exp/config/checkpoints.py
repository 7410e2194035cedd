"""Which checkpoints of a run are kept, and which of them is the best (`conf/checkpoints/`)."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import Count

Newest = Annotated[int, Field(ge=1, le=100_000)]


@dataclass(frozen=True, kw_only=True)
class CheckpointsConfig:
    """How the best policy of a run is found, and how many others stay."""

    every: Count | None
    """Iterations between two evaluations (group `evaluation`), the last iteration being evaluated as well; null: none
    is, and the training's own episodes say which policy was the best."""
    metric: Literal["race_score", "lap_time", "progress"]
    """What the evaluations are ranked by."""
    keep: Newest
    """How many of the newest evaluated checkpoints stay beside the best and the last."""
