"""Trackers: the interface by which a training describes its run, and its implementations."""

import importlib.util
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from typing_extensions import override

from deepracer_exp.config.own_class import OwnClass, build_own
from deepracer_exp.config.running import MLflowTracking, TrackingConfig, TrackingOff, WandbTracking
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.run_files import TENSORBOARD, WANDB

from .metadata import END_TAG
from .mlflow_metrics import now_ms
from .projector import ProjectedRun, Projector, Target, kind_of
from .store import Store, resolve_store
from .tracking_file import Status, TrackedRun

FINISH_S = 30.0
"""Seconds for which the end of a run waits for its tracker."""
_log = logging.getLogger(__name__)


class Tracker:
    """Records one run. This base class of all trackers, yours included, records nothing (`tracking=off`).

    All that is recorded of a run is in its folder, `metrics.jsonl` and `summary.json` among it, and may be read from
    there at any time; the folder of a resumed run is as it was at its last checkpoint. No method waits for a server,
    except `finish`.
    """

    failure: str | None = None
    """After `finish`: a sentence on what was not recorded and why; None: everything was."""

    @property
    def outage(self) -> str | None:
        """Reason why records are pending, for which `finish` waits; None: nothing is pending."""
        return None

    def open(self, folder: Path, run: TrackedRun) -> None:
        """Begin to record a new or resumed run; this is called first, once.

        Raises:
            BadInput: the run cannot be recorded.
        """

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Record a row of metrics.jsonl at `step` (env steps); values may be None.

        A resumed run logs all rows again that it has, and one that is over the last evaluation at the step of its row.
        """

    def set_tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""

    def finish(self, status: Status, deadline_s: float = FINISH_S) -> None:
        """Write the rest within `deadline_s`, and end the run.

        A failed or killed run may be resumed from its last checkpoint.
        """


class ProjectedTracker(Tracker):
    """Describes the run in its folder, which another process reads and records."""

    def __init__(self, target: Target, projector: Projector | None = None) -> None:
        """Record in a target; without a `projector`, which is for several runs, this run has one of its own."""
        self._target, self._is_own = target, projector is None
        self._projector = Projector() if projector is None else projector
        self._run: ProjectedRun
        shown = {TENSORBOARD: "TensorBoard", WANDB: "W&B"}
        self._shown = f"MLflow ({target.shown})" if isinstance(target, Store) else shown[kind_of(target)]

    @property
    @override
    def outage(self) -> str | None:
        reason = self._run.recorded.problem
        return None if reason is None else f"{self._shown}: {reason}"

    @override
    def open(self, folder: Path, run: TrackedRun) -> None:
        store = self._target.shown if isinstance(self._target, Store) else ""
        if run.store != store:
            run = replace(run, run_id=None, complete=False)
        tags = {key: value for key, value in run.tags.items() if key != END_TAG}
        run = replace(run, store=store, tags=tags, status=None, end_ms=None, values={}, complete=False)
        is_wandb = isinstance(self._target, WandbTracking)
        try:
            (folder / f"{WANDB}.json").unlink(missing_ok=True)
            self._run = ProjectedRun(folder, run, self._target, self._projector)
            self._run.begin(is_training=not is_wandb)
        except OSError as error:
            raise BadInput(f"tracking={kind_of(self._target)}", f"{folder}: {error.strerror}") from error
        if is_wandb and (problem := self._run.wait_for_answer(FINISH_S).problem) is not None:
            self._projector.end()
            accepted = "a machine that is logged in (`wandb login`), or tracking.mode=offline"
            raise BadInput("tracking=wandb", problem, accepted)

    @override
    def set_tag(self, key: str, value: str) -> None:
        try:
            self._run.change(tags={**self._run.run.tags, key: value})
        except OSError as error:
            # Needed after a kill only; a full disk ends the training elsewhere.
            _log.warning("%s: a tag was not written: %s", self._run.folder, error.strerror)

    @override
    def finish(self, status: Status, deadline_s: float = FINISH_S) -> None:
        try:
            self._run.change(status=status, end_ms=now_ms())
        except OSError as error:
            reason: str | None = f"its end was not written: {error.strerror}"
        else:
            reason = self._run.wait_for_end(deadline_s)
        if self._is_own:
            self._projector.end()
        if reason is not None:
            self.failure = f"{self._shown}: some of this run was not recorded: {reason}"
            if isinstance(self._target, WandbTracking):
                self.failure += "; `wandb sync` in the run folder uploads what is missing"
            _log.warning("%s; the run folder has everything", self.failure)


def open_tracker(config: TrackingConfig, runs_dir: Path, projector: Projector | None = None) -> Tracker:
    """Return the tracker of a config; `projector` records several runs of this process, one after the other.

    Raises:
        BadInput: `tracking.uri` can never work, a package is not installed, or a class cannot be used.
    """
    if isinstance(config, OwnClass):
        return build_own(config, "tracking.target", Tracker)
    if isinstance(config, TrackingOff):
        return Tracker()
    if isinstance(config, MLflowTracking):
        return ProjectedTracker(resolve_store(config.uri, runs_dir), projector)
    if importlib.util.find_spec(config.kind) is None:
        raise BadInput(
            f"tracking={config.kind}: needs the package {config.kind}; install the project with its extra: "
            f"pip install 'deepracer-exp[{config.kind}]'"
        )
    return ProjectedTracker(config, projector)
