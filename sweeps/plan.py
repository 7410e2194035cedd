"""What a worker is told when it begins."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from deepracer_exp.addresses import taken_out
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.tracking.store import Store

from .space import SearchSpace


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A sweep, as each of its workers knows it."""

    study: str
    runs_dir: Path
    config: SweepConfig
    protocol: EvaluationConfig
    space: SearchSpace
    parent: tuple[str, ...]
    """Overrides that name the run and the checkpoint that trials are clones of, the same for all; else none."""
    store: Store | None
    """Where runs are recorded; None with `tracking=off`."""
    study_run_id: str | None
    """MLflow's id of the run of the whole study, None where it has none."""
    evaluations: int | None
    """How many a trial has on its way, None where that depends on the trial."""
    cores: int
    """For each worker."""
    addresses: Mapping[str, str] = field(default_factory=taken_out, repr=False)
    """Of servers and databases, as they were given, by what the others of this plan know of them."""

    @property
    def folder(self) -> Path:
        """Where the runs of the sweep are."""
        return self.runs_dir / self.study
