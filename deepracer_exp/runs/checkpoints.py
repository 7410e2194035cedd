"""Checkpoints of a run: tensors and JSON only, never a pickle, and never left incomplete."""

import contextlib
import logging
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.agents.algorithm import Algorithm
from deepracer_exp.agents.build import build_networks
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.errors import BadInput, RunFailed

from .checkpoint_files import (
    checkpoint_words,
    find_checkpoint,
    kept_checkpoints,
    pinned,
    restore_links,
    write_hashes,
)
from .components import State, check_folder, load_component, one_line
from .run_files import CHECKPOINTS, REPLAY

logger = logging.getLogger("deepracer_exp")

AGENT, TRAINING = "agent", "training"
"""Components: the networks with their algorithm, and the further state of a resumed training."""
_NO_RESUME = "a training cannot resume from it"


@dataclass(frozen=True, eq=False)
class StoredPolicy:
    """The networks of a checkpoint."""

    networks: PolicyNetworks
    path: Path
    """The checkpoint's folder itself, not a link to it."""
    counters: dict[str, Any]
    """Iteration, env steps and the like at which it was saved."""


def networks_of(experiment: Experiment, generator: torch.Generator | None) -> PolicyNetworks:
    """Build the networks of an experiment; the generator and errors are as for `build_actor_critic`."""
    return build_networks(
        experiment.network,
        experiment.algorithm,
        observation_shape(experiment.observation),
        build_action_space(experiment.action_space).n,
        generator,
    )


def read_checkpoint(experiment: Experiment, folder: Path, name: str) -> StoredPolicy:
    """Read the networks of a checkpoint, or of the newest intact one if one of `LINKS` is corrupt.

    `folder` and `name` are as for `find_checkpoint`.

    Raises:
        BadInput: as for `intact_checkpoint` and `read_policy`.
    """
    return read_policy(experiment, intact_checkpoint(folder, name))


def intact_checkpoint(folder: Path, name: str, *, resumable: bool = False) -> Path:
    """Return the folder of a checkpoint whose files all match their hashes.

    If one of `LINKS` is corrupt, or `last` is missing, the newest intact checkpoint is used, with a warning. With
    `resumable`, it is one that a training can resume from; `folder` and `name` are as for `find_checkpoint`.

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
            logger.warning(
                "checkpoint=%s: %s; using %s, the newest intact one", name, why, checkpoint_words(fault.name)
            )
        return fault
    raise BadInput(f"checkpoint={name}", f"{'; '.join(reasons[:3])}; no checkpoint in {folder} is intact")


def check(path: Path, *, resumable: bool = False) -> Path:
    """Return the resolved folder of an intact checkpoint; with `resumable`, one that a training can resume from.

    Raises:
        BadInput: any other.
    """
    path, components = check_folder(path, (AGENT,), (AGENT, TRAINING))
    if resumable and TRAINING not in components:
        raise BadInput(path, "contains only the policy, so a training cannot resume from it")
    return path


def read_policy(experiment: Experiment, path: Path) -> StoredPolicy:
    """Read the networks of a checkpoint that `check` has accepted.

    Raises:
        BadInput: it does not fit the experiment, or a weight is not finite.
    """
    networks = networks_of(experiment, torch.Generator())
    stored, problem = State({}), "does not fit the run's config.yaml"
    counters = load_component(path, AGENT, stored, problem)
    try:
        networks.load_state_dict(stored.values["networks"])
    except (KeyError, RuntimeError) as error:
        raise BadInput(path, f"{problem}: {one_line(error)}") from error
    for key, value in networks.state_dict().items():
        if not torch.isfinite(value).all():
            raise BadInput(path, f"{key} is not finite; choose another checkpoint")
    return StoredPolicy(networks, path, counters)


def read_agent(path: Path, agent: Algorithm) -> None:
    """Give an agent the networks, optimizer, schedule and replay of a checkpoint that `check` has accepted.

    Raises:
        BadInput: it does not fit, or its replay is missing or corrupt.
    """
    load_component(path, AGENT, agent, "cannot be used")
    if agent.replay is None:
        return
    replay = path.parent.parent / REPLAY / path.name
    if not replay.is_dir():
        raise BadInput(
            replay,
            "the replay of this checkpoint is not there; restore it, or start a new run from the checkpoint with "
            "`deepracer-exp clone`",
        )
    check_folder(replay, (REPLAY,), (REPLAY,))
    load_component(replay, REPLAY, agent.replay, _NO_RESUME)


def read_training(path: Path) -> dict[str, Any]:
    """Return the `training` that `CheckpointStore.save` has stored.

    `path` is a checkpoint that `check` has accepted.

    Raises:
        BadInput: there is none, or it cannot be read.
    """
    state = State({})
    load_component(path, TRAINING, state, _NO_RESUME)
    return dict(state.values)


class CheckpointStore:
    """`checkpoints/` of a run folder: one directory per kept iteration, and the links of `LINKS`.

    A directory is written aside with the hashes of its files and moved into place whole (torchrl.checkpoint: tensors
    and JSON, no pickle); a link changes in one step, and older checkpoints are removed after that. So whenever the run
    is killed, all names lead to a complete checkpoint.

    The replay of an agent that has one is large, and kept of `last` and of the checkpoint before it alone: in `replay/`
    of the run folder, under the checkpoint's name, written in the same way before the checkpoint.
    """

    def __init__(self, run_dir: Path, keep: int, every: int | None = None):
        """Open the folder, make it if there is none, and remove the unfinished files of a killed process.

        `keep` of the newest checkpoints stay. With `every` iterations between two evaluations only evaluated
        checkpoints stay, so that all of them can be compared at the end; None: there are no evaluations, and any
        checkpoint stays.

        Raises:
            BadInput: it is not known which checkpoints must stay.
            OSError: the folder cannot be written.
        """
        self.folder = run_dir / CHECKPOINTS
        self.folder.mkdir(exist_ok=True)
        self._keep, self._every = keep, every or 1
        self._replays = run_dir / REPLAY
        for path in (*self.folder.glob(".*"), *self._replays.glob(".*")):
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
        fastest: bool = False,
    ) -> None:
        """Save the agent under the number of its iteration.

        `training` is the further state of a resumed training: tensors, arrays and JSON types; None: no training can
        resume from here, and the checkpoint is not `last`. `best`: it is the best so far; `fastest`: it laps fastest of
        the reliable ones.

        Raises:
            OSError, RunFailed: the folder cannot be written; what was there before is unchanged.
        """
        name = checkpoint_name(counters["iteration"])
        components: dict[str, Any] = {AGENT: agent}
        if training is not None:
            components[TRAINING] = State(training)
            if agent.replay is not None:
                _write(self._replays / name, {REPLAY: agent.replay}, counters)
        _write(self.folder / name, components, counters)
        self.mark(counters["iteration"], best=best, fastest=fastest)
        if training is not None:
            self._link("last", name)
        self._prune()
        if training is not None:
            self._drop_replays(name)

    def mark(self, iteration: int, *, best: bool = False, fastest: bool = False) -> None:
        """Let `best` and `fastest` lead to an iteration's checkpoint, if it is.

        The checkpoints before stay until the next is saved: a resumed run may go back to them.
        """
        for label, is_so in (("best", best), ("fastest", fastest)):
            if is_so:
                self._link(label, checkpoint_name(iteration))

    def rewind(self, iteration: int, best: int | None, fastest: int | None = None) -> None:
        """Go back to an iteration: `last` is its checkpoint, and later ones are removed unless pinned.

        `best` is the iteration of the best checkpoint up to there, `fastest` that of the one which laps fastest of the
        reliable ones; None if there was none.
        """
        pins = pinned(self.folder)
        for path in self._numbered():
            if int(path.name) > iteration and path.name not in pins:
                _remove(path)
        for label, number in (("last", iteration), ("best", best), ("fastest", fastest)):
            if number is not None and (self.folder / checkpoint_name(number)).is_dir():
                self._link(label, checkpoint_name(number))
            else:
                (self.folder / label).unlink(missing_ok=True)
        self._drop_replays(checkpoint_name(iteration))

    def _drop_replays(self, last: str) -> None:
        """Remove all replays except those of the checkpoint `last` and of its substitute if `last` is corrupt."""
        kept = [path.name for path in self._numbered() if path.name <= last][-2:]
        for path in self._replays.glob("*"):
            if path.name not in kept:
                _remove(path)

    def _link(self, label: str, name: str) -> None:
        aside = self.folder / f".{label}"
        aside.unlink(missing_ok=True)
        aside.symlink_to(name, target_is_directory=True)
        aside.replace(self.folder / label)

    def _prune(self) -> None:
        numbered = self._numbered()
        kept = {str(path.readlink()) for path in self.folder.iterdir() if path.is_symlink()}
        # The checkpoint of the start is of no use once there is another.
        evaluated = [path.name for path in numbered if int(path.name) and int(path.name) % self._every == 0]
        kept |= {*evaluated[-self._keep :]} | pinned(self.folder).keys()
        for path in numbered:
            if path.name not in kept:
                _remove(path)

    def _numbered(self) -> list[Path]:
        """Return the checkpoints, the oldest first."""
        folders = (path for path in self.folder.iterdir() if path.name.isdigit() and path.is_dir())
        return sorted(folders, key=lambda path: int(path.name))


def _write(path: Path, components: Mapping[str, Any], counters: Mapping[str, Any]) -> None:
    """Write a folder of components, unless it is there: nothing is learned between two updates."""
    if path.exists():
        return
    checkpoint = Checkpoint()
    for name, component in components.items():
        # Memory-mapped tensors, the default, would end the process by SIGBUS on a full disk.
        checkpoint.register(name, component, adapter=StateDictCheckpointAdapter("archive"))
    aside = path.with_name(f".{path.name}")
    try:
        path.parent.mkdir(exist_ok=True)
        checkpoint.save(aside, metadata=dict(counters))
        write_hashes(aside)
        aside.rename(path)
    except (RuntimeError, OSError) as error:  # RuntimeError: torch's, for a full disk
        with contextlib.suppress(OSError):
            _remove(aside)
        reason = str(error).splitlines()[0]
        raise RunFailed(f"{path}: the checkpoint cannot be written: {reason}") from error


def checkpoint_name(iteration: int) -> str:
    """Return the name of the folder of an iteration's checkpoint."""
    return f"{iteration:06d}"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
