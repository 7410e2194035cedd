"""One run in an MLflow store, by MlflowClient alone: no global tracking uri, no active run.

Importing this module imports MLflow, which takes two seconds, so a training leaves it to another process (`project`).
Every call may be repeated: MLflow keys a metric point by run, key, step, timestamp and value, and parameters, tags,
files and the end status are the same when written twice. So a late request of a killed process on a slow server does no
harm either.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from filelock import FileLock
from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunTag, ViewType
from mlflow.exceptions import MlflowException
from mlflow.utils.validation import MAX_METRICS_PER_BATCH, MAX_PARAMS_TAGS_PER_BATCH, MAX_TAG_VAL_LENGTH

from .calls import CALL_S, StoreRefusedError, Value, ended_within, pages, run_if_there, store_errors
from .metadata import (
    END_TAG,
    EXPERIMENT_TAGS,
    NOTE,
    OURS,
    PARENT,
    STUDY,
    experiment_note,
    result_note,
    study_experiment_note,
)
from .mlflow_metrics import BEST, Point, best_metrics, points_at
from .store import Store, client_of, silence_mlflow
from .tracking_file import Group, TrackedRun

silence_mlflow()


class MLflowRun:
    """A run in a store and the calls that record it.

    Every method raises StoreUnavailableError or StoreRefusedError.

    Attributes:
        run_id: MLflow's id, once the run is open.
        metrics: the newest value of each metric.
    """

    def __init__(self, store: Store) -> None:
        """Open the store, creating it if necessary."""
        self.run_id: str | None = None
        self.metrics: dict[str, float] = {}
        self._store = store
        self._client = self._connect()
        self._params: dict[str, str] = {}
        self._tags: dict[str, str] = {}
        self._is_new = True
        self._steps: dict[str, set[int]] = {}
        """Steps of the points that the store has, by metric."""

    def _connect(self) -> MlflowClient:
        with store_errors(), self._store.creation_lock():
            if (file := self._store.sqlite_file) is not None and not file.exists():
                _create_whole(file)
            return client_of(self._store)

    def open(self, tracked: TrackedRun, run_id: str | None = None) -> None:
        """Create the run, or continue it if the store has it already, even if its answer was lost.

        `run_id`: the id of an earlier answer; a store that does not know it is a new one.
        """
        with store_errors():
            if run_id is not None and run_if_there(self._client, run_id) is None:
                run_id = None
            if run_id is None:
                experiment_id = self._experiment_id(tracked.experiment)
                run_id = self._find(experiment_id, tracked)
            if run_id is None:
                self.run_id = self._create(experiment_id, tracked)
                return
            self.read(run_id)
            self._client.update_run(run_id, status="RUNNING")
            if END_TAG in self._tags and END_TAG not in tracked.tags:
                self._client.delete_tag(run_id, END_TAG)
                del self._tags[END_TAG]

    def read(self, run_id: str) -> None:
        """Open a run of the store without changing its state."""
        with store_errors():
            run = self._client.get_run(run_id)
        if run.info.lifecycle_stage != "active":
            raise StoreRefusedError(f"run {run_id} was deleted in MLflow; restore it there")
        self.run_id, self._is_new = run_id, False
        self._params, self._tags, self.metrics = run.data.params, run.data.tags, run.data.metrics

    def open_only(self, tracked: TrackedRun, group: Group) -> None:
        """Create a run, or continue the oldest one of its experiment that has the same values of the group's marks.

        Of two processes that create it at once, one sees the other's, continues that and deletes its own; MLflow has
        no way to be sure of it, so that without the group's lock there may rarely be two.
        """
        sought = {key: tracked.tags[key] for key in group.marks}
        with store_errors(), FileLock(group.lock) if group.lock else nullcontext():
            experiment_id = self._experiment_id(tracked.experiment)
            oldest = self._oldest(experiment_id, sought)
            if oldest is None:
                self.run_id = self._create(experiment_id, tracked)
                oldest = self._oldest(experiment_id, sought)
                if oldest in (None, self.run_id):
                    return
                self._client.delete_run(self.run_id)
        self.open(tracked, oldest)

    def lacking(self, points: Sequence[Point]) -> list[Point]:
        """Return the points whose metric and step the store lacks."""
        with store_errors():
            for key in {point[0] for point in points} - self._steps.keys():
                history = [] if self._is_new else self._client.get_metric_history(self.run_id, key)
                self._steps[key] = {point.step for point in history}
        return [point for point in points if point[-1] not in self._steps[point[0]]]

    def log(
        self,
        points: Sequence[Point] = (),
        params: Mapping[str, str] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """Write points and missing parameters and tags, in one request if the store accepts that many."""
        left = list(points)
        # A parameter never changes in MLflow.
        new_params = [item for item in (params or {}).items() if item[0] not in self._params]
        whole = {key: value[:MAX_TAG_VAL_LENGTH] for key, value in (tags or {}).items()}
        new_tags = [item for item in whole.items() if self._tags.get(item[0]) != item[1]]
        with store_errors():
            while left or new_params or new_tags:
                some_params, new_params = _split(new_params, MAX_PARAMS_TAGS_PER_BATCH)
                some_tags, new_tags = _split(new_tags, MAX_PARAMS_TAGS_PER_BATCH)
                some, left = _split(left, MAX_METRICS_PER_BATCH - len(some_params) - len(some_tags))
                self._client.log_batch(
                    self.run_id,
                    [Metric(*point) for point in some],
                    [Param(*param) for param in some_params],
                    [RunTag(*tag) for tag in some_tags],
                )
                self._params |= dict(some_params)
                self._tags |= dict(some_tags)
                for key, value, _, step in some:
                    self._steps.setdefault(key, set()).add(step)
                    self.metrics[key] = value

    def set_experiment_tags(self, tags: Mapping[str, str]) -> None:
        """Write tags of the run's experiment."""
        with store_errors():
            experiment_id = self._client.get_run(self.run_id).info.experiment_id
            for key, value in tags.items():
                self._client.set_experiment_tag(experiment_id, key, value)

    def adopt(self, tags: Mapping[str, str], but: str) -> None:
        """Nest the runs of its experiment that have these tags, and not the tag `but`, under this one."""
        with store_errors():
            experiment_id = self._client.get_run(self.run_id).info.experiment_id
            for run in pages(
                self._client.search_runs, experiment_ids=[experiment_id], filter_string=_with(tags)
            ):
                if but not in run.data.tags and PARENT not in run.data.tags:
                    self._client.set_tag(run.info.run_id, PARENT, self.run_id)

    def conclude(self, tracked: TrackedRun, summary: Mapping[str, Any], files: Collection[str]) -> None:
        """Record the best checkpoint, in the metrics and the descriptions of the run and of its experiment.

        `files` are the names of its artifacts in the store. An edited description is kept.
        """
        points: list[Point] = []
        if best := summary.get("best"):
            end_ms = tracked.end_ms or tracked.start_ms
            points = self.lacking(points_at(best_metrics(summary), best["env_steps"], end_ms))
        with store_errors():
            run = self._client.get_run(self.run_id)
            begun, now = tracked.tags.get(NOTE, ""), run.data.tags.get(NOTE, "")
            note = f"{result_note(summary, run.info.run_id, files)}\n\n{begun}"
            self.log(points, tags={NOTE: note} if now.endswith(begun) else {})
            self._describe_experiment(run.info.experiment_id)

    def describe_study(self, winner: str) -> None:
        """Name a study's winner, in words, in the description of its experiment; an edited one is kept."""
        with store_errors():
            experiment_id = self._client.get_run(self.run_id).info.experiment_id
            note = study_experiment_note(experiment_id, str(self.run_id), winner)
            now = self._client.get_experiment(experiment_id).tags.get(NOTE, OURS)
            if now != note and now.startswith(OURS):
                self._client.set_experiment_tag(experiment_id, NOTE, note)

    def _describe_experiment(self, experiment_id: str) -> None:
        tags = self._client.get_experiment(experiment_id).tags
        if STUDY in tags:  # whose winner is chosen by its own objective, over seeds and fresh laps
            return
        score = f"metrics.`{BEST}score_s`"
        fastest = self._client.search_runs(
            [experiment_id], f"{score} > 0", max_results=1, order_by=[f"{score} ASC"]
        )
        if fastest and tags.get(NOTE, OURS).startswith(OURS):
            (run,) = fastest
            best = {key: value for key, value in run.data.metrics.items() if key.startswith(BEST)}
            note = experiment_note(run.info.run_name, run.info.run_id, experiment_id, best)
            self._client.set_experiment_tag(experiment_id, NOTE, note)

    def log_artifact(self, path: Path, folder: str | None) -> None:
        """Copy a file, or all files of a folder, to the run's artifacts under `folder`."""
        with store_errors():
            if not path.exists():
                raise StoreRefusedError(f"{path} is gone")
            # Not by the run's id: asked again, a server could name another place.
            files = self._store.files_at(self._client.get_run(self.run_id).info.artifact_uri)
            copy = files.log_artifacts if path.is_dir() else files.log_artifact
            ended_within(CALL_S, lambda: copy(str(path), folder))

    def end(self, status: str, end_ms: int) -> None:
        """Write the status and the end of the run."""
        with store_errors():
            self._client.set_terminated(self.run_id, status, end_ms)

    def _experiment_id(self, name: str) -> str:
        experiment = self._client.get_experiment_by_name(name)
        if experiment is None:
            try:
                return self._client.create_experiment(
                    name, self._store.artifact_location, dict(EXPERIMENT_TAGS)
                )
            except MlflowException as error:
                if error.error_code != "RESOURCE_ALREADY_EXISTS":
                    raise
                experiment = self._client.get_experiment_by_name(name)  # another process created it
        if experiment.lifecycle_stage != "active":
            raise StoreRefusedError(
                f"experiment {name!r} was deleted in MLflow; restore it there or choose another name="
            )
        return experiment.experiment_id

    def _create(self, experiment_id: str, tracked: TrackedRun) -> str:
        self._tags = {key: value[:MAX_TAG_VAL_LENGTH] for key, value in tracked.tags.items()}
        run = self._client.create_run(experiment_id, tracked.start_ms, self._tags, tracked.run_name)
        return run.info.run_id

    def _find(self, experiment_id: str, tracked: TrackedRun) -> str | None:
        began = f"attributes.start_time = {tracked.start_ms}"
        # By its name, which people change, only where it has no folder.
        wanted = tracked.tags.get("run_dir") or tracked.run_name
        for run in self._client.search_runs([experiment_id], began, ViewType.ALL):
            if (run.data.tags.get("run_dir") or run.info.run_name) == wanted:
                return run.info.run_id
        return None

    def _oldest(self, experiment_id: str, tags: Mapping[str, str]) -> str | None:
        runs = self._client.search_runs([experiment_id], _with(tags), ViewType.ACTIVE_ONLY)
        return min(((run.info.start_time, run.info.run_id) for run in runs), default=(0, None))[1]


def _split(items: list[Value], most: int) -> tuple[list[Value], list[Value]]:
    return items[:most], items[most:]


def _with(tags: Mapping[str, str]) -> str:
    return " and ".join(f"tags.`{key}` = '{value}'" for key, value in tags.items())


def _create_whole(file: Path) -> None:
    """Create an SQLite store under another name and move it into place, so that a killed process leaves none.

    MLflow creates its tables in dozens of steps, which take seconds, and cannot open an incomplete store.
    """
    aside = file.with_name(f".{file.name}.new")
    for left in file.parent.glob(f"{aside.name}*"):
        left.unlink()
    MlflowClient(tracking_uri=f"sqlite:///{aside}").search_experiments(max_results=1)
    aside.replace(file)
