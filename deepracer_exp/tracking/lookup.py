"""From MLflow's id of a run to the folder the run wrote."""

import re
from pathlib import Path

from deepracer_exp.errors import BadInput

from .store import resolve_store


def is_run_id(text: str) -> bool:
    """Return whether this looks like MLflow's id of a run."""
    return re.fullmatch(r"[0-9a-f]{32}", text) is not None


def folder_of(run_id: str, uri: str | None, runs_dir: Path) -> Path:
    """Return the folder that a recorded run wrote.

    Args:
        run_id: MLflow's.
        uri: the store, as in `tracking.uri`; None: the one in `runs_dir`.
        runs_dir: where runs are.

    Raises:
        BadInput: the store has no such run, or it was deleted there, or it does not answer.
    """
    if uri is None and not (runs_dir / "mlflow.db").is_file():
        raise BadInput(
            f"run={run_id}: {runs_dir} has no mlflow.db to look it up in; give tracking_uri or a run's folder"
        )
    store = resolve_store(uri, runs_dir)
    # Three seconds of import that only ids need; the module before it switches retries and telemetry off.
    from . import mlflow_run as _settings  # noqa: F401, I001
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    try:
        run = MlflowClient(tracking_uri=store.uri).get_run(run_id)
    except (MlflowException, SQLAlchemyError, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise BadInput(f"run={run_id}: {store.shown} does not know it: {reason}") from error
    if run.info.lifecycle_stage != "active":
        raise BadInput(f"run={run_id}: was deleted in MLflow ({store.shown}); restore it there")
    if "run_dir" not in run.data.tags:
        raise BadInput(f"run={run_id}: has no tag run_dir, so it is no run of deepracer-exp")
    return Path(run.data.tags["run_dir"])
