"""A tracker's record of a run as a projection of the run's folder: one function brings it up to date."""

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typing_extensions import override

from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoint_files import LINKS, restore_links
from deepracer_exp.runs.labels import read_labels
from deepracer_exp.runs.run_files import (
    BEST_LAP,
    CHECKPOINTS,
    CONFIG,
    CRASH_DUMPS,
    LEARNING,
    LOG,
    MACHINE_USE,
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

from .calls import StoreRefusedError, StoreUnavailableError
from .metadata import END_TAG, KIND, NOTE, STUDY, label_tags
from .mlflow_metrics import Point, now_ms, points_at, points_of, recordable_values, without_evaluation
from .store import Store, prepare_mlflow
from .tracking_file import REFUSED, Recorded, TrackedRun, read_recorded, read_tracked_run, write_recorded

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

_FILES = (CONFIG, OVERRIDES, PROVENANCE, REWARD, SUMMARY, METRICS, LOG, REPORT, BEST_LAP, LEARNING)


def files_to_keep(run_dir: Path) -> list[tuple[Path, str | None]]:
    """Return the files and folders of an ended run that a tracker stores, each with its folder there."""
    files: list[tuple[Path, str | None]] = [(run_dir / name, None) for name in _FILES]
    files.append((run_dir / CRASH_DUMPS, CRASH_DUMPS))
    files += [((run_dir / CHECKPOINTS / link).resolve(), f"{CHECKPOINTS}/{link}") for link in LINKS]
    return [(path, folder) for path, folder in files if path.exists()]


class RunProjection:
    """The projection of a run's folder to a tracker; one class for each kind of tracker.

    Only rows of metrics.jsonl that a checkpoint covers are recorded, so that no resumed run contradicts them, and all
    rows once the run is over.

    Attributes:
        kind: of the tracker, as in `tracking.kind`.
        folder: of the run.
        has_ended: whether the run has ended.
        is_done: whether its end was recorded, as far as possible.
    """

    kind: str

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.has_ended = self.is_done = False

    def update(self) -> str | None:
        """Record everything missing in the tracker; return the first refusal and its reason.

        Safe at any time and after any failure, by one process at a time. The outcome is stored in the file of the
        tracker's kind (`Recorded`).

        Raises:
            StoreUnavailableError: the tracker's server does not answer.
            BadInput: a file of the run is missing or invalid.
        """
        tracked = read_tracked_run(self.folder)
        self.has_ended, self.is_done = tracked.end_ms is not None, False
        try:
            refused = self._project(tracked)
        except StoreUnavailableError as error:
            self._note(tracked, end_ms=None, problem=str(error))
            raise
        problem = next((f"{REFUSED}{what}: {reason}" for what, reason in refused.items()), None)
        self._note(tracked, end_ms=tracked.end_ms, problem=problem)
        self.is_done = self.has_ended
        return problem

    def give_up(self, problem: str) -> None:
        """Store a problem that no retry would solve; nothing more is attempted for an ended run."""
        self.is_done = self.has_ended
        with suppress(BadInput):  # the folder itself may be gone
            tracked = read_tracked_run(self.folder)
            self._note(tracked, end_ms=tracked.end_ms, problem=problem)

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run, once it is known; None for other trackers."""
        return None

    def _project(self, tracked: TrackedRun) -> Mapping[str, str]:
        """Record everything missing in the tracker; return all refusals with their reasons."""
        raise NotImplementedError

    def _note(self, tracked: TrackedRun, end_ms: int | None, problem: str | None) -> None:
        before = read_recorded(self.folder, self.kind)
        run_id = self.run_id or (before.run_id if before.store == tracked.store else None)
        now = Recorded(tracked.store, run_id, end_ms, problem)
        if now != before or not (self.folder / f"{self.kind}.json").exists():
            write_recorded(self.folder, now, self.kind)

    def _rows(self, tracked: TrackedRun) -> list[dict[str, Any]]:
        """Return the rows of metrics.jsonl that no resumed run will change."""
        file = self.folder / METRICS
        rows = read_metrics(file) if file.exists() else []
        if tracked.status == "FINISHED":
            return rows
        # An interrupted run evaluates its last policy off schedule, and a resumed run removes that again.
        return [
            row if self._every and row["iteration"] % self._every == 0 else without_evaluation(row)
            for row in rows[: self._covered()]
        ]

    @cached_property
    def _every(self) -> int | None:
        """Iterations between two evaluations; reading a config takes longer than reading the rows of a run."""
        every: int | None = (read_config(self.folder).get("checkpoints") or {}).get("every")
        return every

    def _covered(self) -> int:
        """Return the number of rows, one an iteration, that the last checkpoint covers."""
        if not (self.folder / CHECKPOINTS).exists():
            return 0
        restore_links(self.folder / CHECKPOINTS)
        name = (self.folder / CHECKPOINTS / "last").resolve().name
        return int(name) if name.isdecimal() else 0


class MLflowProjection(RunProjection):
    """The MLflow run of a run folder. MLflow is asked for the points of a run that another process recorded.

    Attributes:
        written: number of points of metrics.jsonl that were written.
    """

    kind = "mlflow"

    def __init__(self, store: Store, folder: Path) -> None:
        """Project a folder with a `tracking.json` to a store."""
        super().__init__(folder)
        self.written = 0
        self._store = store
        self._run: MLflowRun | None = None
        self._covered_rows = 0
        """Number of rows of metrics.jsonl that MLflow has."""
        self._files: set[tuple[Path, str | None]] = set()
        """Files in MLflow."""
        self._is_shown = False
        """Whether the experiment has the view of a group."""
        self._winner: str | None = None
        """The winner that the experiment's description names."""

    @property
    @override
    def run_id(self) -> str | None:
        return None if self._run is None else self._run.run_id

    @override
    def _project(self, tracked: TrackedRun) -> Mapping[str, str]:
        try:
            run = self._opened(tracked)
        except StoreRefusedError as error:
            return {"the run": str(error)}
        refused = {**self._write_values(run, tracked), **self._write_group(run, tracked)}
        if tracked.status is None:
            return refused
        files = files_to_keep(self.folder)
        if tracked.group is not None and tracked.group.report is not None:
            files.append((Path(tracked.group.report), None))
        writes: dict[str, Callable[[], object]] = {
            f"file {path}": partial(self._write_file, run, path, folder) for path, folder in files
        }
        writes["the result"] = lambda: self._conclude(run, tracked, {path.name for path, _ in files})
        writes["the end"] = partial(run.end, tracked.status, tracked.end_ms or now_ms())
        return {**refused, **_refused_of(writes)}

    def _opened(self, tracked: TrackedRun) -> "MLflowRun":
        if self._run is None:
            prepare_mlflow()
            from .mlflow_run import MLflowRun

            run, recorded = MLflowRun(self._store), read_recorded(self.folder)
            run_id = recorded.run_id if recorded.store == tracked.store else None
            if tracked.group is not None and run_id is None:
                run.open_only(tracked, tracked.group)
            else:
                run.open(tracked, run_id)
            self._run = run
            self._note(tracked, end_ms=None, problem=recorded.problem)
        return self._run

    def _write_values(self, run: "MLflowRun", tracked: TrackedRun) -> Mapping[str, str]:
        """Write parameters, metrics and tags in one request; one after the other where the store refuses that."""
        try:
            self._write_metrics(run, tracked, tracked.params, self._tags(tracked))
            return {}
        except (BadInput, StoreRefusedError):
            return _refused_of(
                {
                    "the parameters": lambda: run.log(params=tracked.params),
                    "metrics": lambda: self._write_metrics(run, tracked),
                    "the tags": lambda: run.log(tags=self._tags(tracked)),
                }
            )

    def _write_metrics(
        self,
        run: "MLflowRun",
        tracked: TrackedRun,
        params: Mapping[str, str] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """Write the rows that a checkpoint covers, with parameters and tags."""
        values = points_at(tracked.values, tracked.values_step, tracked.end_ms or now_ms())
        # All of them even if only one has changed: in the end another trial may be the best.
        news = values if any(run.metrics.get(key) != value for key, value, *_ in values) else ()
        covered = self._covered()
        if covered <= self._covered_rows and tracked.status != "FINISHED":
            run.log(news, params, tags)
            return
        # The last row is read again: it gets an evaluation when the run ends.
        rows = self._rows(tracked)[max(self._covered_rows - 1, 0) :]
        points = [point for row in rows for point in points_of(row, row["env_steps"], tracked.start_ms)]
        lacking = run.lacking(points)
        run.log([*lacking, *run.lacking(self._machine_points(rows)), *news], params, tags)
        self._covered_rows = covered
        self.written += len(lacking)

    def _machine_points(self, rows: list[dict[str, Any]]) -> list[Point]:
        """Return the use of the machine at the steps of these rows."""
        steps, file = {row["env_steps"] for row in rows}, self.folder / MACHINE_USE
        return [
            point
            for use in (read_metrics(file) if steps and file.exists() else [])
            if use["env_steps"] in steps
            for point in points_at(
                recordable_values({key: value for key, value in use.items() if key != "time_ms"}),
                use["env_steps"],
                use["time_ms"],
            )
        ]

    def _write_group(self, run: "MLflowRun", tracked: TrackedRun) -> Mapping[str, str]:
        """Write the tags of the experiment and of the runs nested under this one."""
        group = tracked.group
        if group is None:
            return {}
        writes: dict[str, Callable[[], object]] = {}
        if group.study is not None and (not self._is_shown or tracked.status is not None):
            # At the end, too, for trials that began before this run did.
            study = {STUDY: group.study}
            writes["the trials"] = lambda: run.adopt(study, but=KIND)
        if group.experiment_tags and not self._is_shown:
            writes["the view"] = lambda: run.set_experiment_tags(group.experiment_tags)
        if (winner := group.winner) is not None and winner != self._winner:
            writes["the winner"] = lambda: run.describe_study(winner)
        refused = _refused_of(writes)
        self._is_shown, self._winner = True, group.winner
        return refused

    def _tags(self, tracked: TrackedRun) -> dict[str, str]:
        # MLflow's own tags may have been edited in the UI; a group's description has its progress.
        ours = {NOTE} if tracked.group is not None else set()
        tags = {
            key: value for key, value in tracked.tags.items() if not key.startswith("mlflow.") or key in ours
        }
        if tracked.status is not None and tracked.group is None:
            tags |= label_tags(read_labels(self.folder))
            if END_TAG not in tags and (summary := read_object(self.folder / SUMMARY)):
                tags[END_TAG] = f"{summary['status']}: {summary['reason']}"
        return tags

    def _write_file(self, run: "MLflowRun", path: Path, folder: str | None) -> None:
        if (path, folder) not in self._files:
            run.log_artifact(path, folder)
            self._files.add((path, folder))

    def _conclude(self, run: "MLflowRun", tracked: TrackedRun, files: Collection[str]) -> None:
        if summary := read_object(self.folder / SUMMARY):
            run.conclude(tracked, summary, files)


def _refused_of(writes: Mapping[str, Callable[[], object]]) -> dict[str, str]:
    """Call every function; return the names of those that fail on a refusal or an unreadable file, with reasons."""
    refused = {}
    for what, write in writes.items():
        try:
            write()
        except (BadInput, StoreRefusedError) as error:
            refused[what] = str(error)
    return refused
