"""Trackers: what a training reports about its run, and who records it."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path

from deepracer_exp.config.own_class import OwnClass, build_own
from deepracer_exp.config.running import MLflowTracking, TensorBoardTracking, TrackingConfig, TrackingOff
from deepracer_exp.errors import BadInput

from .store import resolve_store
from .tracking_file import Status, TrackedRun

FINISH_S = 30.0
"""How long the end of a run waits for its store."""


class Tracker:
    """Records one run. This base class of all trackers, yours included, records nothing (`tracking=off`).

    No method waits for a store, except `finish`. Each metric is recorded once per step, even if processes are killed
    and resumed: a tracker that cannot change what it has recorded holds points back until a checkpoint covers them
    (`safe_until`), and a resumed run logs all rows of its metrics.jsonl again.
    """

    failure: str | None = None
    """After `finish`: what was not recorded, and why, in one sentence; None: everything was."""

    @property
    def outage(self) -> str | None:
        """Why the store does not answer at the moment, for which `finish` waits; None: it does."""
        return None

    def open(self, folder: Path, run: TrackedRun) -> None:
        """Begin to record a new or resumed run; this is called first, once.

        Args:
            folder: that of the run.
            run: its name, experiment, parameters and tags.

        Raises:
            BadInput: the run cannot be recorded.
        """

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Record a row of metrics.jsonl at `step` (env steps), without None, NaN and infinite values."""

    def log_machine(self, use: Mapping[str, float], step: int) -> None:
        """Record the use of the machine at `step`, which is not part of the run's record."""

    def safe_until(self, step: int) -> None:
        """Report that a checkpoint covers all steps until `step`: no resumed run will start before it."""

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Store a file, or all files of a folder, with the run.

        It is read later: `path` must not change until `finish` has returned.
        """

    def set_tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""

    def finish(self, status: Status, deadline_s: float = FINISH_S) -> None:
        """Write what is left for at most `deadline_s`, and end the run.

        A failed or killed run may be resumed from its last checkpoint: later points are not written.
        """


def open_tracker(config: TrackingConfig, runs_dir: Path) -> Tracker:
    """Return the tracker of a config.

    Raises:
        BadInput: `tracking.uri` can never work, a package is not installed, or a class cannot be used.
    """
    # Imported here, because both modules build on this one.
    from .loggers import TensorBoardTracker, WandbTracker
    from .mlflow_tracker import MLflowTracker

    if isinstance(config, OwnClass):
        return build_own(config, "tracking.target", Tracker)
    if isinstance(config, TrackingOff):
        return Tracker()
    if isinstance(config, MLflowTracking):
        return MLflowTracker(resolve_store(config.uri, runs_dir))
    if importlib.util.find_spec(config.kind) is None:
        raise BadInput(
            f"tracking={config.kind}: needs the package {config.kind}; install the project with its extra: "
            f"pip install 'deepracer-exp[{config.kind}]'"
        )
    return TensorBoardTracker() if isinstance(config, TensorBoardTracking) else WandbTracker(config)
