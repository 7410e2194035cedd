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

Status = Literal["FINISHED", "FAILED", "KILLED"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrackedRun:
    """Identity, parameters, tags and end of a run, whether or not MLflow has them yet."""

    run_id: str | None
    """In MLflow; None until the run is created there."""
    run_name: str
    experiment: str
    start_ms: int
    """Since 1970. With name and experiment it identifies a run whose id was never received."""
    store: str
    """Where the run is recorded, without password."""
    params: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    status: Status | None = None
    """Of the ended run; None while it is running, or if it was killed."""
    end_ms: int | None = None
    complete: bool = False
    """Whether the run has ended and the store has been given all of it."""


class TrackingFile:
    """`tracking.json` of a run folder, written atomically by the threads of the training and the tracker."""

    def __init__(self, path: Path, run: TrackedRun) -> None:
        """Write the file."""
        self._path = path
        self._lock = threading.RLock()
        self.run = run
        self.change()

    @classmethod
    def read(cls, path: Path, store: str) -> "TrackingFile":
        """Read an earlier run's file, to continue recording in `store` (without password).

        For another store the id is dropped, because the run may have another one there, or none yet.
        """
        run = read_tracked_run(path)
        return cls(
            path, run if run.store == store else replace(run, run_id=None, store=store, complete=False)
        )

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self._path.parent

    def change(self, **changes: Any) -> None:
        """Set fields of the run."""
        with self._lock:
            self.run = replace(self.run, **changes)
            try:
                atomic_write(self._path, json.dumps(asdict(self.run), indent=1) + "\n")
            except OSError as error:
                # Only needed after a kill; a full disk ends the training elsewhere.
                _log.warning("%s: cannot be written: %s", self._path, error.strerror)

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
        raise BadInput(f"{path}: is missing: the run was not recorded in MLflow, or the file was removed")
    return run


def begin_again(path: Path, run_dir: Path) -> None:
    """Turn a copied `tracking.json` into that of the new run in `run_dir`."""
    run = read_tracked_run(path)
    tags = {**run.tags, "run_dir": str(run_dir.resolve())}
    again = replace(run, run_id=None, tags=tags, complete=False)
    atomic_write(path, json.dumps(asdict(again), indent=1) + "\n")
