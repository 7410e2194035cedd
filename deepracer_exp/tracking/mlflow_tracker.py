"""The tracker of `tracking=mlflow`: a thread that keeps a run's MLflow run up to date from the run folder."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from typing_extensions import override

from deepracer_exp.runs.files import TRACKING

from .metadata import END_TAG
from .metrics import now_ms, points_of
from .mlflow_process import Connect, connect_here
from .projection import MLflowProjection
from .store import Store
from .store_thread import StoreThread
from .tracker import FINISH_S, Tracker
from .tracking_file import Status, TrackedRun, TrackingFile

_log = logging.getLogger(__name__)


class MLflowTracker(Tracker):
    """Records one run in MLflow from its folder, whose metrics.jsonl has the rows and whose tracking.json the tags.

    So `safe_until` and `log_artifact` have nothing to do, and `log` only lets the thread begin.
    """

    def __init__(self, store: Store, connect: Connect = connect_here) -> None:
        """Record in a store; `connect` says which process makes the calls."""
        self._store, self._connect = store, connect
        self._file: TrackingFile
        self._projection: MLflowProjection
        self._thread: StoreThread

    @property
    def run_id(self) -> str | None:
        """Id of the run in MLflow, once it exists."""
        return self._file.run.run_id

    @property
    @override
    def outage(self) -> str | None:
        reason = self._thread.outage
        return None if reason is None else f"MLflow ({self._store.shown}): {reason}"

    @override
    def open(self, folder: Path, run: TrackedRun) -> None:
        tags = {key: value for key, value in run.tags.items() if key != END_TAG}
        again = replace(run, status=None, end_ms=None, complete=False, tags=tags)
        is_new = not (folder / TRACKING).exists()
        self._file = TrackingFile(folder, again, self._store.shown)
        self._projection = MLflowProjection(self._store, self._file, is_new=is_new, connect=self._connect)
        self._thread = StoreThread(self._projection.update, self._store.shown, "the training continues")

    @override
    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        self._thread.begin()

    @override
    def log_machine(self, use: Mapping[str, float], step: int) -> None:
        self._projection.beside += points_of(use, step, self._file.run.start_ms)

    @override
    def set_tag(self, key: str, value: str) -> None:
        self._file.add_tag(key, value)

    @override
    def finish(self, status: Status, deadline_s: float = FINISH_S) -> None:
        self._file.change(status=status, end_ms=now_ms())
        complete = self._thread.finish(deadline_s) and self._thread.refusal is None
        self._projection.close(is_done=self._thread.has_ended)
        self._file.change(complete=complete)
        if not complete:
            reason = self._thread.refusal or self._thread.outage or f"no answer within {deadline_s:g} s"
            self.failure = f"MLflow ({self._store.shown}): some of this run was not recorded: {reason}"
            if self._thread.refusal is None:  # which was logged
                _log.warning("%s; the run folder has everything", self.failure)
