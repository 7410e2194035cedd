"""Checkpoints read back: tensors and JSON only, and nothing of a file that is not whole."""

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from deepracer_exp.agents.actor_critic import ActorCritic, build_actor_critic
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import feature_names
from deepracer_exp.errors import BadInput

_COMPONENT = "agent"
_FILES = {"state.json", "state.tdz"}
_MEMBER = re.compile(r"meta\.json|tensor_\d+\.memmap")


@dataclass(frozen=True, eq=False)
class StoredPolicy:
    """The networks of a checkpoint."""

    networks: ActorCritic
    path: Path
    """Its own folder, not a link to it."""
    counters: dict[str, Any]
    """Iteration, env steps and the like at which it was saved."""


def read_checkpoint(experiment: Experiment, folder: Path, name: str) -> StoredPolicy:
    """Read the networks of a checkpoint.

    Args:
        experiment: what was trained.
        folder: `checkpoints/` of its run.
        name: `best`, `last` or the number of an iteration.

    Raises:
        BadInput: there is no such checkpoint, it is torn, of another kind, or does not fit the experiment. Whatever
            could hold a pickle is refused unread.
    """
    path = folder / (f"{int(name):06d}" if name.isdigit() else name)
    if not path.is_dir():
        known = ", ".join(checkpoint_names(folder)) or "none"
        what = "no folder" if path.exists() else "not there"
        raise BadInput(f"checkpoint={name}: {path} is {what}; a pickle is never loaded; checkpoints: {known}")
    path = path.resolve()
    manifest = _check(path)
    networks = build_actor_critic(
        experiment.network,
        len(feature_names(experiment.observation)),
        build_action_space(experiment.action_space).n,
        torch.Generator(),
    )
    target = Checkpoint().register(
        _COMPONENT, _NetworksOf(networks), adapter=StateDictCheckpointAdapter("archive")
    )
    try:
        target.load(path)
    except (CheckpointError, OSError) as error:
        reason = " ".join(str(error).split())
        raise BadInput(
            f"{path}: does not fit the run's config.yaml, or is torn: {reason[:300]}; choose another checkpoint"
        ) from error
    for key, value in networks.state_dict().items():
        if not torch.isfinite(value).all():
            raise BadInput(f"{path}: {key} is not finite; choose another checkpoint")
    return StoredPolicy(networks, path, manifest["metadata"])


def checkpoint_names(folder: Path) -> list[str]:
    """Return what a run has kept, `best` and `last` first."""
    if not folder.is_dir():
        return []
    found = [path.name for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    return sorted(found, key=lambda name: (name.isdigit(), name))


class _NetworksOf:
    """Takes the networks out of an agent's state and leaves the optimizer behind."""

    def __init__(self, networks: ActorCritic):
        self._networks = networks

    def state_dict(self) -> dict[str, Any]:
        return {"networks": self._networks.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._networks.load_state_dict(state["networks"])


def _check(path: Path) -> dict[str, Any]:
    """Return the manifest of a whole checkpoint of ours; refuse any other."""
    try:
        manifest: dict[str, Any] = Checkpoint.manifest(path)
    except FileNotFoundError:
        raise BadInput(
            f"{path}: has no manifest.json, so it is no whole checkpoint of ours; a pickle is never loaded"
        ) from None
    except (CheckpointError, OSError, TypeError, AttributeError, ValueError) as error:
        raise BadInput(f"{path}: torn: manifest.json: {' '.join(str(error).split())}") from error
    record = manifest["components"].get(_COMPONENT)
    folder = path / record["path"] if record else path
    there = {entry.name for entry in folder.iterdir()} if record and folder.is_dir() else set()
    if not record or record["adapter"] != StateDictCheckpointAdapter.adapter_id or there - _FILES:
        raise BadInput(
            f"{path}: no checkpoint of ours ({', '.join(sorted(there - _FILES)) or 'no agent'}); wanted are tensors "
            f"and JSON, {' and '.join(sorted(_FILES))}; a pickle is never loaded"
        )
    if there != _FILES:
        raise BadInput(
            f"{path}: torn: {', '.join(sorted(_FILES - there))} is missing; choose another checkpoint"
        )
    _check_archive(folder / "state.tdz")
    return manifest


def _check_archive(file: Path) -> None:
    """Refuse an archive with a damaged tensor (each has a checksum), or with anything but tensors."""
    try:
        with zipfile.ZipFile(file) as archive:
            foreign = [name for name in archive.namelist() if not _MEMBER.fullmatch(name)]
            if foreign:
                raise BadInput(f"{file}: holds {foreign[0]}, which is no tensor; a pickle is never loaded")
            damaged = archive.testzip()
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise BadInput(f"{file}: torn: {error}; choose another checkpoint") from error
    if damaged is not None:
        raise BadInput(f"{file}: torn: checksum of {damaged} is wrong; choose another checkpoint")
