"""Settings of a run: collection, checkpoints, budget and tracking."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, Tag

from .bounds import Count, Positive, UpTo1000
from .own_class import OURS_OR_OWN, OwnClass

Newest = Annotated[int, Field(ge=1, le=100_000)]
Percent = Annotated[int, Field(ge=1, le=100)]
_FEWEST_CARS = 4


@dataclass(frozen=True, kw_only=True)
class CollectorConfig:
    """The collection of experience: in this process or in workers."""

    mode: Literal["in_process", "sync"]
    processes: UpTo1000 | None
    cars: Annotated[int, Field(ge=1, le=100_000)]
    threads: Annotated[int, Field(ge=0, le=1024)]
    hang_timeout_s: Annotated[float, Field(ge=1, le=600)]

    @property
    def forks(self) -> bool:
        """Whether the training starts worker processes on its own machine."""
        return self.mode == "sync"

    @property
    def accepted_processes(self) -> list[int]:
        """Numbers of processes over which the cars can be spread: evenly, at least four in each.

        For fewer than four rows a matrix product may have other last digits, and a run would depend on the processes.
        """
        return [1, *(n for n in range(2, self.cars // _FEWEST_CARS + 1) if self.cars % n == 0)]


@dataclass(frozen=True, kw_only=True)
class TrackingOff:
    """No MLflow; the run folder holds everything."""

    kind: Literal["off"]


@dataclass(frozen=True, kw_only=True)
class MLflowTracking:
    """Record the run in MLflow."""

    kind: Literal["mlflow"]
    uri: str | None


@dataclass(frozen=True, kw_only=True)
class TensorBoardTracking:
    """Write TensorBoard's event files into the run folder."""

    kind: Literal["tensorboard"]


@dataclass(frozen=True, kw_only=True)
class WandbTracking:
    """Record the run in Weights & Biases."""

    kind: Literal["wandb"]
    project: Annotated[str, Field(min_length=1)]
    entity: str | None
    mode: Literal["online", "offline"]


PresetTracking = TrackingOff | MLflowTracking | TensorBoardTracking | WandbTracking
TrackingConfig = Annotated[
    Annotated[PresetTracking, Field(discriminator="kind"), Tag("ours")] | Annotated[OwnClass, Tag("own")],
    OURS_OR_OWN,
]


@dataclass(frozen=True, kw_only=True)
class CheckpointsConfig:
    """Choice of a run's best policy, and number of kept checkpoints."""

    every: Count | None
    metric: Literal["race_score", "reliable_lap", "lap_time", "progress"]
    keep: Newest


@dataclass(frozen=True, kw_only=True)
class BudgetConfig:
    """Limits that end a run; null means none. The first one reached ends it."""

    env_steps: Count | None
    iterations: Count | None
    minutes: Positive | None
    alerts: tuple[Percent, ...]
    alert_command: Annotated[str, Field(min_length=1)] | None
    schedule_until: Positive = 1.0

    def __post_init__(self) -> None:
        """Refuse a budget without any limit."""
        if self.env_steps is None and self.iterations is None and self.minutes is None:
            raise ValueError("env_steps, iterations and minutes are all null; at least one must end the run")
