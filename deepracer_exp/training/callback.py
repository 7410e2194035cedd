"""What happens around the loop of a training: the hooks that the trainer calls, and what comes of a run."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepracer_exp.runs.result import Ending

if TYPE_CHECKING:
    from .trainer import Trainer


class TakenOver(Exception):  # noqa: N818 - reads as what it is at the raise site
    """Another process continues this run: nothing more may be written of it."""


@dataclass
class TrainResult:
    """The outcome of a training."""

    ending: Ending
    exit_code: int
    folder: Path
    summary: dict[str, Any]
    """Contents of summary.json."""
    error: BaseException | None = None
    """The exception that ended a failed run."""
    note: str | None = None
    """A line on what is missing from the results."""
    unrecorded: str | None = None
    """A sentence on what its tracker could not record, and why."""

    @property
    def status(self) -> str:
        """`finished`, `stopped early` (more training would not have helped), `interrupted` or `failed`."""
        return self.ending.status

    @property
    def reason(self) -> str:
        """A sentence on what ended it."""
        return self.ending.reason


class Callback:
    """Base class of everything that happens around the training loop; each hook does nothing unless overridden.

    The trainer calls a hook of all its callbacks in the order of its list. A hook may read all public attributes of
    the trainer, add columns to `trainer.row` (in `on_iteration_end`, ahead of the callback that records it), and call
    `trainer.request_stop` and `trainer.request_save`. An exception from a hook ends the run as failed.
    """

    hurries_when_interrupted = False
    """Leave out `on_train_end` when the run is interrupted, because another process resumes it at once."""

    def on_replay(self, trainer: "Trainer") -> None:
        """`trainer.row` is a row of metrics.jsonl that a resumed run has up to its checkpoint; called for each."""

    def on_fit_start(self, trainer: "Trainer") -> None:
        """The loop is about to start; a stop requested here ends it before any car drives.

        What is entered into `trainer.running` here is left once the loop has ended, however it ended.
        """

    def on_iteration_end(self, trainer: "Trainer") -> None:
        """The networks are updated and `trainer.row` is measured."""

    def on_train_end(self, trainer: "Trainer") -> None:
        """The run came to its end or was interrupted, but did not fail; its results are written next."""

    def on_run_end(self, trainer: "Trainer", result: TrainResult) -> None:
        """summary.json is written; the last hook of a run."""

    def on_release(self, trainer: "Trainer") -> None:
        """Another process has taken the run over: write nothing more. In place of `on_run_end`."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed run needs: tensors, arrays and JSON types, under keys no other callback uses."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from what all callbacks of the run have stored."""

    def summary(self, trainer: "Trainer") -> dict[str, Any]:
        """Return entries for summary.json, JSON types."""
        return {}
