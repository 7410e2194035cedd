"""How an experiment is collected, ended and recorded."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import UpTo1000


@dataclass(frozen=True, kw_only=True)
class CollectorConfig:
    """Where the cars are driven."""

    mode: Literal["in_process", "sync", "async", "ray"]
    """Cars in this process; in several, all waited for; in several, whichever is ready; as sync, on a Ray cluster."""
    processes: UpTo1000 | None
    """Worker processes; null: one per core, which `ray` does not know."""
    cars: Annotated[int, Field(ge=1, le=10_000)]
    """Cars per process, stepped together."""
    threads: Annotated[int, Field(ge=0, le=1024)]
    """Physics threads per process (0: in_process one per core, else one)."""
    hang_timeout_s: Annotated[float, Field(ge=1, le=600)]
    """Seconds without a control step after which a worker process counts as hanging."""

    @property
    def forks(self) -> bool:
        """Whether cars are driven in processes that the training starts on its own machine."""
        return self.mode in ("sync", "async")


@dataclass(frozen=True, kw_only=True)
class TrackingOff:
    """No MLflow; the run folder alone tells everything."""

    kind: Literal["off"]


@dataclass(frozen=True, kw_only=True)
class MLflowTracking:
    """Record the run in MLflow."""

    kind: Literal["mlflow"]
    uri: str | None
    """Store or server; null: SQLite in `runs_dir`."""


TrackingConfig = Annotated[TrackingOff | MLflowTracking, Field(discriminator="kind")]
