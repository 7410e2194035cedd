"""MLflowTracker: what the training loop tells, recorded in MLflow beside the training, never in its way."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.config.running import TrackingConfig, TrackingOff
from deepracer_exp.formats.run_files import read_object

from .flatten import Scalar, param_text
from .names import END_TAG
from .points import Point, now_ms, points_of
from .store import Store, one_line, resolve_store
from .tracker import NullTracker, Tracker
from .tracking_file import Status, Told, TrackingFile

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

_log = logging.getLogger(__name__)

_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 10.0
_POINTS_PER_CALL = 1000
_END = "the end"


def open_tracker(config: TrackingConfig, runs_dir: Path) -> Tracker:
    """Return the tracker that `config` asks for; MLflow begins to load in the background.

    Raises:
        BadInput: `tracking.uri` can never work.
    """
    if isinstance(config, TrackingOff):
        return NullTracker()
    return MLflowTracker(resolve_store(config.uri, runs_dir))


@dataclass(frozen=True)
class _Points:
    points: tuple[Point, ...]

    @property
    def step(self) -> int:
        """The last one."""
        return self.points[-1][-1]


@dataclass(frozen=True)
class _Call:
    """Anything else that is written; `again` tells a repetition."""

    what: str
    do: Callable[["MLflowRun", bool], None]
    vital: bool = False
    """Without it nothing that follows can be written."""


class MLflowTracker:
    """Records one run in MLflow from a single thread fed by a queue.

    The store may be down, slow or come back later: what was told waits in order and is written once it
    answers (a repeated write is the same point). What the store refuses is left out. The first failure and
    the sum at the end are logged.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._file: TrackingFile
        self._queue: deque[_Points | _Call] = deque()
        self._held: deque[_Points] = deque()
        self._safe_step: float = -math.inf
        self._changed = threading.Condition()
        self._told = 0
        self._recorded = 0
        self._reported = False
        self._refused: set[str] = set()
        self._rejected = False
        self._ended = False
        self._end_by = math.inf
        self._finishing = threading.Event()
        self._run: MLflowRun | None = None
        # Daemon: a store that hangs must not keep a process alive that has finished its training.
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)
        self._thread.start()

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run, once it exists."""
        return self._run.run_id if self._run else None

    @property
    def waiting(self) -> int:
        """Metric points told and not yet recorded."""
        with self._changed:
            return self._told - self._recorded

    def start(
        self,
        run_name: str,
        experiment: str,
        params: Mapping[str, Scalar],
        tags: Mapping[str, str],
        identity: Path,
    ) -> None:
        """Begin the run, and `identity`, its `tracking.json`; called once, before the others."""
        texts = {key: param_text(value) for key, value in params.items()}
        told = Told(None, run_name, experiment, now_ms(), self._store.shown, texts, dict(tags))
        self._begin(TrackingFile(identity, told), lambda run, told, again: run.create(told, again=again))

    def reopen(self, identity: Path) -> None:
        """Go on with the run that `identity`, its `tracking.json`, tells of; instead of `start`.

        Raises:
            BadInput: the file is missing or not what a tracker writes.
        """
        file = TrackingFile.read(identity, self._store.shown)
        tags = {key: value for key, value in file.told.tags.items() if key != END_TAG}
        file.change(status=None, end_ms=None, files={}, tags=tags)
        self._begin(file, lambda run, told, _: run.reopen(told))

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Record a row of metrics.jsonl at `step` (env steps); None, NaN and infinite values are left out."""
        points = points_of(metrics, step, self._file.told.start_ms)
        if points:
            with self._changed:
                self._told += len(points)
                self._held.append(_Points(points))
                self._release()

    def safe_until(self, step: int) -> None:
        """Say that a checkpoint covers all steps until `step`: no resumed run will go back behind it."""
        with self._changed:
            self._safe_step = max(self._safe_step, step)
            self._release()

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Keep a file, or all that lies in a folder, with the run (read later, see Tracker)."""
        self._file.add_file(path, folder)
        self._put(_Call(f"file {path}", lambda run, _: run.log_artifact(path, folder)))

    def set_tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""
        self._file.add_tag(key, value)
        self._put(_Call(f"tag {key}", lambda run, _: run.set_tags({key: value})))

    def finish(self, status: Status, deadline_s: float = 30.0) -> int:
        """Write what is left for at most `deadline_s`, end the run, return the number of points lost.

        A run that failed or was killed may be resumed from its last checkpoint: points after that are not written.
        """
        end_ms = now_ms()
        self._file.change(status=status, end_ms=end_ms)
        if status == "FINISHED":
            with self._changed:
                self._safe_step = math.inf
                self._release()
        if summary := read_object(self._file.folder / "summary.json"):
            self._put(_Call("the result", lambda run, _: run.conclude(self._file.told, summary)))
        self._put(_Call(_END, lambda run, _: self._end(run, status, end_ms), vital=True))
        self._end_by = time.monotonic() + deadline_s
        self._finishing.set()
        self._thread.join(deadline_s)
        lost = self.waiting - sum(len(job.points) for job in self._held)
        if self._rejected:
            return lost  # and was told so
        if lost:
            _log.warning(
                "MLflow (%s): %d of %d metric points were not recorded; metrics.jsonl has them all,"
                " `deepracer-exp resume %s` delivers them",
                self._store.shown, lost, self._told, self._file.folder,
            )  # fmt: skip
        if self._run is not None and self._run.contradicted:
            _log.warning(
                "MLflow (%s): points of repeated iterations stay as they were first recorded there (%d);"
                " metrics.jsonl has the repeated ones",
                self._store.shown, self._run.contradicted,
            )  # fmt: skip
        if not self._ended:
            _log.warning("MLflow (%s): the run could not be marked %s", self._store.shown, status)
        return lost

    def _begin(self, file: TrackingFile, open_run: Callable[["MLflowRun", Told, bool], None]) -> None:
        self._file = file

        def begin(run: "MLflowRun", again: bool) -> None:
            open_run(run, file.told, again)
            file.change(run_id=run.run_id)

        self._put(_Call("the run", begin, vital=True))
        self._put(_Call("the parameters", lambda run, _: run.log_params(file.told.params)))

    def _end(self, run: "MLflowRun", status: Status, end_ms: int) -> None:
        run.end(status, end_ms)
        self._ended = True

    def _release(self) -> None:
        """Queue the points that wait no longer; `_changed` is held."""
        while self._held and self._held[0].step <= self._safe_step:
            self._queue.append(self._held.popleft())
        self._changed.notify()

    def _put(self, job: _Call) -> None:
        with self._changed:
            self._queue.append(job)
            self._changed.notify()

    def _take(self) -> _Points | _Call:
        """Return the next job, with all points that wait in a row as one."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue)
            job = self._queue.popleft()
            if isinstance(job, _Points):
                points = list(job.points)
                while self._queue and len(points) < _POINTS_PER_CALL:
                    if not isinstance(following := self._queue[0], _Points):
                        break
                    points += following.points
                    self._queue.popleft()
                job = _Points(tuple(points))
            return job

    def _work(self) -> None:
        from .mlflow_run import MLflowRun

        self._run = run = MLflowRun(self._store)
        job: _Points | _Call = _Call("the store", lambda run, _: run.connect(), vital=True)
        while True:
            if isinstance(job, _Points):
                if self._attempt(run, _Call("metrics", partial(_log_points, job.points))):
                    with self._changed:
                        self._recorded += len(job.points)
            elif not self._attempt(run, job) and job.vital:
                return
            if self._ended:
                return
            job = self._take()

    def _attempt(self, run: "MLflowRun", call: _Call) -> bool:
        """Repeat `call` until it works, the store refuses it, or the time is up; return whether it worked."""
        from .mlflow_run import StoreRefusedError, StoreUnavailableError

        again = False
        pause_s = _FIRST_PAUSE_S
        while time.monotonic() < self._end_by:
            try:
                call.do(run, again)
            except StoreRefusedError as error:
                if call.vital and call.what != _END:
                    self._rejected = True
                    _log.warning(
                        "MLflow (%s) refused %s, so nothing is recorded there; the run folder has it all: %s",
                        self._store.shown, call.what, one_line(error),
                    )  # fmt: skip
                elif call.what not in self._refused:  # a run deleted in the UI refuses every iteration
                    self._refused.add(call.what)
                    _log.warning("MLflow (%s) refused %s: %s", self._store.shown, call.what, one_line(error))
                return False
            except StoreUnavailableError as error:
                self._report(error)
            else:
                return True
            again = True
            if self._finishing.is_set():
                time.sleep(_FIRST_PAUSE_S)
            else:
                self._finishing.wait(pause_s)
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        return False

    def _report(self, error: Exception) -> None:
        if not self._reported:
            self._reported = True
            _log.warning(
                "MLflow (%s) does not answer; the training goes on and it is tried again: %s",
                self._store.shown, one_line(error),
            )  # fmt: skip


def _log_points(points: tuple[Point, ...], run: "MLflowRun", again: bool) -> None:
    run.log_metrics(points)
