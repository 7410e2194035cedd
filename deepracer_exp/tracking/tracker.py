"""Trackers: what a training reports about its run, and who records it."""

from collections.abc import Mapping
from pathlib import Path

from .metadata import Scalar
from .tracking_file import Status


class Tracker:
    """Records one run. This base class of all trackers, yours included, records nothing (`tracking=off`).

    No method waits for a store, except `finish`. Each metric is recorded once per step, even if processes are killed
    and resumed: points wait until a checkpoint covers them (`safe_until`), so that no resumed run contradicts them,
    and a resumed run (`reopen`) logs all rows of its metrics.jsonl again, of which only the missing ones are written.
    """

    @property
    def run_id(self) -> str | None:
        """Id of the run in MLflow, once it exists."""
        return None

    def start(
        self,
        run_name: str,
        experiment: str,
        params: Mapping[str, Scalar],
        tags: Mapping[str, str],
        identity: Path,
    ) -> None:
        """Start a new run; either this or `reopen` is called first, once.

        Args:
            run_name: shown for the run.
            experiment: that the run belongs to.
            params: by which runs are compared.
            tags: of the run.
            identity: its `tracking.json`, which is written.

        Raises:
            BadInput: the run cannot be recorded.
        """

    def reopen(self, identity: Path) -> None:
        """Continue the run of `identity`, its `tracking.json`.

        Raises:
            BadInput: the file is missing or invalid, or the run cannot be recorded.
        """

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Record a row of metrics.jsonl at `step` (env steps), without None, NaN and infinite values."""

    def safe_until(self, step: int) -> None:
        """Report that a checkpoint covers all steps until `step`: no resumed run will start before it."""

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Store a file, or all files of a folder, with the run.

        It is read later: `path` must not change until `finish` has returned.
        """

    def set_tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""

    def finish(self, status: Status, deadline_s: float = 30.0) -> int:
        """Write what is left for at most `deadline_s`, end the run and return the number of lost points.

        A failed or killed run may be resumed from its last checkpoint: later points are not written.
        """
        return 0
