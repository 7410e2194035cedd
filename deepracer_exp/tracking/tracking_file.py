"""`tracking.json`, a training's description of its run for trackers, and `mlflow.json`, the state of the record."""

import json
import logging
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from deepracer_exp.errors import BadInput
from deepracer_exp.files import atomic_write, read_json_as
from deepracer_exp.runs.run_files import MLFLOW, TRACKING

Status = Literal["FINISHED", "FAILED", "KILLED"]

REFUSED = "refused "
"""Beginning of a problem that another attempt would not solve."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Group:
    """Further fields of a parent run: a study's, above its trials', or a trial's, above its seeds'."""

    marks: tuple[str, ...]
    """Tags that identify the run: one with the same values in its experiment is continued, whichever process began
    it."""
    lock: str | None = None
    """File that one process at a time locks while it looks for the run and creates it."""
    experiment_tags: dict[str, str] = field(default_factory=dict)
    study: str | None = None
    """The study whose trials are nested under it; None: nested runs name their parent themselves."""
    winner: str | None = None
    """The best trial in words, for the description of the experiment."""
    report: str | None = None
    """File that is stored with the run at its end."""


@dataclass(frozen=True)
class TrackedRun:
    """Identity, parameters, tags and end of a run, whether or not a tracker has them yet: `tracking.json`."""

    run_name: str
    experiment: str
    start_ms: int
    """Milliseconds since 1970. With name and experiment they identify a run whose id was never received."""
    params: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    store: str = ""
    """Address of the MLflow that is to record the run, without password; empty for other trackers."""
    status: Status | None = None
    """MLflow's status of the ended run; None while it is running, or if it was killed."""
    end_ms: int | None = None
    values: dict[str, float] = field(default_factory=dict)
    """Metrics, by MLflow's names, that no other file has: of the trial that a run is, of a whole study."""
    values_step: int = 0
    """The step at which they are recorded."""
    group: Group | None = None
    """None for a training."""
    run_id: str | None = None
    """Read from folders of version 0.1.0, which had no `mlflow.json`; the same holds for `complete`."""
    complete: bool = False


@dataclass(frozen=True)
class Recorded:
    """The record of a run in a tracker: `mlflow.json`, and the files of other trackers."""

    store: str = ""
    """As in `TrackedRun`."""
    run_id: str | None = None
    """MLflow's id of the run; None until MLflow has created it."""
    end_ms: int | None = None
    """The ending recorded together with everything before it; None while there is none."""
    problem: str | None = None
    """A line on what is not recorded and why; None: nothing is missing."""

    @property
    def is_refused(self) -> bool:
        """Whether the tracker has refused something."""
        return self.problem is not None and self.problem.startswith(REFUSED)

    def has_all_of(self, run: TrackedRun) -> bool:
        """Return whether the run has ended and all of it was recorded."""
        is_last = run.end_ms is not None and self.end_ms == run.end_ms
        return is_last and self.problem is None and self.store == run.store


_TRACKED_RUN, _RECORDED = TypeAdapter(TrackedRun), TypeAdapter(Recorded)


def read_tracked_run(folder: Path) -> TrackedRun:
    """Read the `tracking.json` of a folder.

    Raises:
        BadInput: it is missing or invalid.
    """
    run = read_json_as(folder / TRACKING, _TRACKED_RUN, "a training")
    if run is None:
        raise BadInput(
            folder / TRACKING, "is missing: the run was not recorded in MLflow, or the file was removed"
        )
    return run


def write_tracked_run(folder: Path, run: TrackedRun) -> None:
    """Write the `tracking.json` of a folder.

    Raises:
        OSError: it cannot be written.
    """
    values = {key: value for key, value in asdict(run).items() if value or key not in ("run_id", "complete")}
    atomic_write(folder / TRACKING, json.dumps(values, indent=1) + "\n")


def read_recorded(folder: Path, kind: str = "mlflow") -> Recorded:
    """Read a tracker's record of the run of a folder; empty if there is none.

    Raises:
        BadInput: a file is invalid.
    """
    recorded = read_json_as(folder / f"{kind}.json", _RECORDED, "a tracker")
    if recorded is not None or kind != "mlflow":
        return recorded or Recorded()
    run = read_tracked_run(folder)
    return Recorded(run.store, run.run_id, run.end_ms if run.complete else None)


def write_recorded(folder: Path, recorded: Recorded, kind: str = "mlflow") -> None:
    """Write a tracker's record."""
    file = folder / f"{kind}.json"
    try:
        atomic_write(file, json.dumps(asdict(recorded), indent=1) + "\n")
    except OSError as error:  # a full disk ends the training elsewhere
        _log.warning("%s: cannot be written: %s", file, error.strerror)


def note_problem(folder: Path, problem: str) -> None:
    """Mark an ended run as incomplete in MLflow."""
    write_recorded(folder, replace(read_recorded(folder), problem=problem))


def is_copy(run_dir: Path) -> bool:
    """Return whether a run's folder was copied, and the original, the same run for a tracker, can still be read.

    Where all runs were copied as a whole, those beside the copy count.

    Raises:
        BadInput: the `tracking.json` of the folder is missing or invalid.
    """
    run = read_tracked_run(run_dir)
    recorded = Path(run.tags.get("run_dir", run_dir))
    beside = run_dir.parent.parent / recorded.parent.name / recorded.name
    try:
        original = beside if beside.exists() else recorded
        other = read_tracked_run(original)
        return not original.samefile(run_dir) and _identity(other) == _identity(run)
    except (BadInput, OSError, ValueError):  # it is gone, or not ours to read
        return False


def _identity(run: TrackedRun) -> tuple[object, ...]:
    return run.start_ms, run.run_name, run.experiment, run.tags.get("run_dir")


def begin_again(folder: Path, run_dir: Path) -> None:
    """Turn a copy of a run's folder into a run of its own, which will lie at `run_dir`."""
    run, place = read_tracked_run(folder), str(run_dir.resolve())
    # First: killed in between, the copy is found to be one again.
    (folder / MLFLOW).unlink(missing_ok=True)
    # The description names the folder, too.
    tags = {key: value.replace(run.tags.get("run_dir", place), place) for key, value in run.tags.items()}
    write_tracked_run(folder, replace(run, run_id=None, tags=tags, complete=False))
