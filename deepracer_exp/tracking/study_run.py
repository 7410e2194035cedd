"""The MLflow run of a whole study, the parent of its trials' runs."""

import hashlib
import json
import logging
import re
import shlex
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from .calls import StoreRefusedError, StoreUnavailableError
from .metadata import END_TAG, NOTE, PARENT, STUDY, param_text, study_view, user_tags
from .metrics import now_ms, points_at, trial_metrics
from .store import Store
from .store_thread import StoreThread
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
    """Its number; None until a trial is complete, like the fields below."""
    best_values: Mapping[str, float] = field(default_factory=dict)
    """By objective."""
    best_shown: str | None = None
    """The same in words: ``race score 9.84 s``."""
    best_line: str | None = None
    """The command that trains it."""
    lap_time_s: float | None = None
    """Of the best trial."""
    completion: float | None = None
    """Of the best trial, per cent."""

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
    ) -> None:
        """Start creating or finding the run of a search: expressions by key, and overrides of all trials."""
        params = _params(space, base)
        search = hashlib.sha256(json.dumps([dict(space), list(base)], sort_keys=True).encode())
        tags = {STUDY: study, SEARCH: search.hexdigest()[:12], KIND: "study", **_SOURCE, **user_tags()}
        self._tracked = TrackedRun(None, f"sweep {study}", study, now_ms(), store.shown, params, tags)
        self._searched = [_param_name(key) for key in space]
        self._objectives = objectives
        self._lock = threading.Lock()
        self._progress: Progress | None = None
        self._last_metrics: Mapping[str, float | None] = {}
        self._is_late = False
        """Whether trials have started without the id of this run."""
        self._settled = threading.Event()
        self._thread = StoreThread(store, "the sweep continues", self._settled.set)
        self._thread.put("the study's run", self._begin, vital=True)
        self._thread.put("the study's view", self._show_trials)

    def wait_for_id(self, deadline_s: float = 30.0) -> str | None:
        """Return the run's id in MLflow; None if the store refuses or does not answer in time."""
        self._is_late |= not self._settled.wait(deadline_s)
        return self.run_id

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run, once it exists."""
        run = self._thread.run
        return None if run is None or self._thread.is_rejected or not self._settled.is_set() else run.run_id

    def update(self, progress: Progress) -> None:
        """Record the progress of the study; returns at once."""
        with self._lock:
            self._progress = progress
        self._thread.put("the study's progress", self._write_progress)

    def log_file(self, path: Path) -> None:
        """Store a file with the run, such as the report; it is read later, and replaces one of the same name."""
        self._thread.put(f"file {path}", lambda run, _: run.log_artifact(path, None))

    def finish(self, status: Status, deadline_s: float = 30.0) -> bool:
        """Write what is left for at most `deadline_s`, end the run and return whether it was ended."""
        is_ended = self._thread.finish(lambda run, _: _end(run, status, _ENDS[status]), deadline_s)
        if not is_ended:
            _log.warning("MLflow (%s): the study's run could not be marked %s", self._tracked.store, status)
        return is_ended

    def _begin(self, run: "MLflowRun", _: bool) -> None:
        run.create_once(self._tracked, (STUDY, SEARCH, KIND))
        run.log_params(self._tracked.params)
        self._settled.set()

    def _show_trials(self, run: "MLflowRun", _: bool) -> None:
        self._adopt(run)
        study = self._tracked.tags[STUDY]
        run.set_experiment_tags({STUDY: study, **study_view(self._objectives, self._searched)})

    def _adopt(self, run: "MLflowRun") -> None:
        run.adopt({STUDY: self._tracked.tags[STUDY]}, but=KIND)

    def _write_progress(self, run: "MLflowRun", _: bool) -> None:
        """Write the newest progress, unless an earlier call has written it."""
        with self._lock:
            progress, self._progress = self._progress, None
        if progress is None:
            return
        try:
            self._write(run, progress)
        except StoreUnavailableError:
            with self._lock:
                self._progress = self._progress or progress
            raise

    def _write(self, run: "MLflowRun", progress: Progress) -> None:
        tags = {"sweep.progress": str(progress), NOTE: self._note(progress)}
        if progress.best_trial is not None:
            tags["sweep.best_trial"] = str(progress.best_trial)
        metrics = trial_metrics(
            {"lap_time": progress.lap_time_s, "completion": progress.completion, **progress.best_values}
        )
        counts = ("complete", "pruned", "failed", "env_steps")
        metrics |= {f"study/{name}": getattr(progress, name) for name in counts}
        run.set_tags(tags)
        if progress.best_trial is not None:
            run.describe_study(f"trial {progress.best_trial}, {progress.best_shown}")
        if self._is_late:
            self._adopt(run)
        # Also when no trial has ended since: in the end another one may be the best.
        if metrics != self._last_metrics:
            run.log_metrics(points_at(metrics, progress.ended, now_ms()))
            self._last_metrics = metrics

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
    store: Store, study: str, trial: int, parent_run_id: str, base: Sequence[str], deadline_s: float = 30.0
) -> str | None:
    """Return the id in MLflow of the run that groups the seeds of a trial, created on the first call.

    None if the store refuses or does not answer; the seeds are then nested under the study itself.
    """
    tags = {STUDY: study, KIND: "trial", TRIAL: str(trial), PARENT: parent_run_id, **_SOURCE, **user_tags()}
    tracked = TrackedRun(None, f"trial {trial}", study, now_ms(), store.shown, _params({}, base), tags)

    def open_run(run: "MLflowRun") -> None:
        run.create_once(tracked, (STUDY, KIND, TRIAL, PARENT))
        run.log_params(tracked.params)

    return _within(deadline_s, store, f"trial {trial} has no run there", open_run)


def end_trial_run(
    store: Store, study: str, run_id: str, status: Status, reason: str, values: Mapping[str, float | None]
) -> None:
    """End the run of a trial with its values by metric; errors are logged."""

    def end_run(run: "MLflowRun") -> None:
        run.reopen(TrackedRun(run_id, "", study, 0, store.shown))
        run.log_metrics(points_at(values, 0, now_ms()))
        _end(run, status, reason)

    _within(30.0, store, f"run {run_id} was not ended there", end_run)


def _end(run: "MLflowRun", status: Status, reason: str) -> None:
    run.set_tags({END_TAG: reason})
    run.end(status, now_ms())


def _within(deadline_s: float, store: Store, failure: str, call: "Callable[[MLflowRun], None]") -> str | None:
    """Return the id of the run after `call`; None, with a warning, if it failed or did not finish in time.

    In a thread, because MLflow itself retries for more than a minute to open a database.
    """
    done: list[str | None] = []
    reasons: list[str] = []

    def work() -> None:
        from .mlflow_run import MLflowRun

        run = MLflowRun(store)
        try:
            run.connect()
            call(run)
            done.append(run.run_id)
        except (StoreRefusedError, StoreUnavailableError) as error:
            reasons.append(str(error))

    thread = threading.Thread(target=work, name="mlflow-trial", daemon=True)
    thread.start()
    thread.join(deadline_s)
    if done:
        return done[0]
    reason = reasons[0] if reasons else f"no answer within {deadline_s:g} s"
    _log.warning("MLflow (%s): %s: %s", store.shown, failure, reason)
    return None


def _params(space: Mapping[str, str], base: Sequence[str]) -> dict[str, str]:
    """Return overrides and search expressions as parameters."""
    plain = {key: value for key, _, value in (override.partition("=") for override in base)}
    return {_param_name(key): param_text(value) for key, value in (plain | dict(space)).items()}


def _param_name(key: str) -> str:
    """Return a key as a parameter name that MLflow accepts."""
    return re.sub(r"[^A-Za-z0-9_.:/ -]", "_", key.lstrip("+~"))
