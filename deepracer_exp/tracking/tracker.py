"""What the training loop tells of its run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from .flatten import Scalar
from .tracking_file import Status


class Tracker(Protocol):
    """Records one run. No method waits for the store, save `finish`.

    Of each metric a store gets one point a step, whatever is killed and resumed: points wait until a checkpoint
    covers them (`safe_until`), so none is written that a resumed run would contradict, and a run that goes on
    (`reopen`) tells all rows of its metrics.jsonl again, of which those that are missing are written.
    """

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run, once it exists."""

    def start(
        self,
        run_name: str,
        experiment: str,
        params: Mapping[str, Scalar],
        tags: Mapping[str, str],
        identity: Path,
    ) -> None:
        """Begin the run, and `identity`, its `tracking.json`; this or `reopen` is called before the others."""

    def reopen(self, identity: Path) -> None:
        """Go on with the run that `identity`, its `tracking.json`, tells of.

        Raises:
            BadInput: the file is missing or not what a tracker writes.
        """

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Record a row of metrics.jsonl at `step` (env steps); None, NaN and infinite values are left out."""

    def safe_until(self, step: int) -> None:
        """Say that a checkpoint covers all steps until `step`: no resumed run will go back behind it."""

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Keep a file, or all that lies in a folder, with the run.

        It is read later: `path` must stay as it is until `finish` has returned.
        """

    def set_tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""

    def finish(self, status: Status, deadline_s: float = 30.0) -> int:
        """Write what is left for at most `deadline_s`, end the run, return the number of points lost.

        A run that failed or was killed may be resumed from its last checkpoint: points after that are not written.
        """


class NullTracker:
    """Records nothing (`tracking=off`)."""

    run_id = None

    def start(
        self,
        run_name: str,
        experiment: str,
        params: Mapping[str, Scalar],
        tags: Mapping[str, str],
        identity: Path,
    ) -> None:
        """Do nothing."""

    def reopen(self, identity: Path) -> None:
        """Do nothing."""

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Do nothing."""

    def safe_until(self, step: int) -> None:
        """Do nothing."""

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Do nothing."""

    def set_tag(self, key: str, value: str) -> None:
        """Do nothing."""

    def finish(self, status: Status, deadline_s: float = 30.0) -> int:
        """Do nothing; nothing is lost."""
        return 0
