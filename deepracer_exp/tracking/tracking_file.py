"""`tracking.json`: which MLflow run belongs to a run folder, and what was told to it besides metrics."""

import json
import logging
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from deepracer_exp.errors import BadInput
from deepracer_exp.formats.whole_file import write_whole

NAME = "tracking.json"
Status = Literal["FINISHED", "FAILED", "KILLED"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Told:
    """What a training has told of its run, whether or not MLflow has it yet; metrics.jsonl has the points."""

    run_id: str | None
    """MLflow's; None until it has created the run."""
    run_name: str
    experiment: str
    start_ms: int
    """Since 1970. With name and experiment it finds a run of which MLflow's id was never heard."""
    store: str
    """Where it is recorded, without password."""
    params: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    files: dict[str, str | None] = field(default_factory=dict)
    """Path, from the run folder where it lies in there, and the folder it gets in MLflow."""
    status: Status | None = None
    """How the run ended; None: it goes on, or was killed."""
    end_ms: int | None = None


class TrackingFile:
    """`tracking.json` of a run folder, written whole or not at all, by the training's thread and the recorder's."""

    def __init__(self, path: Path, told: Told) -> None:
        """Write the file."""
        self._path = path
        self._lock = threading.Lock()
        self.told = told
        self._write(told)

    @classmethod
    def read(cls, path: Path, store: str) -> "TrackingFile":
        """Return the file that a run has left, to be recorded in `store` (without password).

        In another store the run may have another id, or may not be yet: the old one is forgotten.

        Raises:
            BadInput: it is missing, cannot be read or does not hold what a tracker writes.
        """
        told = read_told(path)
        return cls(path, told if told.store == store else replace(told, run_id=None, store=store))

    @property
    def folder(self) -> Path:
        """The run's."""
        return self._path.parent

    def change(self, **changes: Any) -> None:
        """Set fields of Told."""
        with self._lock:
            self._write(replace(self.told, **changes))

    def add_tag(self, key: str, value: str) -> None:
        """Note a tag."""
        with self._lock:
            self._write(replace(self.told, tags={**self.told.tags, key: value}))

    def add_file(self, path: Path, folder: str | None) -> None:
        """Note a file, or folder, that is kept with the run."""
        path, base = path.resolve(), self._path.parent.resolve()
        shown = path.relative_to(base) if path.is_relative_to(base) else path
        with self._lock:
            self._write(replace(self.told, files={**self.told.files, shown.as_posix(): folder}))

    def _write(self, told: Told) -> None:
        self.told = told
        try:
            write_whole(self._path, json.dumps(asdict(told), indent=1) + "\n")
        except OSError as error:
            # Needed only after a kill; the training goes on, and a full disk ends it elsewhere.
            _log.warning("%s: cannot be written: %s", self._path, error.strerror)


def read_told(path: Path) -> Told:
    """Read a `tracking.json`.

    Raises:
        BadInput: it is missing, cannot be read or does not hold what a tracker writes.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInput(
            f"{path}: cannot be read: {error.strerror}; the run was not recorded in MLflow, or restore the file"
        ) from error
    except ValueError as error:
        raise BadInput(f"{path}: is not valid JSON: {error}") from error
    try:
        told = Told(**data)
    except TypeError as error:
        raise BadInput(f"{path}: holds other keys than a tracker writes: {error}") from error
    kinds: Mapping[str, type | tuple[type, ...]] = {
        "run_id": (str, type(None)), "run_name": str, "experiment": str, "start_ms": int, "store": str,
        "params": dict, "tags": dict, "files": dict,
    }  # fmt: skip
    for key, kind in kinds.items():
        if not isinstance(getattr(told, key), kind):
            raise BadInput(f"{path}: {key}: {getattr(told, key)!r} is not what a tracker writes")
    return told


def begin_again(path: Path, run_dir: Path) -> None:
    """Make a copied `tracking.json` that of a run which MLflow does not have yet.

    Args:
        path: the copy.
        run_dir: where the run will lie.

    Raises:
        BadInput: as for `read_told`.
    """
    told = read_told(path)
    tags = {**told.tags, "run_dir": str(run_dir.resolve())}
    write_whole(path, json.dumps(asdict(replace(told, run_id=None, tags=tags)), indent=1) + "\n")
