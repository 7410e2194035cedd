"""The MLflow run of a whole study, the parent of its trials' runs."""

import hashlib
import json
import logging
import re
import shlex
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.patience import wait_patiently

from .calls import StoreRefusedError, StoreUnavailableError, ended_within
from .metadata import END_TAG, NOTE, PARENT, STUDY, param_text, study_view, user_tags
from .metrics import Point, now_ms, points_at, trial_metrics
from .mlflow_process import Connect, RemoteRun, connect_here, released
from .store import Store
from .store_thread import StoreThread, refused_of
from .tracking_file import Status, TrackedRun

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

SEARCH, KIND, TRIAL = "sweep.search", "sweep.kind", "sweep.trial"
"""Tags: a hash of what the study searches, `study` or `trial`, the number of the trial."""
_SOURCE = {"mlflow.source.name": "deepracer-exp sweep", "mlflow.source.type": "LOCAL"}
_ENDS = {"FINISHED": "finished", "FAILED": "failed", "KILLED": "interrupted"}

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a study."""

    total: int
    """Number of trials it will have."""
    complete: int
    pruned: int
    failed: int
    env_steps: int
    """Control steps of all trials together."""
    best_trial: int | None = None
    """Number of the best trial; None until a trial is complete, like the fields below."""
    best_values: Mapping[str, float] = field(default_factory=dict)
    """Values of the best trial by objective."""
    best_shown: str | None = None
    """Values of the best trial in words: ``race score 9.84 s``."""
    best_line: str | None = None
    """The command that trains the best trial."""
    lap_time_s: float | None = None
    """Lap time of the best trial."""
    completion: float | None = None
    """Progress of the best trial in per cent of the lap."""

    @property
    def ended(self) -> int:
        """Number of ended trials."""
        return self.complete + self.pruned + self.failed

    def __str__(self) -> str:
        """Return a summary: ``34 of 60 trials: 22 complete, 10 pruned, 2 failed``."""
        counts = f"{self.complete} complete, {self.pruned} pruned, {self.failed} failed"
        return f"{self.ended} of {self.total} trials: {counts}"


class StudyRun:
    """Keeps a study's run in MLflow up to date, from a thread of its own.

    Only the newest progress counts: while the store does not answer, older ones are dropped. A process that continues
    the study continues its run.
    """

    def __init__(
        self,
        store: Store,
        study: str,
        objectives: Sequence[str],
        space: Mapping[str, str],
        base: Sequence[str],
        connect: Connect = connect_here,
        creation_lock: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        """Start creating or finding the run of a search: expressions by key, and overrides of all trials.

        `connect` says which process makes the calls. MLflow cannot create a run only if there is none: `creation_lock`
        lets one process at a time look and create it.
        """
        params = _params(space, base)
        search = hashlib.sha256(json.dumps([dict(space), list(base)], sort_keys=True).encode())
        tags = {STUDY: study, SEARCH: search.hexdigest()[:12], KIND: "study", **_SOURCE, **user_tags()}
        self._store, self._connect, self._creation_lock = store, connect, creation_lock
        self._tracked = TrackedRun(f"sweep {study}", study, now_ms(), params, tags)
        self._searched = [_param_name(key) for key in space]
        self._objectives = objectives
        self._run: MLflowRun | RemoteRun | None = None
        self._progress: Progress | None = None
        self._written: Progress | None = None
        """Progress that MLflow has."""
        self._report: Path | None = None
        self._status: Status | None = None
        self._is_shown, self._is_ended = False, False
        self._is_id_known = False
        self._settled = threading.Event()
        self._thread = StoreThread(self._update, store.shown, "the sweep continues")
        self._thread.begin()

    def wait_for_id(self, deadline_s: float = 30.0) -> str | None:
        """Return the run's id in MLflow; None if the store refuses or does not answer in time."""
        wait_patiently(self._settled.wait, deadline_s)
        return self.run_id

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run, once it exists."""
        return None if self._run is None else self._run.run_id

    def has_new_id(self) -> bool:
        """Return whether the run's id has become known since the last call."""
        is_new = self.run_id is not None and not self._is_id_known
        self._is_id_known |= is_new
        return is_new

    def update(self, progress: Progress) -> None:
        """Record the progress of the study; returns at once."""
        self._progress = progress

    def log_report(self, file: Path) -> None:
        """Store the study's page with the run at its end."""
        self._report = file

    def finish(self, status: Status, deadline_s: float = 30.0) -> bool:
        """Write what is left for at most `deadline_s`, end the run and return whether it was ended."""
        self._status = status
        self._thread.finish(deadline_s)
        released(self._run, is_done=self._thread.has_ended)
        if not self._is_ended:
            _log.warning("MLflow (%s): the study's run could not be marked %s", self._store.shown, status)
        return self._is_ended

    def _update(self) -> Mapping[str, str]:
        """Write what MLflow lacks; return what it refuses, with the reasons."""
        try:
            run = self._opened()
        except StoreRefusedError as error:
            self._settled.set()
            return {"the study's run": str(error)}
        writes: dict[str, Callable[[], object]] = {
            "the study's view": lambda: self._show_trials(run),
            "the study's progress": lambda: self._write_progress(run),
        }
        if (status := self._status) is not None:
            # Also trials that began before this run did.
            writes["the trials"] = lambda: self._adopt(run)
            if (report := self._report) is not None:
                writes[f"file {report}"] = lambda: run.log_artifact(report, None)
            writes["the end"] = lambda: self._end(run, status)
        return refused_of(writes)

    def _opened(self) -> "MLflowRun | RemoteRun":
        if self._run is None:
            run = self._connect(self._store)
            with self._creation_lock():
                run.open_only(self._tracked, (STUDY, SEARCH, KIND))
            run.log(params=self._tracked.params)
            self._run = run
            self._settled.set()
        return self._run

    def _show_trials(self, run: "MLflowRun | RemoteRun") -> None:
        if self._is_shown:
            return
        self._adopt(run)
        study = self._tracked.tags[STUDY]
        run.set_experiment_tags({STUDY: study, **study_view(self._objectives, self._searched)})
        self._is_shown = True

    def _adopt(self, run: "MLflowRun | RemoteRun") -> None:
        run.adopt({STUDY: self._tracked.tags[STUDY]}, but=KIND)

    def _write_progress(self, run: "MLflowRun | RemoteRun") -> None:
        progress = self._progress
        if progress is None or progress is self._written:
            return
        tags = {"sweep.progress": str(progress), NOTE: self._note(progress)}
        if progress.best_trial is not None:
            tags["sweep.best_trial"] = str(progress.best_trial)
        metrics = trial_metrics(
            {"lap_time": progress.lap_time_s, "completion": progress.completion, **progress.best_values}
        )
        counts = ("complete", "pruned", "failed", "env_steps")
        metrics |= {f"study/{name}": getattr(progress, name) for name in counts}
        points = points_at(metrics, progress.ended, now_ms())
        # Also when no trial has ended since: in the end another one may be the best.
        run.log(points if _is_news(run, points) else (), tags=tags)
        if progress.best_trial is not None:
            run.describe_study(f"trial {progress.best_trial}, {progress.best_shown}")
        self._written = progress

    def _end(self, run: "MLflowRun | RemoteRun", status: Status) -> None:
        run.log(tags={END_TAG: _ENDS[status]})
        run.end(status, now_ms())
        self._is_ended = True

    def _note(self, progress: Progress) -> str:
        """Return the description above the run, Markdown."""
        lines = [f"{progress}; {progress.env_steps:,} control steps"]
        if progress.best_trial is not None:
            lines.append(f"**Best: trial {progress.best_trial}**, {progress.best_shown}")
        if progress.best_line:
            # A long line would make the page wider than the screen.
            command, what, *words = map(shlex.quote, shlex.split(progress.best_line))
            line = " \\\n    ".join([f"{command} {what}", *words])
            lines.append(f"```\n{line}\n```")
        params = self._tracked.params
        shared = params.keys() - set(self._searched)
        for title, keys in (("Searched", self._searched), ("All trials", shared)):
            if listed := [f"- `{key}`: `{value}`" for key, value in params.items() if key in keys]:
                lines.append("\n".join([f"{title}:", "", *listed]))
        lines.append("Pictures: `sweep.html` among the artifacts.")
        return "\n\n".join(lines)


def open_trial_run(
    store: Store,
    study: str,
    trial: int,
    parent_run_id: str,
    base: Sequence[str],
    deadline_s: float = 30.0,
    connect: Connect = connect_here,
) -> str | None:
    """Return the id in MLflow of the run that groups the seeds of a trial, created on the first call.

    None if the store refuses or does not answer; the seeds are then nested under the study itself.
    """
    tags = {STUDY: study, KIND: "trial", TRIAL: str(trial), PARENT: parent_run_id, **_SOURCE, **user_tags()}
    tracked = TrackedRun(f"trial {trial}", study, now_ms(), _params({}, base), tags)

    def open_run(run: "MLflowRun | RemoteRun") -> None:
        run.open_only(tracked, (STUDY, KIND, TRIAL, PARENT))
        run.log(params=tracked.params)

    return _within(deadline_s, store, f"trial {trial} has no run there", open_run, connect)


def end_trial_run(
    store: Store,
    run_id: str,
    status: Status,
    reason: str,
    values: Mapping[str, float | None],
    connect: Connect = connect_here,
) -> None:
    """End the run of a trial, or change how it has ended, with its values by metric; errors are logged."""

    def end_run(run: "MLflowRun | RemoteRun") -> None:
        run.read(run_id)
        points = points_at(values, 0, now_ms())
        run.log(points if _is_news(run, points) else (), tags={END_TAG: reason})
        run.end(status, now_ms())

    _within(30.0, store, f"run {run_id} was not ended there", end_run, connect)


def _is_news(run: "MLflowRun | RemoteRun", points: Sequence[Point]) -> bool:
    """Return whether one of the points has a value that is not the newest of its metric."""
    return any(run.metrics.get(key) != value for key, value, *_ in points)


def _within(
    deadline_s: float,
    store: Store,
    failure: str,
    call: "Callable[[MLflowRun | RemoteRun], None]",
    connect: Connect,
) -> str | None:
    """Return the id of the run after `call`; None, with a warning, if it failed or did not finish in time.

    MLflow itself retries for more than a minute to open a database.
    """

    def work() -> str | None:
        run = connect(store)
        try:
            call(run)
        finally:
            released(run)
        return run.run_id

    try:
        return ended_within(deadline_s, work)
    except (StoreRefusedError, StoreUnavailableError, TimeoutError) as error:
        _log.warning("MLflow (%s): %s: %s", store.shown, failure, error)
        return None


def _params(space: Mapping[str, str], base: Sequence[str]) -> dict[str, str]:
    """Return overrides and search expressions as parameters."""
    plain = {key: value for key, _, value in (override.partition("=") for override in base)}
    return {_param_name(key): param_text(value) for key, value in (plain | dict(space)).items()}


def _param_name(key: str) -> str:
    """Return a key as a parameter name that MLflow accepts."""
    return re.sub(r"[^A-Za-z0-9_.:/ -]", "_", key.lstrip("+~"))
