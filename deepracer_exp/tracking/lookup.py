"""From MLflow's id of a run to the folder the run wrote."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput

from .store import one_line, resolve_store

if TYPE_CHECKING:
    from mlflow import MlflowClient


def is_run_id(text: str) -> bool:
    """Return whether this looks like MLflow's id of a run."""
    return re.fullmatch(r"[0-9a-f]{32}", text) is not None


def has_store(uri: str | None, runs_dir: Path) -> bool:
    """Return whether there is a store to ask: one is given, or `runs_dir` has one."""
    return uri is not None or (runs_dir / "mlflow.db").is_file()


def folder_of(run_id: str, uri: str | None, runs_dir: Path) -> Path:
    """Return the folder that a recorded run wrote.

    Args:
        run_id: MLflow's.
        uri: the store, as in `tracking.uri`; None: the one in `runs_dir`.
        runs_dir: where runs are.

    Raises:
        BadInput: the store has no such run, or it was deleted there, or it does not answer.
    """
    with asked(f"run={run_id}", uri, runs_dir) as client:
        run = client.get_run(run_id)
    if run.info.lifecycle_stage != "active":
        raise BadInput(f"run={run_id}: was deleted in MLflow; restore it there")
    if "run_dir" not in run.data.tags:
        raise BadInput(f"run={run_id}: has no tag run_dir, so it is no run of deepracer-exp")
    return Path(run.data.tags["run_dir"])


@contextmanager
def asked(what: str, uri: str | None, runs_dir: Path) -> "Iterator[MlflowClient]":
    """Open a store and turn whatever it does not do into one line.

    Args:
        what: it is asked for, the beginning of that line.
        uri: the store, as in `tracking.uri`; None: the one in `runs_dir`.
        runs_dir: where runs are.

    Raises:
        BadInput: there is no store, or it does not answer, or it refuses.
    """
    if not has_store(uri, runs_dir):
        raise BadInput(
            f"{what}: {runs_dir} has no mlflow.db to look it up in; give tracking_uri or a run's folder"
        )
    store = resolve_store(uri, runs_dir)
    # Three seconds of import that nothing else needs.
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    from .mlflow_run import client_of

    try:
        yield client_of(store)
    except (MlflowException, SQLAlchemyError, OSError) as error:
        raise BadInput(f"{what}: {store.shown}: {one_line(error)}") from error
