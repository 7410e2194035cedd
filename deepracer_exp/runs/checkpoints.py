"""Checkpoints of a run, kept and read safely: tensors and JSON only, never a pickle, never an incomplete one."""

import contextlib
import logging
import re
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from deepracer_exp.agents.actor_critic import ActorCritic, build_actor_critic
from deepracer_exp.agents.ppo import Algorithm
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.errors import BadInput, RunFailed

from .checkpoint_files import (
    HASHES,
    MANIFEST,
    find_checkpoint,
    kept_checkpoints,
    pinned,
    restore_links,
    verify,
    write_hashes,
)
from .files import CHECKPOINTS

logger = logging.getLogger("deepracer_exp")

AGENT, TRAINING = "agent", "training"
"""Components: the networks with what improves them, and what a resumed training needs besides."""
_STATE = {"state.json", "state.tdz"}
_MOST_BYTES = 2**32
"""Limit for a checkpoint; the largest known have tens of megabytes."""
_MEMBER = re.compile(r"meta\.json|tensor_\d+\.memmap")


@dataclass(frozen=True, eq=False)
class StoredPolicy:
    """The networks of a checkpoint."""

    networks: ActorCritic
    path: Path
    """The checkpoint's folder itself, not a link to it."""
    counters: dict[str, Any]
    """Iteration, env steps and the like at which it was saved."""


def read_checkpoint(experiment: Experiment, folder: Path, name: str) -> StoredPolicy:
    """Read the networks of a checkpoint, or of the newest intact one if `best` or `last` is corrupt.

    `folder` and `name` as of `find_checkpoint`.

    Raises:
        BadInput: as for `intact_checkpoint` and `read_policy`.
    """
    return read_policy(experiment, intact_checkpoint(folder, name))


def intact_checkpoint(folder: Path, name: str, *, resumable: bool = False) -> Path:
    """Return the folder of a checkpoint whose files all match their hashes.

    If `best` or `last` is corrupt, or `last` is missing, the newest intact checkpoint is used, with a warning. With
    `resumable`, it is one that a training can resume from; `folder` and `name` as of `find_checkpoint`.

    Raises:
        BadInput: there is no such checkpoint, it lies elsewhere, or it is corrupt and so are all others. Files that
            could contain a pickle are rejected unread.
    """
    path, reasons = find_checkpoint(folder, name), list[str]()
    others = [] if name.isdecimal() else kept_checkpoints(folder)
    for candidate in (path, *others):
        if candidate is not path and path.exists() and candidate.samefile(path):
            continue
        try:
            fault = check(candidate, resumable=resumable)
        except BadInput as error:
            if name.isdecimal():
                raise
            reasons.append(str(error))
            continue
        if reasons:
            why = "; ".join(reasons)
            logger.warning("checkpoint=%s: %s; using %s, the newest intact one", name, why, fault.name)
        return fault
    raise BadInput(f"checkpoint={name}", f"{'; '.join(reasons[:3])}; no checkpoint in {folder} is intact")


def check(path: Path, *, resumable: bool = False) -> Path:
    """Return the resolved folder of an intact checkpoint; with `resumable`, one that a training can resume from.

    Raises:
        BadInput: any other.
    """
    if not path.is_dir():
        kind = "a broken link" if path.is_symlink() else "no folder"
        raise BadInput(path, f"is {kind}; a pickle is never loaded")
    path = path.resolve()
    entries = list(path.rglob("*"))
    links = [entry for entry in entries if entry.is_symlink()]
    if links:
        raise BadInput(links[0], "is a link; the files of a checkpoint must be in its own folder")
    files = {file.name for file in entries if not file.is_dir()}
    foreign = sorted(files - _STATE - {MANIFEST, HASHES})
    if foreign:
        raise BadInput(
            path,
            f"contains {foreign[0]}",
            "the tensors and JSON files of a checkpoint; a pickle is never loaded",
        )
    if (total := sum(entry.stat().st_size for entry in entries)) > _MOST_BYTES:
        raise BadInput(path, f"has {total:,} bytes", f"up to {_MOST_BYTES // 2**30} GiB")
    for name in (MANIFEST, HASHES):
        if name not in files:
            raise BadInput(path, f"has no {name}: incomplete")
    verify(path)
    try:
        components = Checkpoint.manifest(path)["components"]
    except (CheckpointError, OSError, TypeError, AttributeError, ValueError) as error:
        raise BadInput(path, f"not a checkpoint of deepracer-exp: {_one_line(error)}") from error
    if AGENT not in components or not components.keys() <= {AGENT, TRAINING}:
        held = ", ".join(components) or "nothing"
        raise BadInput(path, f"not a checkpoint of deepracer-exp: holds {held}")
    for name, record in components.items():
        folder = path / record["path"]  # torchrl lets no absolute path and no `..` pass
        there = {file.name for file in folder.iterdir()} if folder.is_dir() else set()
        if record["adapter"] != StateDictCheckpointAdapter.adapter_id or there != _STATE:
            parts = " and ".join(sorted(_STATE))
            raise BadInput(path, f"not a checkpoint of deepracer-exp: {name} is not {parts}")
        _check_archive(folder / "state.tdz")
    if resumable and TRAINING not in components:
        raise BadInput(path, "contains only the policy, so a training cannot resume from it")
    return path


def read_policy(experiment: Experiment, path: Path) -> StoredPolicy:
    """Read the networks of a checkpoint that `check` has accepted.

    Raises:
        BadInput: it does not fit the experiment, or a weight is not finite.
    """
    networks = build_actor_critic(
        experiment.network,
        observation_shape(experiment.observation),
        build_action_space(experiment.action_space).n,
        torch.Generator(),
    )
    stored, problem = State({}), "does not fit the run's config.yaml"
    counters = _load(path, AGENT, stored, problem)
    try:
        networks.load_state_dict(stored.values["networks"])
    except (KeyError, RuntimeError) as error:
        raise BadInput(path, f"{problem}: {_one_line(error)}") from error
    for key, value in networks.state_dict().items():
        if not torch.isfinite(value).all():
            raise BadInput(path, f"{key} is not finite; choose another checkpoint")
    return StoredPolicy(networks, path, counters)


def read_agent(path: Path, agent: Algorithm) -> None:
    """Give an agent the networks, optimizer and schedule of a checkpoint that `check` has accepted.

    Raises:
        BadInput: it does not fit.
    """
    _load(path, AGENT, agent, "cannot be used")


def read_training(path: Path) -> dict[str, Any]:
    """Return what `CheckpointStore.save` was given as `training`.

    `path` is a checkpoint that `check` has accepted.

    Raises:
        BadInput: there is none, or it cannot be read.
    """
    state = State({})
    _load(path, TRAINING, state, "a training cannot resume from it")
    return dict(state.values)


class State:
    """Plain values as a component of a checkpoint."""

    def __init__(self, values: Mapping[str, Any]):
        self.values = values

    def state_dict(self) -> dict[str, Any]:
        """Return the values."""
        return dict(self.values)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Replace the values."""
        self.values = state


def _load(path: Path, component: str, target: Any, problem: str) -> dict[str, Any]:
    """Load a component into `target` and return the checkpoint's counters."""
    archive = Checkpoint().register(component, target, adapter=StateDictCheckpointAdapter("archive"))
    try:
        return dict(archive.load(path).manifest["metadata"])
    except (CheckpointError, OSError) as error:
        raise BadInput(path, f"{problem}: {_one_line(error)}") from error


def _check_archive(file: Path) -> None:
    """Refuse an archive with anything but tensors, or one that takes more memory than it has bytes."""
    size = file.stat().st_size
    try:
        with zipfile.ZipFile(file) as archive:
            foreign = [name for name in archive.namelist() if not _MEMBER.fullmatch(name)]
            unpacked = sum(member.file_size for member in archive.infolist())
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise BadInput(file, f"corrupt: {error}") from error
    if foreign:
        raise BadInput(file, f"contains {foreign[0]}, which is not a tensor; a pickle is never loaded")
    # Ours are not compressed, and no two tensors share bytes.
    if unpacked > size:
        raise BadInput(file, f"{size:,} bytes that unpack to {unpacked:,}", "tensors that are not compressed")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


class CheckpointStore:
    """`checkpoints/` of a run folder: one directory per kept iteration, and the links `best` and `last`.

    A directory is written aside with the hashes of its files and moved into place whole (torchrl.checkpoint: tensors
    and JSON, no pickle); a link changes in one step, and what is older is removed after that. So whenever the run is
    killed, both names lead to a complete checkpoint.
    """

    def __init__(self, run_dir: Path, keep: int, every: int | None = None):
        """Open the folder, make it if there is none, and clear away what a kill left unfinished.

        Args:
            run_dir: folder of the run.
            keep: how many of the newest checkpoints stay.
            every: iterations between two evaluations: only evaluated checkpoints stay, so that all of them can be
                compared at the end; None: there are no evaluations, and any checkpoint stays.

        Raises:
            BadInput: it is not known which checkpoints must stay.
            OSError: the folder cannot be written.
        """
        self.folder = run_dir / CHECKPOINTS
        self.folder.mkdir(exist_ok=True)
        self._keep, self._every = keep, every or 1
        for path in self.folder.glob(".*"):
            _remove(path)
        restore_links(self.folder)
        pinned(self.folder)

    def save(
        self,
        agent: Algorithm,
        counters: Mapping[str, Any],
        training: Mapping[str, Any] | None = None,
        *,
        best: bool = False,
    ) -> None:
        """Save the agent under the number of its iteration.

        Args:
            agent: networks, optimizer and schedule.
            counters: iteration, env steps and the like, JSON types.
            training: the rest of what a resumed training needs: tensors, arrays and JSON types; None: no training
                can resume from here, and the checkpoint is not `last`.
            best: it is the best so far.

        Raises:
            OSError, RunFailed: the folder cannot be written; what was there before is unchanged.
        """
        name = checkpoint_name(counters["iteration"])
        if not (self.folder / name).exists():  # nothing is learned between two updates
            self._write(name, agent, counters, training)
        if best:
            self._link("best", name)
        if training is not None:
            self._link("last", name)
        self._prune()

    def mark_best(self, iteration: int) -> None:
        """Let `best` lead to an iteration's checkpoint; the one before stays, for a resumed run, whose best it is."""
        self._link("best", checkpoint_name(iteration))

    def rewind(self, iteration: int, best: int | None) -> None:
        """Go back to an iteration: `last` is its checkpoint, and what came later goes, unless it must stay.

        `best` is the iteration of the best checkpoint up to there, None if there was none.
        """
        pins = pinned(self.folder)
        for path in self._numbered():
            if int(path.name) > iteration and path.name not in pins:
                _remove(path)
        for label, number in (("last", iteration), ("best", best)):
            if number is not None and (self.folder / checkpoint_name(number)).is_dir():
                self._link(label, checkpoint_name(number))
            else:
                (self.folder / label).unlink(missing_ok=True)

    def _write(
        self, name: str, agent: Algorithm, counters: Mapping[str, Any], training: Mapping[str, Any] | None
    ) -> None:
        # Memory-mapped tensors, the default, would end the process by SIGBUS on a full disk.
        archive = StateDictCheckpointAdapter("archive")
        checkpoint = Checkpoint().register(AGENT, agent, adapter=archive)
        if training is not None:
            checkpoint.register(TRAINING, State(training), adapter=archive)
        aside = self.folder / f".{name}"
        try:
            checkpoint.save(aside, metadata=dict(counters))
            write_hashes(aside)
            aside.rename(self.folder / name)
        except (RuntimeError, OSError) as error:  # RuntimeError: torch's, for a full disk
            with contextlib.suppress(OSError):
                _remove(aside)
            reason = str(error).splitlines()[0]
            raise RunFailed(f"{self.folder / name}: the checkpoint cannot be written: {reason}") from error

    def _link(self, label: str, name: str) -> None:
        aside = self.folder / f".{label}"
        aside.unlink(missing_ok=True)
        aside.symlink_to(name, target_is_directory=True)
        aside.replace(self.folder / label)

    def _prune(self) -> None:
        numbered = self._numbered()
        kept = {str(path.readlink()) for path in self.folder.iterdir() if path.is_symlink()}
        # That of the start is of no use once there is another.
        evaluated = [path.name for path in numbered if int(path.name) and int(path.name) % self._every == 0]
        kept |= {*evaluated[-self._keep :]} | pinned(self.folder).keys()
        for path in numbered:
            if path.name not in kept:
                _remove(path)

    def _numbered(self) -> list[Path]:
        """Return the checkpoints, the oldest first."""
        folders = (path for path in self.folder.iterdir() if path.name.isdigit() and path.is_dir())
        return sorted(folders, key=lambda path: int(path.name))


def checkpoint_name(iteration: int) -> str:
    """Return the name of the folder of an iteration's checkpoint."""
    return f"{iteration:06d}"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
