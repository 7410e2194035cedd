"""Folders of tensors and JSON, written by torchrl.checkpoint: checked before they are read, and never a pickle."""

import re
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from deepracer_exp.errors import BadInput
from deepracer_exp.files import LOG_BYTES, plain_file

from .checkpoint_files import HASHES, MANIFEST, verify

_STATE = {"state.json", "state.tdz"}
_MOST_BYTES = 2**32
"""Limit for a checkpoint; the largest known have tens of megabytes."""
_MEMBER = re.compile(r"meta\.json|tensor_\d+\.memmap")


def check_folder(
    path: Path, required: Collection[str], accepted: Collection[str]
) -> tuple[Path, Collection[str]]:
    """Return a folder, resolved, and the names of the components that it holds, once all its files match their hashes.

    `required` components must be there, and none but the `accepted` ones.

    Raises:
        BadInput: it is no such folder, or corrupt; files that could contain a pickle are rejected unread.
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
        raise BadInput(path, f"not a checkpoint of deepracer-exp: {one_line(error)}") from error
    if not set(required) <= components.keys() <= set(accepted):
        held = ", ".join(components) or "nothing"
        raise BadInput(path, f"not a checkpoint of deepracer-exp: holds {held}")
    for name, record in components.items():
        folder = path / record["path"]  # torchrl lets no absolute path and no `..` pass
        there = {file.name for file in folder.iterdir()} if folder.is_dir() else set()
        if record["adapter"] != StateDictCheckpointAdapter.adapter_id or there != _STATE:
            parts = " and ".join(sorted(_STATE))
            raise BadInput(path, f"not a checkpoint of deepracer-exp: {name} is not {parts}")
        _check_archive(folder / "state.tdz")
    return path, components


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


def load_component(path: Path, component: str, target: Any, problem: str) -> dict[str, Any]:
    """Load a component into `target`; return the checkpoint's counters.

    Raises:
        BadInput: it cannot be read or does not fit `target`; `problem` names the consequence.
    """
    archive = Checkpoint().register(component, target, adapter=StateDictCheckpointAdapter("archive"))
    try:
        return dict(archive.load(path).manifest["metadata"])
    except (CheckpointError, OSError) as error:
        raise BadInput(path, f"{problem}: {one_line(error)}") from error


def _check_archive(file: Path) -> None:
    """Refuse an archive with anything but tensors, or one that takes more memory than it has bytes."""
    size = file.stat().st_size
    try:
        with zipfile.ZipFile(plain_file(file, "tensors", LOG_BYTES)) as archive:
            foreign = [name for name in archive.namelist() if not _MEMBER.fullmatch(name)]
            unpacked = sum(member.file_size for member in archive.infolist())
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise BadInput(file, f"corrupt: {error}") from error
    if foreign:
        raise BadInput(file, f"contains {foreign[0]}, which is not a tensor; a pickle is never loaded")
    # Ours are not compressed, and no two tensors share bytes.
    if unpacked > size:
        raise BadInput(file, f"{size:,} bytes that unpack to {unpacked:,}", "tensors that are not compressed")


def one_line(error: Exception) -> str:
    """Return an error's message without line breaks, shortened."""
    return " ".join(str(error).split())[:300]
