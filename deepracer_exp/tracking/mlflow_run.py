"""One run in an MLflow store, by MlflowClient alone: no global tracking uri, no active run.

Importing this module imports MLflow (1.2 s alone, 2 to 3 s beside a starting training), so only the
recorder's thread does it. Every call may be repeated: MLflow keys a metric point by run, key, step,
timestamp and value, and parameters, tags, files and the end status are the same when written twice.
"""

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from .names import EXPERIMENT_TAGS
from .store import Store

# MLflow reads these at each call and offers no parameter. Its own 7 retries would hold the queue for
# minutes after a server is back, and a request may hang for its whole 120 s: the recorder retries itself.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
# Nobody else's business, and a machine without network would try for the whole run.
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunTag, ViewType
from mlflow.exceptions import MlflowException
from mlflow.utils.validation import (
    MAX_METRICS_PER_BATCH,
    MAX_PARAMS_TAGS_PER_BATCH,
    MAX_TAG_VAL_LENGTH,
)
from sqlalchemy.exc import SQLAlchemyError

# Creating the tables is told in INFO lines, and a busy store in a traceback a try, both into the middle
# of the live view. Each failure is raised as well, and the recorder reports it, once and redacted.
for _name in ("mlflow", "alembic"):
    logging.getLogger(_name).setLevel(logging.CRITICAL)

_WORTH_RETRYING = (408, 425, 429)


class StoreUnavailableError(Exception):
    """The store did not answer, or not as it should: try again."""


class StoreRefusedError(Exception):
    """The store understood and refused, or the file is gone: trying again changes nothing."""


@contextmanager
def _told_apart() -> Iterator[None]:
    try:
        yield
    except MlflowException as error:
        status = error.get_http_status_code()
        if 400 <= status < 500 and status not in _WORTH_RETRYING:
            raise StoreRefusedError(str(error)) from error
        raise StoreUnavailableError(str(error)) from error
    except FileNotFoundError as error:
        raise StoreRefusedError(str(error)) from error
    except (OSError, SQLAlchemyError) as error:
        raise StoreUnavailableError(str(error)) from error


class MLflowRun:
    """A run and the calls that fill it.

    Every method raises StoreUnavailableError or StoreRefusedError.
    """

    def __init__(self, store: Store) -> None:
        self.run_id: str | None = None
        self._store = store
        self._client: MlflowClient

    def connect(self) -> None:
        """Open the store, and make it if it does not exist."""
        with _told_apart(), self._store.creation_lock():
            self._client = MlflowClient(tracking_uri=self._store.uri)

    def create(
        self, experiment: str, run_name: str, tags: Mapping[str, str], start_ms: int, *, again: bool
    ) -> None:
        """Create the run; with `again`, look first whether an earlier try created it unheard."""
        with _told_apart():
            experiment_id = self._experiment_id(experiment)
            if again:
                self.run_id = self._find(experiment_id, run_name, start_ms)
            if self.run_id is None:
                short = {key: value[:MAX_TAG_VAL_LENGTH] for key, value in tags.items()}
                run = self._client.create_run(experiment_id, start_ms, short, run_name)
                self.run_id = run.info.run_id

    def log_params(self, params: Mapping[str, str]) -> None:
        """Write the parameters."""
        rest = iter(params.items())
        with _told_apart():
            while chunk := [Param(key, value) for key, value in islice(rest, MAX_PARAMS_TAGS_PER_BATCH)]:
                self._client.log_batch(self.run_id, params=chunk)

    def log_metrics(self, points: Sequence[tuple[str, float, int, int]]) -> None:
        """Write points of (key, value, timestamp in ms, step)."""
        with _told_apart():
            for start in range(0, len(points), MAX_METRICS_PER_BATCH):
                chunk = [Metric(*point) for point in points[start : start + MAX_METRICS_PER_BATCH]]
                self._client.log_batch(self.run_id, metrics=chunk)

    def set_tag(self, key: str, value: str) -> None:
        """Write a tag."""
        with _told_apart():
            self._client.log_batch(self.run_id, tags=[RunTag(key, value[:MAX_TAG_VAL_LENGTH])])

    def log_artifact(self, path: Path, folder: str | None) -> None:
        """Copy a file, or all that lies in a folder, to the run's files under `folder`."""
        with _told_apart():
            if not path.exists():
                raise FileNotFoundError(f"{path} is gone")
            copy = self._client.log_artifacts if path.is_dir() else self._client.log_artifact
            copy(self.run_id, str(path), folder)

    def end(self, status: str, end_ms: int) -> None:
        """Write how and when the run ended."""
        with _told_apart():
            self._client.set_terminated(self.run_id, status, end_ms)

    def _experiment_id(self, name: str) -> str:
        found = self._client.get_experiment_by_name(name)
        if found is None:
            try:
                return self._client.create_experiment(
                    name, self._store.artifact_location, dict(EXPERIMENT_TAGS)
                )
            except MlflowException as error:
                if error.error_code != "RESOURCE_ALREADY_EXISTS":
                    raise
                found = self._client.get_experiment_by_name(name)  # another process was faster
        if found.lifecycle_stage != "active":
            raise StoreRefusedError(
                f"experiment {name!r} was deleted in MLflow; restore it there or choose another name="
            )
        return found.experiment_id

    def _find(self, experiment_id: str, run_name: str, start_ms: int) -> str | None:
        runs = self._client.search_runs(
            [experiment_id], f"attributes.start_time = {start_ms}", ViewType.ACTIVE_ONLY
        )
        return next((run.info.run_id for run in runs if run.info.run_name == run_name), None)
