"""The MLflow run of a whole study, the parent of its trials' runs, and the run of a trial."""

import hashlib
import json
import logging
import re
import shlex
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from deepracer_exp.errors import BadInput

from .metadata import END_TAG, KIND, NOTE, PARENT, STUDY, param_text, study_view, user_tags
from .mlflow_metrics import now_ms, trial_metrics
from .projector import ProjectedRun, Projector
from .store import Store
from .tracking_file import Group, Status, TrackedRun, read_recorded, read_tracked_run

SEARCH, TRIAL = "sweep.search", "sweep.trial"
"""Tags: a hash of the study's search, and the number of the trial. `sweep.kind` distinguishes their runs."""
_SOURCE = {"mlflow.source.name": "deepracer-exp sweep", "mlflow.source.type": "LOCAL"}
_ENDS = {"FINISHED": "finished", "FAILED": "failed", "KILLED": "interrupted"}

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a study."""

    total: int
    """Number of trials in the end."""
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
    """Keeps a study's run in MLflow up to date by a process of its own, which reads a folder that this one writes.

    Only the newest progress counts: while the store does not answer, older ones are dropped. A process that continues
    the study continues its run.

    Attributes:
        run_id: MLflow's id of the run, once it is known; None before.
    """

    def __init__(
        self,
        store: Store,
        study: str,
        objectives: Sequence[str],
        space: Mapping[str, str],
        base: Sequence[str],
        lock: Path | None = None,
        projector: Projector | None = None,
    ) -> None:
        """Start creating or finding the run of a search: expressions by key, and overrides of all trials.

        MLflow has no atomic look-up and creation: the file `lock` admits one process at a time.
        """
        params = _params(space, base)
        search = hashlib.sha256(json.dumps([dict(space), list(base)], sort_keys=True).encode())
        tags = {STUDY: study, SEARCH: search.hexdigest()[:12], KIND: "study", **_SOURCE, **user_tags()}
        self._searched = [_param_name(key) for key in space]
        self._group = Group(
            marks=(STUDY, SEARCH, KIND),
            lock=None if lock is None else str(lock),
            experiment_tags={STUDY: study, **study_view(objectives, self._searched)},
            study=study,
        )
        self._store = store
        # Every process that continues a study has one of its own.
        self._folder = tempfile.TemporaryDirectory(prefix="study-", ignore_cleanup_errors=True)
        self._projector = Projector() if projector is None else projector
        run = TrackedRun(
            f"sweep {study}", study, now_ms(), params, tags, store=store.shown, group=self._group
        )
        self._run = ProjectedRun(Path(self._folder.name), run, store, self._projector)
        self._run.begin(is_training=False)
        self.run_id: str | None = None
        self._is_id_known = False

    def wait_for_id(self, deadline_s: float = 30.0) -> str | None:
        """Return the run's id in MLflow; None if the store refuses or does not answer in time."""
        self.run_id = self.run_id or self._run.wait_for_answer(deadline_s).run_id
        return self.run_id

    def has_new_id(self) -> bool:
        """Return whether the run's id has become known since the last call."""
        self.run_id = self.run_id or self._run.recorded.run_id
        is_new = not self._is_id_known and self.run_id is not None
        self._is_id_known |= is_new
        return is_new

    def update(self, progress: Progress) -> None:
        """Record the progress of the study; returns at once."""
        tags = {**self._run.run.tags, "sweep.progress": str(progress), NOTE: self._note(progress)}
        if progress.best_trial is not None:
            tags["sweep.best_trial"] = str(progress.best_trial)
            winner = f"trial {progress.best_trial}, {progress.best_shown}"
            self._group = replace(self._group, winner=winner)
        values = trial_metrics(
            {"lap_time": progress.lap_time_s, "completion": progress.completion, **progress.best_values}
        )
        counts = ("complete", "pruned", "failed", "env_steps")
        values |= {f"study/{name}": getattr(progress, name) for name in counts}
        numbers = {key: float(value) for key, value in values.items() if value is not None}
        self._change(tags=tags, values=numbers, values_step=progress.ended, group=self._group)

    def log_report(self, file: Path) -> None:
        """Store the study's page with the run at its end."""
        self._group = replace(self._group, report=str(file.absolute()))

    def finish(self, status: Status, deadline_s: float = 30.0) -> bool:
        """Write the rest within `deadline_s`, end the run and return whether that succeeded."""
        tags = {**self._run.run.tags, END_TAG: _ENDS[status]}
        self._change(tags=tags, group=self._group, status=status, end_ms=now_ms())
        problem = self._run.wait_for_end(deadline_s)
        self.run_id = self.run_id or self._run.recorded.run_id
        self._projector.end()
        self._folder.cleanup()
        if problem is not None:
            shown = self._store.shown
            _log.warning("MLflow (%s): the study's run could not be marked %s: %s", shown, status, problem)
        return problem is None

    def _change(self, **changes: object) -> None:
        try:
            self._run.change(**changes)
        except OSError as error:
            _log.warning(
                "MLflow (%s): the study's run is not recorded: %s", self._store.shown, error.strerror
            )

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
        params = self._run.run.params
        shared = params.keys() - set(self._searched)
        for title, keys in (("Searched", self._searched), ("All trials", shared)):
            if listed := [f"- `{key}`: `{value}`" for key, value in params.items() if key in keys]:
                lines.append("\n".join([f"{title}:", "", *listed]))
        lines.append("Pictures: `sweep.html` among the artifacts.")
        return "\n\n".join(lines)


def open_trial_run(
    folder: Path,
    store: Store,
    study: str,
    trial: int,
    parent_run_id: str,
    base: Sequence[str],
    projector: Projector,
    deadline_s: float = 30.0,
) -> str | None:
    """Return the id in MLflow of the run that groups the seeds of a trial, created on the first call.

    It is described in an empty folder. None if the store refuses or does not answer; the seeds are then nested under
    the study itself.
    """
    tags = {STUDY: study, KIND: "trial", TRIAL: str(trial), PARENT: parent_run_id, **_SOURCE, **user_tags()}
    group = Group(marks=(STUDY, KIND, TRIAL, PARENT))
    tracked = TrackedRun(
        f"trial {trial}", study, now_ms(), _params({}, base), tags, store=store.shown, group=group
    )
    run = ProjectedRun(folder, tracked, store, projector)
    run.begin(is_training=False)
    recorded = run.wait_for_answer(deadline_s)
    if recorded.run_id is None:
        projector.end()
        reason = recorded.problem or f"no answer within {deadline_s:g} s"
        _log.warning("MLflow (%s): trial %d has no run there: %s", store.shown, trial, reason)
    return recorded.run_id


def end_trial_run(
    folder: Path,
    store: Store,
    status: Status,
    reason: str,
    values: Mapping[str, float | None],
    projector: Projector,
    deadline_s: float = 30.0,
) -> None:
    """End the run of a trial, or change its ending, with its values by metric; errors are logged.

    `folder` describes it: that of `open_trial_run`, or the run folder of the only seed.
    """
    try:
        before = read_tracked_run(folder)
        # If the run is not recorded, `runs send` records this as well.
        waits = before.group is not None or read_recorded(folder).has_all_of(before)
        run = ProjectedRun(folder, before, store, projector)
        numbers = {key: value for key, value in values.items() if value is not None}
        run.change(tags={**before.tags, END_TAG: reason}, values=numbers, status=status, end_ms=now_ms())
        problem = run.wait_for_end(deadline_s) if waits else None
    except (BadInput, OSError) as error:
        problem = str(error)
    if problem is not None:
        _log.warning(
            "MLflow (%s): the end of the trial in %s was not recorded: %s", store.shown, folder, problem
        )


def _params(space: Mapping[str, str], base: Sequence[str]) -> dict[str, str]:
    """Return overrides and search expressions as parameters."""
    plain = {key: value for key, _, value in (override.partition("=") for override in base)}
    return {_param_name(key): param_text(value) for key, value in (plain | dict(space)).items()}


def _param_name(key: str) -> str:
    """Return a key as a parameter name that MLflow accepts."""
    return re.sub(r"[^A-Za-z0-9_.:/ -]", "_", key.lstrip("+~"))
