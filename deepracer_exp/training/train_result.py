"""The result of a training."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepracer_exp.runs.run_result import Ending


class TakenOver(Exception):  # noqa: N818 - reads as what it is at the raise site
    """Another process continues this run: nothing more may be written to it."""


@dataclass
class TrainResult:
    """The result of a training."""

    ending: Ending
    exit_code: int
    folder: Path
    summary: dict[str, Any]
    """Contents of summary.json."""
    error: BaseException | None = None
    """The exception that ended a failed run."""
    note: str | None = None
    """A line for each missing result."""
    unrecorded: str | None = None
    """A sentence on what the tracker could not record, and why."""

    @property
    def status(self) -> str:
        """`finished`, `stopped early` (more training would not have helped), `interrupted` or `failed`."""
        return self.ending.status

    @property
    def reason(self) -> str:
        """A sentence on why it ended."""
        return self.ending.reason
