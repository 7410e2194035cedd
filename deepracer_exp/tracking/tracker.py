"""Trackers: what a training reports about its run, and who records it."""

from collections.abc import Mapping
from pathlib import Path

from .tracking_file import Status, TrackedRun

FINISH_S = 30.0
"""Seconds for which the end of a run waits for its store."""


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
