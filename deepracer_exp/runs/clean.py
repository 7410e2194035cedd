"""Find and remove unneeded parts of run folders."""

import os
import shutil
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from deepracer_exp.errors import BadInput, RunFailed

from .checkpoint_files import LINKS, checkpoint_words, kept_checkpoints, pinned, verify
from .folder import RunFolder, is_held
from .lineage import read_lineage
from .run_files import (
    CHECKPOINTS,
    CONFIG,
    LINEAGE,
    OVERRIDES,
    PROVENANCE,
    REPLAY,
    SUMMARY,
    TRACE,
    full_name,
    read_object,
    read_run_id,
)
from .run_result import FAILED, FINISHED, STOPPED_EARLY

SPARE_CHECKPOINTS = "checkpoints neither best nor last"
FAILED_TRACE = "trace of a failed run"
WHOLE_TRACE, EARLY_TRACE = "trace of a finished run", "trace of a finished run, all but its newest iterations"
WHOLE_REPLAY = "replay of a run that has ended, which then cannot resume"
THIN, DROP = "thin", "drop"
"""Two ways to shrink the traces of finished runs."""
ASKED = "run that was asked for"
DELETED = "run deleted in MLflow"

_IDLE_S = 3600.0
"""A run without a summary that changed more recently may be training on another machine."""
_LEAST_ITERATIONS = 10
_UNKNOWN = (
    "recorded in a store that was not read, where a checkpoint may be registered: give it as tracking.uri=URI"
)


@dataclass(frozen=True)
class StoreOverview:
    """Runs and registered checkpoints of an MLflow store."""

    deleted: dict[str, bool]
    """Whether each run, by id, was deleted there."""
    registered: set[tuple[str, str]]
    """Checkpoints that are versions of a model: the full name of the run, and the name of the checkpoint's folder."""


@dataclass(frozen=True)
class Removable:
    """Something that may be removed."""

    run: Path
    what: str
    """One of the constants above."""
    paths: tuple[Path, ...]
    size: int
    """Bytes."""


@dataclass(frozen=True)
class Removables:
    """Result of a search."""

    removable: list[Removable] = field(default_factory=list)
    kept: list[tuple[Path, str]] = field(default_factory=list)
    """Runs with something that must be kept for now, and why."""
    offered: list[Removable] = field(default_factory=list)
    """Traces of finished runs and replays of ended ones, which are removed only on request."""


def survey(runs_dir: Path, overview: StoreOverview | None) -> Removables:
    """Find removable parts; nothing is changed.

    Without `overview`, the data of MLflow, only the trace of a run that is recorded there may be removed.

    Raises:
        BadInput: a file of pins cannot be read.
    """
    removables = Removables()
    try:
        wanted = _cloned_from(runs_dir)
        for folder, name in () if overview is None else sorted(overview.registered):
            wanted[folder].setdefault(name, "registered")
        for run in _own_runs(runs_dir):
            _search(run, wanted[full_name(run)], overview, removables)
    except OSError as error:
        raise BadInput(error.filename, f"cannot be read: {error.strerror}; nothing is removed") from error
    return removables


def remove(item: Removable) -> bool:
    """Remove it and return True, unless a training has begun in it meanwhile or it was pinned.

    Raises:
        RunFailed: it cannot be removed.
    """
    try:
        folder = RunFolder(item.run)
    except BadInput:
        return False
    except OSError as error:
        raise RunFailed(f"{error.filename}: cannot be removed: {error.strerror}") from error
    try:
        pins = pinned(item.run / CHECKPOINTS)
        if (pins and item.run in item.paths) or pins.keys() & {path.name for path in item.paths}:
            return False
        for path in item.paths:
            if _is_folder(path):
                shutil.rmtree(path)
            else:
                path.unlink()
        return True
    except OSError as error:
        raise RunFailed(f"{error.filename}: cannot be removed: {error.strerror}") from error
    finally:
        folder.release()


def total_bytes(items: Sequence[Removable]) -> int:
    """Return the total size in bytes."""
    return sum(item.size for item in items)


def _search(
    run: Path, wanted: dict[str, str], overview: StoreOverview | None, removables: Removables
) -> None:
    if reason := _in_progress(run):
        removables.kept.append((run, reason))
        return
    run_id = read_run_id(run)
    pins = wanted | {name: _few(reasons) for name, reasons in pinned(run / CHECKPOINTS).items()}
    if overview is not None and run_id is not None and overview.deleted.get(run_id):
        if not pins:
            removables.removable.append(Removable(run, DELETED, (run,), _size(run)))
            return
        reasons = ", ".join(f"{checkpoint_words(name)} {why}" for name, why in sorted(pins.items()))
        removables.kept.append((run, f"deleted in MLflow, but needed: {reasons}"))
    spare = _spare_checkpoints(run, set(pins))
    is_known = run_id is None or (overview is not None and run_id in overview.deleted)
    if spare and not is_known:
        removables.kept.append((run, _UNKNOWN))
    elif spare:
        try:
            verify(run / CHECKPOINTS / "last")
        except BadInput as error:
            removables.kept.append((run, f"its other checkpoints may be needed: {error}"))
        else:
            removables.removable.append(Removable(run, SPARE_CHECKPOINTS, spare, sum(map(_size, spare))))
    trace, replay = run / TRACE, run / REPLAY
    status = read_object(run / SUMMARY).get("status")
    if status in (FAILED, FINISHED, STOPPED_EARLY) and _is_folder(replay):
        removables.offered.append(Removable(run, WHOLE_REPLAY, (replay,), _size(replay)))
    if status is None or not _is_folder(trace):
        return
    if status == FAILED:
        removables.removable.append(Removable(run, FAILED_TRACE, (trace,), _size(trace)))
    elif status in (FINISHED, STOPPED_EARLY):
        removables.offered.append(Removable(run, WHOLE_TRACE, (trace,), _size(trace)))


def asked_traces(offered: Sequence[Removable], how: str | None) -> list[Removable]:
    """Select traces to remove: all of them (DROP), all but their newest part (THIN) or nothing."""
    traces = [item for item in offered if item.what == WHOLE_TRACE]
    if how == DROP:
        return traces
    return [early for item in traces if (early := _early(item)) is not None] if how == THIN else []


def replays(offered: Sequence[Removable]) -> list[Removable]:
    """Return removable replays."""
    return [item for item in offered if item.what == WHOLE_REPLAY]


def _early(item: Removable) -> Removable | None:
    """Return all of a trace but the newest tenth of its iterations and at least ten; None: it has no more.

    Pages read the newest ones of a trace that is too long for memory. A file has the number of its last iteration.
    """
    (trace,) = item.paths
    files = sorted(path for path in trace.iterdir() if path.is_file() and not path.is_symlink())
    number = {path: int(digits) for path in files if (digits := path.name.partition("-")[0]).isdigit()}
    last = max(number.values(), default=0)
    newest = last - max(last // 10, _LEAST_ITERATIONS)
    early = tuple(path for path in files if path not in number or number[path] <= newest)
    if not early:
        return None
    return Removable(item.run, EARLY_TRACE, early, sum(path.lstat().st_size for path in early))


def deletable(run: Path, runs_dir: Path) -> Removable:
    """Return a whole run, on request to delete it.

    Raises:
        BadInput: it is no folder of its own in `runs_dir`, is in progress, or another run or a registered model needs
            it.
    """
    place = run.resolve()
    if run.is_symlink() or place.parent.parent != runs_dir.resolve() or place.parent.is_symlink():
        raise BadInput(run, f"is not a run's own folder in runs_dir={runs_dir}; nothing was deleted")
    wanted = _cloned_from(runs_dir)[full_name(place)] | {
        name: _few(reasons) for name, reasons in pinned(run / CHECKPOINTS).items()
    }
    reasons = [f"{checkpoint_words(name)} is {why}" for name, why in sorted(wanted.items())]
    if reason := _in_progress(run) or ", ".join(reasons):
        raise BadInput(run, f"{reason}; nothing was deleted")
    return Removable(run, ASKED, (run,), _size(run))


def _few(reasons: Sequence[str]) -> str:
    """Return reasons as text; a sweep's trials may be many clones."""
    more = f" and {len(reasons) - 2} more" if len(reasons) > 3 else ""
    return ", ".join(reasons[: 2 if more else 3]) + more


def _own_runs(runs_dir: Path) -> Iterator[Path]:
    """Return the run folders, without links."""
    for experiment in sorted(runs_dir.iterdir()):
        for run in sorted(experiment.iterdir()) if _is_folder(experiment) else ():
            if _is_folder(run) and all((run / name).is_file() for name in (CONFIG, OVERRIDES, PROVENANCE)):
                yield run


def _cloned_from(runs_dir: Path) -> dict[str, dict[str, str]]:
    """Return the checkpoints that clones started from, by the full name of the run."""
    names: dict[str, dict[str, str]] = defaultdict(dict)
    for file in runs_dir.glob(f"*/*/{LINEAGE}"):
        lineage = read_lineage(file.parent)
        if lineage is not None:
            parent = full_name(Path(lineage.parent_dir))
            names[parent][lineage.checkpoint] = f"cloned to {full_name(file.parent)}"
    return names


def _spare_checkpoints(run: Path, pins: set[str]) -> tuple[Path, ...]:
    """Return the checkpoints that are neither best nor last nor pinned."""
    folder = run / CHECKPOINTS
    if not _is_folder(folder):
        return ()
    needed = {*LINKS, *pins, *(path.readlink().name for path in folder.iterdir() if path.is_symlink())}
    return tuple(path for path in reversed(kept_checkpoints(folder)) if path.name not in needed)


def _in_progress(run: Path) -> str | None:
    if is_held(run):
        return "a training is running in it"
    if (run / SUMMARY).exists():
        return None
    newest = max(path.lstat().st_mtime for path in (run, *run.iterdir(), *(run / CHECKPOINTS).glob("*")))
    idle_s = time.time() - newest
    return f"has not ended and changed {idle_s / 60:.0f} minutes ago" if idle_s < _IDLE_S else None


def _is_folder(path: Path) -> bool:
    """Return whether it is a folder and not a link, whose target may belong to something else."""
    return path.is_dir() and not path.is_symlink()


def _size(folder: Path) -> int:
    """Return the bytes of all files below, without following links."""
    files = (Path(below, name) for below, _, names in os.walk(folder) for name in names)
    return sum(file.lstat().st_size for file in files)
