"""What an MLflow store knows of all its runs at once."""

from dataclasses import dataclass
from pathlib import Path

from .lookup import asked
from .registry import pages, registered_checkpoints


@dataclass(frozen=True)
class Overview:
    """The runs of a store."""

    deleted: dict[str, bool]
    """Every run by its id: whether it was deleted there."""
    registered: set[tuple[str, str]]
    """Checkpoints that are versions of a model: name of the run's folder, name of the checkpoint's."""


def look_over(uri: str | None, runs_dir: Path) -> Overview:
    """Ask a store for its runs and models.

    Args:
        uri: the store, as in `tracking.uri`; None: the one in `runs_dir`.
        runs_dir: where runs are.

    Raises:
        BadInput: the store does not answer.
    """
    with asked("MLflow", uri, runs_dir) as client:
        from mlflow.entities import ViewType

        everything = {"view_type": ViewType.ALL}
        experiments = [one.experiment_id for one in pages(client.search_experiments, **everything)]
        runs = pages(client.search_runs, experiment_ids=experiments, run_view_type=ViewType.ALL)
        deleted = {run.info.run_id: run.info.lifecycle_stage != "active" for run in runs}
        return Overview(deleted, registered_checkpoints(client))
