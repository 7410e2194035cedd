"""MLflowTracker: records a training in MLflow from a thread of its own, so that the training never waits."""

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from typing_extensions import override

from deepracer_exp.runs.files import SUMMARY, read_object

from .metadata import END_TAG, Scalar, param_text
from .metrics import Point, now_ms, points_of
from .store import Store, StoreRefusedError
from .store_thread import StoreThread
from .tracker import Tracker
from .tracking_file import Status, TrackedRun, TrackingFile

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

_log = logging.getLogger(__name__)

_POINTS_PER_CALL = 1000


class MLflowTracker(Tracker):
    """Records one run in MLflow; what the store lacks in the end can be recorded later from the run folder."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._file: TrackingFile
        self._lock = threading.Lock()
        self._held: deque[tuple[Point, ...]] = deque()
        """Rows that no checkpoint covers yet."""
        self._ready: deque[Point] = deque()
        self._safe_step: float = -math.inf
        self._logged = 0
        self._recorded = 0
        self._thread = StoreThread(store, "the training continues")

    @property
    @override
    def run_id(self) -> str | None:
        return self._thread.run.run_id if self._thread.run else None

    @property
    def waiting(self) -> int:
        """Metric points logged and not yet recorded."""
        with self._lock:
            return self._logged - self._recorded

    @override
    def start(
        self,
        run_name: str,
        experiment: str,
        params: Mapping[str, Scalar],
        tags: Mapping[str, str],
        identity: Path,
    ) -> None:
        texts = {key: param_text(value) for key, value in params.items()}
        tracked = TrackedRun(None, run_name, experiment, now_ms(), self._store.shown, texts, dict(tags))
        self._begin(
            TrackingFile(identity, tracked), lambda run, tracked, again: run.create(tracked, again=again)
        )

    @override
    def reopen(self, identity: Path) -> None:
        file = TrackingFile.read(identity, self._store.shown)
        tags = {key: value for key, value in file.run.tags.items() if key != END_TAG}
        file.change(status=None, end_ms=None, files={}, tags=tags)
        self._begin(file, lambda run, tracked, _: run.reopen(tracked))

    @override
    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        if points := points_of(metrics, step, self._file.run.start_ms):
            with self._lock:
                self._logged += len(points)
                self._held.append(points)
            self._release()

    @override
    def safe_until(self, step: float) -> None:
        self._safe_step = max(self._safe_step, step)
        self._release()

    @override
    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        self._file.add_file(path, folder)
        self._thread.put(f"file {path}", lambda run, _: run.log_artifact(path, folder))

    @override
    def set_tag(self, key: str, value: str) -> None:
        self._file.add_tag(key, value)
        self._thread.put(f"tag {key}", lambda run, _: run.set_tags({key: value}))

    @override
    def finish(self, status: Status, deadline_s: float = 30.0) -> int:
        end_ms = now_ms()
        self._file.change(status=status, end_ms=end_ms)
        if status == "FINISHED":
            self.safe_until(math.inf)
        if summary := read_object(self._file.folder / SUMMARY):
            self._thread.put("the result", lambda run, _: run.conclude(self._file.run, summary))
        is_ended = self._thread.finish(lambda run, _: run.end(status, end_ms), deadline_s)
        lost = self.waiting - sum(map(len, self._held))
        if self._thread.is_rejected:
            return lost  # which was logged
        if lost:
            _log.warning(
                "MLflow (%s): %d of %d metric points were not recorded; metrics.jsonl has them all,"
                " `deepracer-exp resume %s` records them",
                self._store.shown, lost, self._logged, self._file.folder,
            )  # fmt: skip
        run = self._thread.run
        if run is not None and run.contradicted:
            _log.warning(
                "MLflow (%s): %d points of repeated iterations keep their first values there;"
                " metrics.jsonl has the new ones",
                self._store.shown, run.contradicted,
            )  # fmt: skip
        if not is_ended:
            _log.warning("MLflow (%s): the run could not be marked %s", self._store.shown, status)
        return lost

    def _begin(self, file: TrackingFile, open_run: Callable[["MLflowRun", TrackedRun, bool], None]) -> None:
        self._file = file

        def begin(run: "MLflowRun", again: bool) -> None:
            open_run(run, file.run, again)
            file.change(run_id=run.run_id)

        self._thread.put("the run", begin, vital=True)
        self._thread.put("the parameters", lambda run, _: run.log_params(file.run.params))

    def _release(self) -> None:
        """Record the rows that a checkpoint covers."""
        with self._lock:
            while self._held and self._held[0][-1][-1] <= self._safe_step:
                self._ready.extend(self._held.popleft())
            if not self._ready:
                return
        self._thread.put("metrics", self._write_points)

    def _write_points(self, run: "MLflowRun", _: bool) -> None:
        while True:
            with self._lock:
                points = [self._ready[i] for i in range(min(len(self._ready), _POINTS_PER_CALL))]
            if not points:
                return
            refusal: StoreRefusedError | None = None
            try:
                run.log_metrics(points)
            except StoreRefusedError as error:
                refusal = error
            with self._lock:
                for _point in points:
                    self._ready.popleft()
                self._recorded += 0 if refusal else len(points)
            if refusal is not None:
                raise refusal
