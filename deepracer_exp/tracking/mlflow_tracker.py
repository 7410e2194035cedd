"""The tracker of `tracking=mlflow`: a thread that keeps a run's MLflow run up to date from the run folder."""

import logging
from collections.abc import Mapping
from pathlib import Path

from typing_extensions import override

from .metadata import END_TAG, Scalar, param_text
from .metrics import now_ms, points_of
from .projection import Projection
from .store import Store
from .store_thread import StoreThread
from .tracker import FINISH_S, Tracker
from .tracking_file import Status, TrackedRun, TrackingFile

_log = logging.getLogger(__name__)


class MLflowTracker(Tracker):
    """Records one run in MLflow from its folder, whose metrics.jsonl has the rows and whose tracking.json the tags.

    So `log`, `safe_until` and `log_artifact` have nothing to do.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._file: TrackingFile
        self._projection: Projection
        self._thread: StoreThread

    @property
    @override
    def run_id(self) -> str | None:
        return self._file.run.run_id

    @property
    @override
    def outage(self) -> str | None:
        reason = self._thread.outage
        return None if reason is None else f"MLflow ({self._store.shown}): {reason}"

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
        self._begin(TrackingFile(identity, tracked))

    @override
    def reopen(self, identity: Path) -> None:
        file = TrackingFile.read(identity, self._store.shown)
        tags = {key: value for key, value in file.run.tags.items() if key != END_TAG}
        file.change(status=None, end_ms=None, complete=False, tags=tags)
        self._begin(file)

    @override
    def log_machine(self, use: Mapping[str, float], step: int) -> None:
        self._projection.beside += points_of(use, step, self._file.run.start_ms)

    @override
    def set_tag(self, key: str, value: str) -> None:
        self._file.add_tag(key, value)

    @override
    def finish(self, status: Status, deadline_s: float = FINISH_S) -> int:
        self._file.change(status=status, end_ms=now_ms())
        complete = self._thread.finish(deadline_s) and self._thread.refusal is None
        lost = 0
        if not complete:
            lost, points = self._projection.lost()
            reason = self._thread.refusal or self._thread.outage or f"no answer within {deadline_s:g} s"
            what = f"{lost:,} of {points:,} metric points were" if lost else "some of this run was"
            self.failure = f"MLflow ({self._store.shown}): {what} not recorded: {reason}"
            if self._thread.refusal is None:  # which was logged
                _log.warning("%s; the run folder has everything", self.failure)
        self._file.change(complete=complete)
        return lost

    def _begin(self, file: TrackingFile) -> None:
        self._file, self._projection = file, Projection(self._store, file)
        self._thread = StoreThread(self._projection.update, self._store.shown, "the training continues")
