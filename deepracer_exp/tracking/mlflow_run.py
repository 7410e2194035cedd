"""One run in an MLflow store, by MlflowClient alone: no global tracking uri, no active run.

Importing this module imports MLflow (1.2 s alone, 2 to 3 s beside a starting training), so only the
recorder's thread does it. Every call may be repeated: MLflow keys a metric point by run, key, step,
timestamp and value, and parameters, tags, files and the end status are the same when written twice. So a
request of a killed process that a slow server handles late does no harm either.
"""

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from .names import BEST, END_TAG, EXPERIMENT_TAGS, PARENT, best_metrics
from .notes import NOTE, OURS, experiment_note, result_note
from .points import Point, points_at
from .registry import pages
from .store import Store
from .tracking_file import Told

# MLflow reads these at each call and offers no parameter. Its own 7 retries would hold the queue for
# minutes after a server is back, and a request may hang for its whole 120 s: the recorder retries itself.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
# It would print the address of each run that ends, with its password.
os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
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

_USER, _PASSWORD = "MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD"
_GIVEN = {name: os.environ.get(name) for name in (_USER, _PASSWORD)}

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


def client_of(store: Store) -> MlflowClient:
    """Return a client of a store; user and password are those of the store that a client was made for last.

    MLflow reads both from the environment at each request. In the address they would stand in all its messages.
    """
    for name, own in ((_USER, store.user), (_PASSWORD, store.password)):
        if (value := own or _GIVEN[name]) is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    # The registry of models could be elsewhere (MLFLOW_REGISTRY_URI), its runs could not.
    return MlflowClient(tracking_uri=store.uri, registry_uri=store.uri)


class MLflowRun:
    """A run and the calls that fill it.

    Every method raises StoreUnavailableError or StoreRefusedError.
    """

    def __init__(self, store: Store) -> None:
        self.run_id: str | None = None
        self._store = store
        self._client: MlflowClient
        self._params: Mapping[str, str] = {}
        self._goes_on = False
        self._there: dict[str, dict[int, float]] = {}
        self._contradicted: set[tuple[str, int]] = set()

    @property
    def contradicted(self) -> int:
        """Number of points that the store had with another value, which stays."""
        return len(self._contradicted)

    def connect(self) -> None:
        """Open the store, and make it if it does not exist."""
        with _told_apart(), self._store.creation_lock():
            if (file := self._store.sqlite_file) is not None and not file.exists():
                _create_whole(file)
            self._client = client_of(self._store)

    def create(self, told: Told, *, again: bool) -> None:
        """Create the run; with `again`, look first whether an earlier try created it unheard."""
        tags = {key: value[:MAX_TAG_VAL_LENGTH] for key, value in told.tags.items()}
        with _told_apart():
            experiment_id = self._experiment_id(told.experiment)
            if again:
                self.run_id = self._find(experiment_id, told)
            if self.run_id is None:
                run = self._client.create_run(experiment_id, told.start_ms, tags, told.run_name)
                self.run_id = run.info.run_id

    def create_once(self, told: Told, mark: Sequence[str]) -> None:
        """Create a run, or go on with the oldest one in its experiment that has the same values of some tags.

        Of two processes that create it at once one sees the other's, goes on with that and deletes its own; MLflow has
        no way to be sure of it, so that rarely there may be two.

        Args:
            told: of the run.
            mark: the tags by which it is known.
        """
        sought = {key: told.tags[key] for key in mark}
        with _told_apart():
            oldest = self._oldest(self._experiment_id(told.experiment), sought)
        if oldest is None:
            self.create(told, again=False)
            with _told_apart():
                oldest = self._oldest(self._experiment_id(told.experiment), sought)
                if oldest in (None, self.run_id):
                    return
                self._client.delete_run(self.run_id)
        self.reopen(replace(told, run_id=oldest))

    def reopen(self, told: Told) -> None:
        """Go on with a run that another process recorded, whether or not MLflow has it already.

        From here on parameters and points that the store has are not written again.
        """
        self.run_id = told.run_id
        if self.run_id is None:
            self.create(told, again=True)
        with _told_apart():
            run = self._client.get_run(self.run_id)
            if run.info.lifecycle_stage != "active":
                raise StoreRefusedError(f"run {self.run_id} was deleted in MLflow; restore it there")
            self._client.update_run(self.run_id, status="RUNNING")
            if END_TAG in run.data.tags and END_TAG not in told.tags:
                self._client.delete_tag(self.run_id, END_TAG)
        self._params = run.data.params
        self._goes_on = True
        self._there = {}
        # Those of MLflow's own, such as the description, may have been edited in the UI.
        self.set_tags({key: value for key, value in told.tags.items() if not key.startswith("mlflow.")})

    def log_params(self, params: Mapping[str, str]) -> None:
        """Write the parameters."""
        rest = iter((key, value) for key, value in params.items() if key not in self._params)
        with _told_apart():
            while chunk := [Param(key, value) for key, value in islice(rest, MAX_PARAMS_TAGS_PER_BATCH)]:
                self._client.log_batch(self.run_id, params=chunk)

    def log_metrics(self, points: Sequence[Point]) -> int:
        """Write points, of a reopened run those that are missing; return how many."""
        with _told_apart():
            missing = [point for point in points if not self._has(point)] if self._goes_on else points
            for start in range(0, len(missing), MAX_METRICS_PER_BATCH):
                chunk = [Metric(*point) for point in missing[start : start + MAX_METRICS_PER_BATCH]]
                self._client.log_batch(self.run_id, metrics=chunk)
        return len(missing)

    def set_tags(self, tags: Mapping[str, str]) -> None:
        """Write tags."""
        rest = iter(tags.items())
        with _told_apart():
            while some := list(islice(rest, MAX_PARAMS_TAGS_PER_BATCH)):
                chunk = [RunTag(key, value[:MAX_TAG_VAL_LENGTH]) for key, value in some]
                self._client.log_batch(self.run_id, tags=chunk)

    def set_experiment_tags(self, tags: Mapping[str, str]) -> None:
        """Write tags of the experiment that the run is in."""
        with _told_apart():
            experiment_id = self._client.get_run(self.run_id).info.experiment_id
            for key, value in tags.items():
                self._client.set_experiment_tag(experiment_id, key, value)

    def adopt(self, tags: Mapping[str, str], but: str) -> None:
        """Put the runs of its experiment that have these tags, and not the tag `but`, below this one."""
        with _told_apart():
            experiment_id = self._client.get_run(self.run_id).info.experiment_id
            for run in pages(
                self._client.search_runs, experiment_ids=[experiment_id], filter_string=_with(tags)
            ):
                if but not in run.data.tags and PARENT not in run.data.tags:
                    self._client.set_tag(run.info.run_id, PARENT, self.run_id)

    def conclude(self, told: Told, summary: Mapping[str, Any]) -> None:
        """Record what came of the run: its best checkpoint, in its description and in that of its experiment.

        A description that somebody has edited stays as it is.
        """
        if best := summary.get("best"):
            self.log_metrics(
                points_at(best_metrics(summary), best["env_steps"], told.end_ms or told.start_ms)
            )
        with _told_apart():
            run = self._client.get_run(self.run_id)
            begun, now = told.tags.get(NOTE, ""), run.data.tags.get(NOTE, "")
            if now.endswith(begun):
                note = result_note(summary, run.info.run_id, told.files)
                self._client.set_tag(self.run_id, NOTE, f"{note}\n\n{begun}"[:MAX_TAG_VAL_LENGTH])
            self._describe_experiment(run.info.experiment_id)

    def _describe_experiment(self, experiment_id: str) -> None:
        tags = self._client.get_experiment(experiment_id).tags
        score = f"metrics.`{BEST}score_s`"
        found = self._client.search_runs(
            [experiment_id], f"{score} > 0", max_results=1, order_by=[f"{score} ASC"]
        )
        if found and tags.get(NOTE, OURS).startswith(OURS):
            (run,) = found
            best = {key: value for key, value in run.data.metrics.items() if key.startswith(BEST)}
            note = experiment_note(run.info.run_name, run.info.run_id, experiment_id, best)
            self._client.set_experiment_tag(experiment_id, NOTE, note)

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

    def _find(self, experiment_id: str, told: Told) -> str | None:
        runs = self._client.search_runs(
            [experiment_id], f"attributes.start_time = {told.start_ms}", ViewType.ALL
        )
        for run in runs:
            if run.info.run_name == told.run_name and run.data.tags.get("run_dir") == told.tags.get(
                "run_dir"
            ):
                return run.info.run_id
        return None

    def _oldest(self, experiment_id: str, tags: Mapping[str, str]) -> str | None:
        runs = self._client.search_runs([experiment_id], _with(tags), ViewType.ACTIVE_ONLY)
        return min(((run.info.start_time, run.info.run_id) for run in runs), default=(0, None))[1]

    def _has(self, point: Point) -> bool:
        """Return whether the store has a point of this key and step; the first call of a key asks it."""
        key, value, _, step = point
        if key not in self._there:
            history = self._client.get_metric_history(self.run_id, key)
            self._there[key] = {found.step: found.value for found in history}
        there = self._there[key].get(step)
        if there is not None and there != value:
            self._contradicted.add((key, step))
        return there is not None


def _with(tags: Mapping[str, str]) -> str:
    return " and ".join(f"tags.`{key}` = '{value}'" for key, value in tags.items())


def _create_whole(file: Path) -> None:
    """Create an SQLite store beside its place and move it there: a process killed meanwhile leaves none.

    MLflow makes its tables in dozens of steps and cannot go on with a half-made store.
    """
    aside = file.with_name(f".{file.name}.new")
    for left in file.parent.glob(f"{aside.name}*"):
        left.unlink()
    MlflowClient(tracking_uri=f"sqlite:///{aside}").search_experiments(max_results=1)
    aside.replace(file)
