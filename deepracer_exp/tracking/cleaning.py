"""Find and remove what is no longer needed in run folders."""

import fcntl
import os
import re
import shutil
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.checkpoint_files import pinned, verify
from deepracer_exp.runs.files import read_object, read_run_id
from deepracer_exp.runs.lineage import LINEAGE, read_lineage

from .registry import registered_checkpoints
from .store import open_client, pages


@dataclass(frozen=True)
class Overview:
    """The runs and registered checkpoints of a store."""

    deleted: dict[str, bool]
    """Whether each run, by id, was deleted there."""
    registered: set[tuple[str, str]]
    """Checkpoints that are versions of a model: names of the run's and the checkpoint's folder."""


def look_over(uri: str | None, runs_dir: Path) -> Overview:
    """Read the runs and models of a store.

    Args:
        uri: the store, as in `tracking.uri`; None: the one in `runs_dir`.
        runs_dir: where runs are.

    Raises:
        BadInput: the store does not answer.
    """
    with open_client("MLflow", uri, runs_dir) as client:
        from mlflow.entities import ViewType

        everything = {"view_type": ViewType.ALL}
        experiments = [one.experiment_id for one in pages(client.search_experiments, **everything)]
        runs = pages(client.search_runs, experiment_ids=experiments, run_view_type=ViewType.ALL)
        deleted = {run.info.run_id: run.info.lifecycle_stage != "active" for run in runs}
        return Overview(deleted, registered_checkpoints(client))


CHECKPOINTS = "checkpoints neither best nor last"
TRACE = "trace of a failed run"
DELETED = "run deleted in MLflow"

_IDLE_S = 3600.0
"""A run without a summary that changed more recently may be training on another machine."""
_UNKNOWN = (
    "recorded in a store that was not read, where a checkpoint may be registered: give it as tracking.uri=URI"
)
_OWN_FILES = ("config.yaml", "overrides.yaml", "provenance.json")
_RUNNING = ".running"


@dataclass(frozen=True)
class Removable:
    """Something that may be removed."""

    run: Path
    what: str
    """CHECKPOINTS, TRACE or DELETED."""
    paths: tuple[Path, ...]
    size: int
    """Bytes."""


@dataclass(frozen=True)
class Removables:
    """Result of a search."""

    removable: list[Removable] = field(default_factory=list)
    kept: list[tuple[Path, str]] = field(default_factory=list)
    """Runs with something that must be kept for now, and why."""


def survey(runs_dir: Path, overview: Overview | None) -> Removables:
    """Find what may be removed; nothing is changed.

    Args:
        runs_dir: where runs are.
        overview: what MLflow knows; None: it was not read, and nothing of a run that is recorded there goes but its
            trace.

    Raises:
        BadInput: a file that says what must be kept cannot be read.
    """
    found = Removables()
    try:
        wanted = _cloned_from(runs_dir)
        for folder, name in () if overview is None else sorted(overview.registered):
            wanted[folder].setdefault(name, "registered")
        for run in _own_runs(runs_dir):
            _search(run, wanted[run.name], overview, found)
    except OSError as error:
        raise BadInput(f"{error.filename}: cannot be read: {error.strerror}; nothing is removed") from error
    return found


def remove(item: Removable) -> bool:
    """Remove it, unless a training has started in the run's folder or a checkpoint was pinned since.

    Returns:
        Whether it was removed.

    Raises:
        RunFailed: it cannot be removed.
    """
    try:
        with _locked(item.run) as is_ours:
            pins = pinned(item.run / "checkpoints")
            if not is_ours or (pins and item.what == DELETED) or pins.keys() & {p.name for p in item.paths}:
                return False
            for path in item.paths:
                shutil.rmtree(path)
            return True
    except OSError as error:
        raise RunFailed(f"{error.filename}: cannot be removed: {error.strerror}") from error


def _search(run: Path, wanted: dict[str, str], overview: Overview | None, found: Removables) -> None:
    if reason := _in_progress(run):
        found.kept.append((run, reason))
        return
    run_id = read_run_id(run)
    is_known = run_id is None or (overview is not None and run_id in overview.deleted)
    pins = wanted | {name: ", ".join(reasons) for name, reasons in pinned(run / "checkpoints").items()}
    if run_id is not None and overview is not None and overview.deleted.get(run_id):
        if not pins:
            found.removable.append(Removable(run, DELETED, (run,), _size(run)))
            return
        reasons = ", ".join(f"{name} {why}" for name, why in sorted(pins.items()))
        found.kept.append((run, f"deleted in MLflow, but needed: {reasons}"))
    checkpoints = _unneeded(run, set(pins))
    if checkpoints and not is_known:
        found.kept.append((run, _UNKNOWN))
    elif checkpoints:
        try:
            verify(run / "checkpoints" / "last")
        except BadInput as error:
            found.kept.append((run, f"its other checkpoints may be needed: {error}"))
        else:
            sizes = sum(map(_size, checkpoints))
            found.removable.append(Removable(run, CHECKPOINTS, tuple(checkpoints), sizes))
    trace = run / "trace"
    if read_object(run / "summary.json").get("status") == "failed" and _is_folder(trace):
        found.removable.append(Removable(run, TRACE, (trace,), _size(trace)))


def _own_runs(runs_dir: Path) -> Iterator[Path]:
    """Return the run folders, without links."""
    for experiment in sorted(runs_dir.iterdir()):
        for run in sorted(experiment.iterdir()) if _is_folder(experiment) else ():
            if _is_folder(run) and all((run / name).is_file() for name in _OWN_FILES):
                yield run


def _cloned_from(runs_dir: Path) -> dict[str, dict[str, str]]:
    """Return the checkpoints that clones started from, by name of the run's folder."""
    names: dict[str, dict[str, str]] = defaultdict(dict)
    for file in runs_dir.glob(f"*/*/{LINEAGE}"):
        lineage = read_lineage(file.parent)
        if lineage is not None:
            names[lineage.parent][lineage.checkpoint] = f"cloned to {file.parent.name}"
    return names


def _unneeded(run: Path, pins: set[str]) -> list[Path]:
    """Return the checkpoints that are neither best nor last nor pinned."""
    folder = run / "checkpoints"
    if not _is_folder(folder):
        return []
    links = {path.readlink().name for path in folder.iterdir() if path.is_symlink()}
    own = [path for path in folder.iterdir() if re.fullmatch(r"\d{6,9}", path.name) and _is_folder(path)]
    return sorted(path for path in own if path.name not in links | pins)


def _in_progress(run: Path) -> str | None:
    with _locked(run, make=False) as is_ours:
        if not is_ours:
            return "a training is running in it"
    if (run / "summary.json").exists():
        return None
    newest = max(path.lstat().st_mtime for path in (run, *run.iterdir(), *(run / "checkpoints").glob("*")))
    minutes = (time.time() - newest) / 60
    return f"has not ended and changed {minutes:.0f} minutes ago" if minutes * 60 < _IDLE_S else None


@contextmanager
def _locked(run: Path, make: bool = True) -> Iterator[bool]:
    """Hold the lock of a training; yields whether it was free."""
    file = run / _RUNNING
    if not make and not file.exists():
        yield True
        return
    with file.open("a" if make else "r") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True
        if make:
            file.unlink(missing_ok=True)


def _is_folder(path: Path) -> bool:
    """Return whether it is a folder and not a link, whose target may belong to something else."""
    return path.is_dir() and not path.is_symlink()


def _size(folder: Path) -> int:
    """Return the bytes of all files below, without following links."""
    files = (Path(at, name) for at, _, names in os.walk(folder) for name in names)
    return sum(file.lstat().st_size for file in files)


def total(items: Sequence[Removable]) -> int:
    """Return the total size in bytes."""
    return sum(item.size for item in items)
