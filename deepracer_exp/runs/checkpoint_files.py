"""Files beside the tensors of checkpoints: hashes of the files, and the pins of checkpoints that must stay."""

import hashlib
import json
import re
import shutil
from contextlib import suppress
from pathlib import Path

from pydantic import TypeAdapter

from deepracer_exp.errors import BadInput
from deepracer_exp.files import LOG_BYTES, atomic_write, open_user_file, read_json, read_json_as, read_text

from .run_files import WRITTEN

HASHES = "hashes.json"
MANIFEST = "manifest.json"
BEST = "best"
LINKS = (BEST, "last", "fastest")
"""Names of the best checkpoint, the last one, and the fastest reliable one."""
_CLONED = "cloned into "
"""Beginning of the reason of a pin for a clone, before its folder."""
_PINNED = "pinned.json"
_PINS = TypeAdapter(dict[str, list[str]])


def write_hashes(folder: Path) -> None:
    """Write the SHA-256 of every file of a checkpoint into `hashes.json` beside them."""
    hashes = {path: _sha256(folder / path) for path in _files(folder)}
    (folder / HASHES).write_text(json.dumps(hashes, indent=1) + "\n", encoding="utf-8")


def verify(folder: Path) -> None:
    """Compare a checkpoint's files with its `hashes.json`.

    Raises:
        BadInput: a file is missing, was added or changed, or cannot be read.
    """
    try:
        wanted = dict(read_json(folder / HASHES, WRITTEN))
        hashes = {path: _sha256(folder / path) for path in _files(folder)}
    except (OSError, ValueError, TypeError) as error:
        raise BadInput(folder, f"corrupt: {folder / HASHES} cannot be used: {error}") from error
    if hashes != wanted:
        changed = sorted(set(hashes.items()) ^ set(wanted.items()))
        raise BadInput(folder, f"corrupt: {changed[0][0]} is not as it was written")


def restore_links(folder: Path) -> None:
    """Restore the links `LINKS` where a copy has replaced them by folders or text.

    `cp -rL`, object stores and archives without links turn each into a second copy of its checkpoint. A folder that
    cannot be written stays as it is, and so does a copy that equals no checkpoint of another name.
    """
    for label in LINKS:
        path = folder / label
        if path.is_symlink() or not path.exists():
            continue
        with suppress(OSError, ValueError, KeyError, TypeError):
            if path.is_file():
                name = read_text(path, WRITTEN)
            else:
                manifest = read_json(path / MANIFEST, WRITTEN)
                name = f"{int(manifest['metadata']['iteration']):06d}"
            if not re.fullmatch(r"\d{6,9}", name):
                continue
            if path.is_file():
                path.unlink()
            elif not (folder / name).exists():
                path.rename(folder / name)
            elif checkpoint_sha256(path) == checkpoint_sha256(folder / name):
                shutil.rmtree(path)
            else:
                continue
            path.symlink_to(name, target_is_directory=True)


def checkpoint_words(name: str) -> str:
    """Return the display name of the checkpoint in a folder of this name: ``checkpoint 8`` for ``000008``."""
    return f"checkpoint {checkpoint_number(name)}"


def checkpoint_number(name: str) -> str:
    """Return the value of `checkpoint=` for a folder of this name: ``8`` for ``000008``, ``best`` for ``best``."""
    return str(int(name)) if name.isdecimal() else name


def find_checkpoint(folder: Path, name: str) -> Path:
    """Return the folder of a checkpoint, or the link to it; it may be a missing `last` if there are other checkpoints.

    `folder` is `checkpoints/` of a run, `name` is one of `LINKS` or the number of an iteration.

    Raises:
        BadInput: there is no such checkpoint, or it lies elsewhere.
    """
    if name not in LINKS and not re.fullmatch(r"\d{1,9}", name):
        raise BadInput(
            f"checkpoint={name}", f"a checkpoint is {', '.join(LINKS)} or the number of an iteration"
        )
    restore_links(folder)
    path = folder / (f"{int(name):06d}" if name.isdecimal() else name)
    kept = kept_checkpoints(folder)
    if not (path.exists() or path.is_symlink() or (name == "last" and kept)):
        accepted = ", ".join(
            [
                *(link for link in LINKS if (folder / link).is_symlink()),
                *(checkpoint_number(p.name) for p in kept),
            ]
        )
        raise BadInput(f"checkpoint={name}", f"{path} is not there; checkpoints: {accepted or 'none'}")
    if path.exists() and path.resolve().parent != folder.resolve():
        raise BadInput(
            f"checkpoint={name}", f"{path} leads out of its folder to {path.resolve()}; give a number"
        )
    return path


def kept_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a run, not the links to them, newest first."""
    if not folder.is_dir():
        return []
    folders = [path for path in folder.iterdir() if path.is_dir() and not path.is_symlink()]
    # `best` is a real folder in a copy that cannot be written, see `restore_links`.
    named = [path for path in folders if path.name.isdecimal() or path.name in LINKS]
    return sorted(named, key=lambda path: int(path.name) if path.name.isdecimal() else -1, reverse=True)


def checkpoint_sha256(folder: Path) -> str:
    """Return one hash for all files of a checkpoint: that of its `hashes.json`."""
    return _sha256(folder / HASHES)


def pin_for_clone(checkpoints: Path, name: str, clone: Path) -> None:
    """Pin a checkpoint as long as the folder of its clone is there; the rest is as for `pin`."""
    pin(checkpoints, name, f"{_CLONED}{clone.resolve()}")


def pin(checkpoints: Path, name: str, why: str) -> None:
    """Pin a checkpoint, so that it stays.

    `name` is that of its own folder in `checkpoints/` of its run, e.g. ``000120``; `runs clean` shows `why`.
    """
    pins = pinned(checkpoints)
    if why in pins.setdefault(name, []):
        return
    pins[name].append(why)
    atomic_write(checkpoints / _PINNED, json.dumps(pins, indent=1) + "\n")


def pinned(checkpoints: Path) -> dict[str, list[str]]:
    """Return the pinned checkpoints, with the reasons.

    Raises:
        BadInput: their file cannot be read.
    """
    try:
        pins = read_json_as(checkpoints / _PINNED, _PINS, "a clone or `runs promote`") or {}
    except BadInput as error:
        raise BadInput(f"{error}; nothing in {checkpoints} is removed") from error
    kept = {name: [why for why in reasons if not _is_over(why)] for name, reasons in pins.items()}
    return {name: reasons for name, reasons in kept.items() if reasons}


def _is_over(why: str) -> bool:
    clone = Path(why.removeprefix(_CLONED))
    return why.startswith(_CLONED) and clone.is_absolute() and not clone.exists()


def _files(folder: Path) -> list[str]:
    files = (path for path in folder.rglob("*") if not path.is_dir())
    return sorted(path.relative_to(folder).as_posix() for path in files if path != folder / HASHES)


def _sha256(file: Path) -> str:
    with open_user_file(file, WRITTEN, LOG_BYTES) as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
