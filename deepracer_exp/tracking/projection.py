"""A run's MLflow run as a projection of the run's folder: one function brings it up to date."""

from collections.abc import Callable, Collection, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoint_files import LINKS, restore_links
from deepracer_exp.runs.files import (
    BEST_LAP,
    CHECKPOINTS,
    CONFIG,
    CRASH_DUMPS,
    LEARNING,
    LOG,
    METRICS,
    OVERRIDES,
    PROVENANCE,
    REPORT,
    REWARD,
    SUMMARY,
    read_config,
    read_metrics,
    read_object,
)
from deepracer_exp.runs.labels import read_labels

from .calls import StoreRefusedError
from .metadata import END_TAG, label_tags
from .metrics import Point, now_ms, points_of, without_evaluation
from .mlflow_process import Connect, RemoteRun, connect_here, released
from .store import Store
from .store_thread import refused_of
from .tracking_file import TrackingFile

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

_FILES = (CONFIG, OVERRIDES, PROVENANCE, REWARD, SUMMARY, METRICS, LOG, REPORT, BEST_LAP, LEARNING)


def files_to_keep(run_dir: Path) -> list[tuple[Path, str | None]]:
    """Return the files and folders of an ended run that a tracker keeps, each with its folder there."""
    files: list[tuple[Path, str | None]] = [(run_dir / name, None) for name in _FILES]
    files.append((run_dir / CRASH_DUMPS, CRASH_DUMPS))
    files += [((run_dir / CHECKPOINTS / link).resolve(), f"{CHECKPOINTS}/{link}") for link in LINKS]
    return [(path, folder) for path, folder in files if path.exists()]


class MLflowProjection:
    """The MLflow run of a run folder.

    A row of metrics.jsonl is written once a checkpoint covers it, so that no resumed run contradicts it, or once the
    run is over. MLflow is asked which points it has of a run that another process recorded.

    Attributes:
        beside: points that no file has, such as the use of the machine; they are written with the next rows, and leave
            the list then.
        written: number of points of metrics.jsonl that were written.
    """

    def __init__(
        self, store: Store, file: TrackingFile, *, is_new: bool = False, connect: Connect = connect_here
    ) -> None:
        """Project the folder of a tracking.json to a store; `is_new`: there was no attempt to create the run there."""
        self.beside: list[Point] = []
        self.written = 0
        self._store, self._file, self._folder = store, file, file.folder
        self._connect = connect
        self._run: MLflowRun | RemoteRun | None = None
        self._is_new = is_new
        self._rows = 0
        """Number of rows of metrics.jsonl that MLflow has."""
        self._files: set[tuple[Path, str | None]] = set()
        """Files that it has."""

    def update(self) -> Mapping[str, str]:
        """Write what MLflow lacks; return what it refuses, with the reasons.

        This may be done at any time, by any process, and again after any failure.

        Raises:
            StoreUnavailableError: MLflow does not answer.
        """
        try:
            run = self._opened()
        except StoreRefusedError as error:
            return {"the run": str(error)}
        tracked = self._file.run
        refused = self._write_values(run)
        if tracked.status is None:
            return refused
        files = files_to_keep(self._folder)
        writes: dict[str, Callable[[], object]] = {
            f"file {path}": partial(self._write_file, run, path, folder) for path, folder in files
        }
        writes["the result"] = lambda: self._conclude(run, {path.name for path, _ in files})
        writes["the end"] = partial(run.end, tracked.status, tracked.end_ms or now_ms())
        return {**refused, **refused_of(writes)}

    def _write_values(self, run: "MLflowRun | RemoteRun") -> Mapping[str, str]:
        """Write parameters, metrics and tags in one request; one after the other where the store refuses that."""
        params = self._file.run.params
        try:
            self._write_metrics(run, params, self._tags())
            return {}
        except (BadInput, StoreRefusedError):
            return refused_of(
                {
                    "the parameters": lambda: run.log(params=params),
                    "metrics": lambda: self._write_metrics(run),
                    "the tags": lambda: run.log(tags=self._tags()),
                }
            )

    def close(self, *, is_done: bool) -> None:
        """Release the run; `is_done`: no update can still be under way."""
        released(self._run, is_done=is_done)

    def _opened(self) -> "MLflowRun | RemoteRun":
        if self._run is None:
            run = self._connect(self._store)
            is_first, self._is_new = self._is_new, False
            run.open(self._file.run, is_first=is_first)
            self._file.change(run_id=run.run_id)
            self._run = run
        return self._run

    def _write_metrics(
        self,
        run: "MLflowRun | RemoteRun",
        params: Mapping[str, str] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """Write the rows that a checkpoint covers, with parameters and tags."""
        covered, beside = self._covered(), list(self.beside)
        if covered <= self._rows and not self._is_over:
            run.log(params=params, tags=tags)
            return
        # The last row is read again: it gets an evaluation when the run ends.
        lacking = run.lacking(self._points(max(self._rows - 1, 0)))
        run.log([*lacking, *run.lacking(beside)], params, tags)
        del self.beside[: len(beside)]
        self._rows = covered
        self.written += len(lacking)

    def _points(self, first: int) -> list[Point]:
        """Return the points of the rows of metrics.jsonl from `first` that no resumed run will change."""
        file, start_ms = self._folder / METRICS, self._file.run.start_ms
        rows = read_metrics(file) if file.exists() else []
        if not self._is_over:
            # The last policy of an interrupted run is evaluated out of turn, and a resumed run removes that again.
            rows = [
                row if self._every and row["iteration"] % self._every == 0 else without_evaluation(row)
                for row in rows[: self._covered()]
            ]
        return [point for row in rows[first:] for point in points_of(row, row["env_steps"], start_ms)]

    @cached_property
    def _every(self) -> int | None:
        """Iterations between two evaluations; reading a config takes longer than reading the rows of a run."""
        every: int | None = (read_config(self._folder).get("checkpoints") or {}).get("every")
        return every

    @property
    def _is_over(self) -> bool:
        return self._file.run.status == "FINISHED"

    def _covered(self) -> int:
        """Return the number of rows, one an iteration, that the last checkpoint covers."""
        restore_links(self._folder / CHECKPOINTS)
        name = (self._folder / CHECKPOINTS / "last").resolve().name
        return int(name) if name.isdecimal() else 0

    def _tags(self) -> dict[str, str]:
        tracked = self._file.run
        # MLflow's own tags, such as the description, may have been edited in the UI.
        tags = {key: value for key, value in tracked.tags.items() if not key.startswith("mlflow.")}
        if tracked.status is not None:
            tags |= label_tags(read_labels(self._folder))
            if END_TAG not in tags and (summary := read_object(self._folder / SUMMARY)):
                tags[END_TAG] = f"{summary['status']}: {summary['reason']}"
        return tags

    def _write_file(self, run: "MLflowRun | RemoteRun", path: Path, folder: str | None) -> None:
        if (path, folder) not in self._files:
            run.log_artifact(path, folder)
            self._files.add((path, folder))

    def _conclude(self, run: "MLflowRun | RemoteRun", files: Collection[str]) -> None:
        if summary := read_object(self._folder / SUMMARY):
            run.conclude(self._file.run, summary, files)
