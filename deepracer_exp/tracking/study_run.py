"""The MLflow run that stands for a whole study, above the runs of its trials."""

import hashlib
import json
import logging
import re
import shlex
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.config.running import TrackingConfig, TrackingOff

from .flatten import param_text
from .names import END_TAG, PARENT, study_view, trial_metrics
from .points import now_ms, points_at
from .store import Store, one_line, resolve_store
from .tracking_file import Status, Told

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

STUDY, SEARCH, KIND, TRIAL = "sweep.study", "sweep.search", "sweep.kind", "sweep.trial"
"""Tags: the study's name, a hash of what it searches, `study` or `trial`, the number of the trial."""

_log = logging.getLogger(__name__)

_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 10.0


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a study is."""

    total: int
    """Trials it is to have."""
    complete: int
    pruned: int
    failed: int
    env_steps: int
    """Control steps of all trials together."""
    best_trial: int | None = None
    """Its number, as for the five below None as long as no trial is complete."""
    best_values: Mapping[str, float] = field(default_factory=dict)
    """By objective."""
    best_shown: str | None = None
    """The same in words: ``race score 9.84 s``."""
    best_line: str | None = None
    """The command that makes it."""
    lap_time_s: float | None = None
    """Of the best trial."""
    completion: float | None = None
    """Of the best trial, per cent."""

    @property
    def ended(self) -> int:
        """Trials that have come to their end."""
        return self.complete + self.pruned + self.failed

    def __str__(self) -> str:
        """Return it in words: ``34 of 60 trials: 22 complete, 10 pruned, 2 failed``."""
        counts = f"{self.complete} complete, {self.pruned} pruned, {self.failed} failed"
        return f"{self.ended} of {self.total} trials: {counts}"


class StudyRun:
    """Keeps a study's run in MLflow up to date, from a thread of its own.

    Only the newest progress counts: while the store does not answer, older ones are forgotten. Whoever goes on with
    the study goes on with its run.
    """

    def __init__(
        self,
        store: Store,
        study: str,
        objectives: Sequence[str],
        space: Mapping[str, str],
        base: Sequence[str],
    ) -> None:
        """Begin to create the run, or to find it.

        Args:
            store: where trials are recorded.
            study: its name, which is also the experiment of its runs.
            objectives: what trials are compared by.
            space: what is searched, by key.
            base: overrides of all trials.
        """
        self._store = store
        self._told = _told_of_study(store, study, space, base)
        self._searched = [_param_name(key) for key in space]
        self._objectives = objectives
        self._changed = threading.Condition()
        self._progress: Progress | None = None
        self._files: dict[Path, str | None] = {}
        self._last_metrics: Mapping[str, float | None] = {}
        self._status: Status | None = None
        self._end_by = float("inf")
        self._reported = False
        self._refused: set[str] = set()
        self._ended = False
        self._is_late = False
        """Whether trials have begun without the id of this run."""
        self._run: MLflowRun | None = None
        self._settled = threading.Event()
        # Daemon: a store that hangs must not keep a process alive whose sweep is over.
        self._thread = threading.Thread(target=self._work, name="mlflow-study", daemon=True)
        self._thread.start()

    def wait_for_id(self, deadline_s: float = 30.0) -> str | None:
        """Return MLflow's id of the run; None if the store refuses or has not answered until then."""
        self._is_late |= not self._settled.wait(deadline_s)
        return self.run_id

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run, once it exists."""
        return self._run.run_id if self._run is not None and self._settled.is_set() else None

    def update(self, progress: Progress) -> None:
        """Record how far the study is; returns at once."""
        with self._changed:
            self._progress = progress
            self._changed.notify()

    def pictures(self, files: Sequence[Path], folder: str | None = None) -> None:
        """Keep files, such as the report, with the run; they are read later, and one of that name is replaced."""
        with self._changed:
            self._files |= dict.fromkeys(files, folder)
            self._changed.notify()

    def finish(self, status: Status, deadline_s: float = 30.0) -> bool:
        """Write what is left for at most `deadline_s` and end the run; return whether all was written."""
        with self._changed:
            self._status = status
            self._end_by = time.monotonic() + deadline_s
            self._changed.notify()
        self._thread.join(deadline_s)
        if not self._ended:
            _log.warning("MLflow (%s): the study's run could not be marked %s", self._store.shown, status)
        return self._ended

    def _work(self) -> None:
        from .mlflow_run import MLflowRun

        run = MLflowRun(self._store)
        if not self._attempt(lambda: self._begin(run)):
            self._settled.set()
            return
        self._run = run
        self._settled.set()
        self._attempt(lambda: self._show_trials(run))
        while not self._ended:
            with self._changed:
                self._changed.wait_for(self._has_news)
            if not self._attempt(lambda: self._write_progress(run)):
                self._progress = None
            while self._files:
                with self._changed:
                    path, folder = self._files.popitem()
                self._attempt(partial(run.log_artifact, path, folder))
            if self._status is not None:
                self._ended = self._attempt(lambda: self._end(run))
                return

    def _has_news(self) -> bool:
        return self._progress is not None or bool(self._files) or self._status is not None

    def _begin(self, run: "MLflowRun") -> None:
        run.connect()
        run.create_once(self._told, (STUDY, SEARCH, KIND))
        run.log_params(self._told.params)

    def _show_trials(self, run: "MLflowRun") -> None:
        self._adopt(run)
        run.set_experiment_tags(study_view(self._objectives, self._searched))

    def _adopt(self, run: "MLflowRun") -> None:
        run.adopt({STUDY: self._told.tags[STUDY]}, but=KIND)

    def _write_progress(self, run: "MLflowRun") -> None:
        progress = self._progress
        if progress is None:
            return
        tags = {"sweep.progress": str(progress), "mlflow.note.content": self._note(progress)}
        if progress.best_trial is not None:
            tags["sweep.best_trial"] = str(progress.best_trial)
        metrics: dict[str, float | None] = {
            "lap_time": progress.lap_time_s,
            "completion": progress.completion,
        }
        metrics = trial_metrics({**metrics, **progress.best_values})
        metrics |= {"study/complete": progress.complete, "study/pruned": progress.pruned}
        metrics |= {"study/failed": progress.failed, "study/env_steps": progress.env_steps}
        run.set_tags(tags)
        if self._is_late:
            self._adopt(run)
        # Not once a trial: at the end the best one may be another than before.
        if metrics != self._last_metrics:
            run.log_metrics(points_at(metrics, progress.ended, now_ms()))
            self._last_metrics = metrics
        with self._changed:
            if self._progress is progress:
                self._progress = None

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
        params = self._told.params
        for title, keys in (
            ("Searched", self._searched),
            ("All trials", params.keys() - set(self._searched)),
        ):
            if told := [f"- `{key}`: `{value}`" for key, value in params.items() if key in keys]:
                lines.append("\n".join([f"{title}:", "", *told]))
        lines.append("Pictures: `sweep.html` among the artifacts.")
        return "\n\n".join(lines)

    def _end(self, run: "MLflowRun") -> None:
        assert self._status is not None
        run.set_tags({END_TAG: {"FINISHED": "finished", "FAILED": "failed"}.get(self._status, "interrupted")})
        run.end(self._status, now_ms())

    def _attempt(self, call: Callable[[], None]) -> bool:
        """Repeat `call` until it works, the store refuses it, or the time is up; return whether it worked."""
        from .mlflow_run import StoreRefusedError, StoreUnavailableError

        pause_s = _FIRST_PAUSE_S
        while time.monotonic() < self._end_by:
            try:
                call()
            except StoreRefusedError as error:
                reason = one_line(error)
                if reason not in self._refused:  # a run deleted in the UI refuses every update
                    self._refused.add(reason)
                    _log.warning("MLflow (%s) refused the study's run: %s", self._store.shown, reason)
                return False
            except StoreUnavailableError as error:
                if not self._reported:
                    self._reported = True
                    _log.warning(
                        "MLflow (%s) does not answer; the sweep goes on and it is tried again: %s",
                        self._store.shown, one_line(error),
                    )  # fmt: skip
            else:
                return True
            with self._changed:
                self._changed.wait_for(lambda: self._status is not None, pause_s)
            if self._status is not None:
                time.sleep(_FIRST_PAUSE_S)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        return False


def open_study_run(
    config: TrackingConfig,
    runs_dir: Path,
    study: str,
    objectives: Sequence[str],
    space: Mapping[str, str],
    base: Sequence[str],
) -> StudyRun | None:
    """Begin the run of a study; None with `tracking=off`.

    Raises:
        BadInput: `tracking.uri` can never work.
    """
    if isinstance(config, TrackingOff):
        return None
    return StudyRun(resolve_store(config.uri, runs_dir), study, objectives, space, base)


def open_trial_run(
    store: Store,
    study: str,
    trial: int,
    parent_run_id: str,
    base: Sequence[str],
    deadline_s: float = 30.0,
) -> str | None:
    """Return MLflow's id of the run that the seeds of one trial stand under; whoever asks again gets the same.

    Args:
        store: where trials are recorded.
        study: its name.
        trial: the number that trials are told by.
        parent_run_id: of the study's run.
        base: overrides of the trial.
        deadline_s: the longest that is waited.

    Returns:
        None if the store refuses or does not answer: then the seeds stand under the study itself.
    """
    tags = {STUDY: study, KIND: "trial", TRIAL: str(trial), PARENT: parent_run_id, **_SOURCE}
    told = Told(None, f"trial {trial}", study, now_ms(), store.shown, _params({}, base), tags)

    def open_run(run: "MLflowRun") -> None:
        run.connect()
        run.create_once(told, (STUDY, KIND, TRIAL, PARENT))
        run.log_params(told.params)

    return _within(deadline_s, store, f"trial {trial} has no run there", open_run)


def end_trial_run(
    store: Store,
    study: str,
    run_id: str,
    status: Status,
    reason: str,
    values: Mapping[str, float | None],
    deadline_s: float = 30.0,
) -> None:
    """End the run that the seeds of a trial stand under.

    Args:
        store: where trials are recorded.
        study: its name.
        run_id: of the run.
        status: how it ended.
        reason: the same in words.
        values: metrics of the trial, means over its seeds.
        deadline_s: the longest that is waited.
    """

    def end_run(run: "MLflowRun") -> None:
        run.connect()
        run.reopen(Told(run_id, "", study, 0, store.shown))
        run.log_metrics(points_at(values, 0, now_ms()))
        run.set_tags({END_TAG: reason})
        run.end(status, now_ms())

    _within(deadline_s, store, f"run {run_id} was not ended there", end_run)


_SOURCE = {"mlflow.source.name": "deepracer-exp sweep", "mlflow.source.type": "LOCAL"}


def _within(deadline_s: float, store: Store, failure: str, call: "Callable[[MLflowRun], None]") -> str | None:
    """Return the id of the run that `call` was done with; None, and a line in the log, if it was not in time.

    In a thread: of a database that cannot be opened MLflow tries again by itself, for more than a minute.
    """
    done: list[str | None] = []
    told: list[str] = []

    def work() -> None:
        from .mlflow_run import MLflowRun, StoreRefusedError, StoreUnavailableError

        run = MLflowRun(store)
        try:
            call(run)
            done.append(run.run_id)
        except (StoreRefusedError, StoreUnavailableError) as error:
            told.append(one_line(error))

    thread = threading.Thread(target=work, name="mlflow-trial", daemon=True)
    thread.start()
    thread.join(deadline_s)
    if done:
        return done[0]
    reason = told[0] if told else f"no answer within {deadline_s:g} s"
    _log.warning("MLflow (%s): %s: %s", store.shown, failure, reason)
    return None


def _told_of_study(store: Store, study: str, space: Mapping[str, str], base: Sequence[str]) -> Told:
    params = _params(space, base)
    search = hashlib.sha256(json.dumps([dict(space), list(base)], sort_keys=True).encode()).hexdigest()[:12]
    tags = {STUDY: study, SEARCH: search, KIND: "study", **_SOURCE}
    return Told(None, f"sweep {study}", study, now_ms(), store.shown, params, tags)


def _params(space: Mapping[str, str], base: Sequence[str]) -> dict[str, str]:
    """Return the overrides and the expressions that are searched as parameters, by key."""
    plain = {key: value for key, _, value in (override.partition("=") for override in base)}
    return {_param_name(key): param_text(value) for key, value in (plain | dict(space)).items()}


def _param_name(key: str) -> str:
    """Return what a run calls a key, as MLflow takes it for a name."""
    return re.sub(r"[^A-Za-z0-9_.:/ -]", "_", key.lstrip("+~"))
