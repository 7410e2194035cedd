"""Tracker: what the training loop tells, recorded in MLflow beside the training, never in its way."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from deepracer_exp.config.running import TrackingConfig, TrackingOff

from .flatten import Scalar, param_text
from .names import in_order
from .store import Store, redact, resolve_store

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

Point = tuple[str, float, int, int]
"""Key, value, time in ms, step."""
Status = Literal["FINISHED", "FAILED", "KILLED"]

_log = logging.getLogger(__name__)

_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 10.0
_POINTS_PER_CALL = 1000


class Tracker(Protocol):
    """Records one run. No method waits for the store, save `finish`."""

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run, once it exists."""

    def start(
        self, run_name: str, experiment: str, params: Mapping[str, Scalar], tags: Mapping[str, str]
    ) -> None:
        """Begin the run; called once, before the others."""

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Record metrics at `step` (env steps); None, NaN and infinite values are left out."""

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Keep a file, or all that lies in a folder, with the run.

        It is read later: `path` must stay as it is until `finish` has returned.
        """

    def set_tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""

    def finish(self, status: Status, deadline_s: float = 30.0) -> int:
        """Write what is left for at most `deadline_s`, end the run, return the number of points lost."""


def open_tracker(config: TrackingConfig, runs_dir: Path) -> Tracker:
    """Return the tracker that `config` asks for; MLflow begins to load in the background.

    Raises:
        BadInput: `tracking.uri` can never work.
    """
    if isinstance(config, TrackingOff):
        return NullTracker()
    return MLflowTracker(resolve_store(config.uri, runs_dir))


class NullTracker:
    """Records nothing (`tracking=off`)."""

    run_id = None

    def start(
        self, run_name: str, experiment: str, params: Mapping[str, Scalar], tags: Mapping[str, str]
    ) -> None:
        """Do nothing."""

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Do nothing."""

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Do nothing."""

    def set_tag(self, key: str, value: str) -> None:
        """Do nothing."""

    def finish(self, status: Status, deadline_s: float = 30.0) -> int:
        """Do nothing; nothing is lost."""
        return 0


@dataclass(frozen=True)
class _Points:
    points: tuple[Point, ...]


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
    answers (a point carries the time at which it was told, so a repeated write is the same point). What
    the store refuses is left out. The first failure and the sum at the end are logged.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._queue: deque[_Points | _Call] = deque()
        self._changed = threading.Condition()
        self._told = 0
        self._recorded = 0
        self._reported = False
        self._refused: set[str] = set()
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
        self, run_name: str, experiment: str, params: Mapping[str, Scalar], tags: Mapping[str, str]
    ) -> None:
        """Begin the run; called once, before the others."""
        start_ms = _now_ms()
        tags = dict(tags)
        texts = {key: param_text(value) for key, value in params.items()}
        self._put(
            _Call(
                "the run",
                lambda run, again: run.create(experiment, run_name, tags, start_ms, again=again),
                vital=True,
            )
        )
        self._put(_Call("the parameters", lambda run, _: run.log_params(texts)))

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Record metrics at `step` (env steps); None, NaN and infinite values are left out."""
        now_ms = _now_ms()
        points = tuple(
            (key, float(value), now_ms, step)
            for key, value in in_order(metrics)
            if value is not None and math.isfinite(value)
        )
        if points:
            self._put(_Points(points))

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Keep a file, or all that lies in a folder, with the run (read later, see Tracker)."""
        self._put(_Call(f"file {path}", lambda run, _: run.log_artifact(path, folder)))

    def set_tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""
        self._put(_Call(f"tag {key}", lambda run, _: run.set_tag(key, value)))

    def finish(self, status: Status, deadline_s: float = 30.0) -> int:
        """Write what is left for at most `deadline_s`, end the run, return the number of points lost."""
        end_ms = _now_ms()
        self._put(_Call("the end", lambda run, _: self._end(run, status, end_ms), vital=True))
        self._end_by = time.monotonic() + deadline_s
        self._finishing.set()
        self._thread.join(deadline_s)
        lost = self.waiting
        if lost:
            _log.warning(
                "MLflow (%s): %d of %d metric points were not recorded; metrics.jsonl has them all",
                self._store.shown, lost, self._told,
            )  # fmt: skip
        if not self._ended:
            _log.warning("MLflow (%s): the run could not be marked %s", self._store.shown, status)
        return lost

    def _end(self, run: "MLflowRun", status: Status, end_ms: int) -> None:
        run.end(status, end_ms)
        self._ended = True

    def _put(self, job: _Points | _Call) -> None:
        with self._changed:
            if isinstance(job, _Points):
                self._told += len(job.points)
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
                if call.what not in self._refused:  # a run deleted in the UI refuses every iteration
                    self._refused.add(call.what)
                    _log.warning("MLflow (%s) refused %s: %s", self._store.shown, call.what, _one_line(error))
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
                self._store.shown, _one_line(error),
            )  # fmt: skip


def _log_points(points: tuple[Point, ...], run: "MLflowRun", again: bool) -> None:
    run.log_metrics(points)


def _now_ms() -> int:
    return time.time_ns() // 1_000_000


def _one_line(error: Exception) -> str:
    return redact(" ".join(str(error).split()))[:300]
