"""Read checkpoints safely: tensors and JSON only, never a pickle, never an incomplete one."""

import logging
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
from deepracer_exp.runs.checkpoint_files import HASHES, find_checkpoint, kept_checkpoints, verify

logger = logging.getLogger("deepracer_exp")

_AGENT, _TRAINING = "agent", "training"
_MANIFEST = "manifest.json"
_STATE = {"state.json", "state.tdz"}
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
    """Read the networks of a checkpoint, or of the newest intact one if `best` or `last` is corrupt.

    Args:
        experiment: of the run.
        folder: `checkpoints/` of its run.
        name: `best`, `last` or the number of an iteration.

    Raises:
        BadInput: as for `intact_checkpoint` and `read_policy`.
    """
    return read_policy(experiment, intact_checkpoint(folder, name))


def intact_checkpoint(folder: Path, name: str, *, resumable: bool = False) -> Path:
    """Return the folder of a checkpoint whose files all match their hashes.

    If `best` or `last` is corrupt, or `last` is missing, the newest intact checkpoint is used, with a warning.

    Args:
        folder: `checkpoints/` of a run.
        name: `best`, `last` or the number of an iteration.
        resumable: require one that a training can resume from.

    Raises:
        BadInput: there is no such checkpoint, it lies elsewhere, or it is corrupt and so are all others. Files that
            could contain a pickle are rejected unread.
    """
    path, kept = find_checkpoint(folder, name), kept_checkpoints(folder)
    try:
        return check(path, resumable=resumable)
    except BadInput as error:
        if name.isdecimal():
            raise
        reasons = [str(error)]
    for other in kept:
        if path.exists() and other.samefile(path):
            continue
        try:
            found = check(other, resumable=resumable)
        except BadInput as error:
            reasons.append(str(error))
            continue
        logger.warning(
            "checkpoint=%s: %s; using %s, the newest intact one",
            name,
            "; ".join(reasons),
            other.name,
        )
        return found
    raise BadInput(f"checkpoint={name}: {'; '.join(reasons[:3])}; no checkpoint in {folder} is intact")


def check(path: Path, *, resumable: bool = False) -> Path:
    """Return the resolved folder of an intact checkpoint; with `resumable`, one that a training can resume from.

    Raises:
        BadInput: any other.
    """
    if not path.is_dir():
        what = (
            "is a broken link"
            if path.is_symlink()
            else "is not a folder"
            if path.exists()
            else "does not exist"
        )
        raise BadInput(f"{path}: {what}; a pickle is never loaded")
    path = path.resolve()
    entries = list(path.rglob("*"))
    links = [entry for entry in entries if entry.is_symlink()]
    if links:
        raise BadInput(f"{links[0]}: is a link; the files of a checkpoint must be in its own folder")
    files = {file.name: file for file in entries if not file.is_dir()}
    foreign = sorted(files.keys() - _STATE - {_MANIFEST, HASHES})
    if foreign:
        raise BadInput(
            f"{path}: contains {foreign[0]}; accepted: the tensors and JSON files of a checkpoint; a pickle is "
            "never loaded"
        )
    if _MANIFEST not in files:
        raise BadInput(f"{path}: incomplete: has no {_MANIFEST}")
    if HASHES not in files:
        raise BadInput(
            f"{path}: has no {HASHES}: incomplete, or written by an older version, whose checkpoints cannot be used"
        )
    verify(path)
    try:
        components = Checkpoint.manifest(path)["components"]
    except (CheckpointError, OSError, TypeError, AttributeError, ValueError) as error:
        raise BadInput(
            f"{path}: not a checkpoint of deepracer-exp: {' '.join(str(error).split())}"
        ) from error
    if _AGENT not in components or not components.keys() <= {_AGENT, _TRAINING}:
        raise BadInput(
            f"{path}: not a checkpoint of deepracer-exp: holds {', '.join(components) or 'nothing'}"
        )
    for name, record in components.items():
        folder = path / record["path"]  # torchrl lets no absolute path and no `..` pass
        there = {file.name for file in folder.iterdir()} if folder.is_dir() else set()
        if record["adapter"] != StateDictCheckpointAdapter.adapter_id or there != _STATE:
            raise BadInput(
                f"{path}: not a checkpoint of deepracer-exp: {name} is not {' and '.join(sorted(_STATE))}"
            )
        _check_archive(folder / "state.tdz")
    if resumable and _TRAINING not in components:
        raise BadInput(f"{path}: contains only the policy, so a training cannot resume from it")
    return path


def read_policy(experiment: Experiment, path: Path) -> StoredPolicy:
    """Read the networks of a checkpoint that `check` has accepted.

    Raises:
        BadInput: it does not fit the experiment, or a weight is not finite.
    """
    networks = build_actor_critic(
        experiment.network,
        len(feature_names(experiment.observation)),
        build_action_space(experiment.action_space).n,
        torch.Generator(),
    )
    target = Checkpoint().register(
        _AGENT, _NetworksOf(networks), adapter=StateDictCheckpointAdapter("archive")
    )
    try:
        found = target.load(path)
    except (CheckpointError, OSError) as error:
        reason = " ".join(str(error).split())
        raise BadInput(f"{path}: does not fit the run's config.yaml: {reason[:300]}") from error
    for key, value in networks.state_dict().items():
        if not torch.isfinite(value).all():
            raise BadInput(f"{path}: {key} is not finite; choose another checkpoint")
    return StoredPolicy(networks, path, found.manifest["metadata"])


class _NetworksOf:
    """Loads the networks of an agent's state and skips the optimizer."""

    def __init__(self, networks: ActorCritic):
        self._networks = networks

    def state_dict(self) -> dict[str, Any]:
        return {"networks": self._networks.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._networks.load_state_dict(state["networks"])


def _check_archive(file: Path) -> None:
    """Refuse an archive with anything but tensors."""
    try:
        with zipfile.ZipFile(file) as archive:
            foreign = [name for name in archive.namelist() if not _MEMBER.fullmatch(name)]
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise BadInput(f"{file}: corrupt: {error}") from error
    if foreign:
        raise BadInput(f"{file}: contains {foreign[0]}, which is not a tensor; a pickle is never loaded")
