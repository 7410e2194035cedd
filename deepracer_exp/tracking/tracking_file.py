"""`tracking.json`: the MLflow run of a run folder, and what the folder's other files do not say of it."""

import json
import logging
import threading
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from deepracer_exp.errors import BadInput
from deepracer_exp.files import atomic_write, read_json_as
from deepracer_exp.runs.files import TRACKING

Status = Literal["FINISHED", "FAILED", "KILLED"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrackedRun:
    """Identity, parameters, tags and end of a run, whether or not MLflow has them yet."""

    run_name: str
    experiment: str
    start_ms: int
    """Milliseconds since 1970. With name and experiment they identify a run whose id was never received."""
    params: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    store: str = ""
    """Address of the MLflow that records the run, without password."""
    run_id: str | None = None
    """MLflow's id of the run; None until MLflow has created it."""
    status: Status | None = None
    """MLflow's status of the ended run; None while it is running, or if it was killed."""
    end_ms: int | None = None
    complete: bool = False
    """Whether the run has ended and the store has been given all of it."""


class TrackingFile:
    """`tracking.json` of a run folder, written atomically by the threads of the training and the tracker."""

    def __init__(self, folder: Path, run: TrackedRun, store: str) -> None:
        """Write the file of a run, to record it in `store` (without password).

        For another store the id is dropped, because the run may have another one there, or none yet.
        """
        self.folder = folder
        self._lock = threading.RLock()
        self.run = run if run.store == store else replace(run, run_id=None, store=store, complete=False)
        self.change()

    def change(self, **changes: Any) -> None:
        """Set fields of the run."""
        with self._lock:
            self.run = replace(self.run, **changes)
            try:
                atomic_write(self.folder / TRACKING, json.dumps(asdict(self.run), indent=1) + "\n")
            except OSError as error:
                # Only needed after a kill; a full disk ends the training elsewhere.
                _log.warning("%s: cannot be written: %s", self.folder / TRACKING, error.strerror)

    def add_tag(self, key: str, value: str) -> None:
        """Add a tag."""
        with self._lock:
            self.change(tags={**self.run.tags, key: value})


_TRACKED_RUN = TypeAdapter(TrackedRun)


def read_tracked_run(path: Path) -> TrackedRun:
    """Read a `tracking.json`.

    Raises:
        BadInput: it is missing or invalid.
    """
    run = read_json_as(path, _TRACKED_RUN, "a tracker")
    if run is None:
        raise BadInput(path, "is missing: the run was not recorded in MLflow, or the file was removed")
    return run


def begin_again(path: Path, run_dir: Path) -> None:
    """Turn a copied `tracking.json` into that of the new run in `run_dir`."""
    run = read_tracked_run(path)
    tags = {**run.tags, "run_dir": str(run_dir.resolve())}
    again = replace(run, run_id=None, tags=tags, complete=False)
    atomic_write(path, json.dumps(asdict(again), indent=1) + "\n")
