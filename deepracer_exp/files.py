"""User files read with limits (regular files only), and files written atomically."""

import contextlib
import json
import os
import stat
import uuid
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import yaml

from deepracer_exp.errors import BadInput, reading

if TYPE_CHECKING:
    from pydantic import TypeAdapter

Content = TypeVar("Content")

SETTINGS_BYTES = 2**20
"""Limit for a hand-written file: YAML, JSON, a reward function. A larger file is something else."""
ROUTE_BYTES = 2**21
"""Limit for a route: more than 40,000 rows, a hundred times the longest of the service."""
RECORD_BYTES = 2**30
"""Limit for a file that a training writes; metrics.jsonl has about 1 KB an iteration."""
LOG_BYTES = 2**32
"""Limit for a log or an archive, and for a file packed in it; the largest known logs have hundreds of megabytes."""

_MOST_VALUES = 100_000
_DEEPEST = 50

# The parser in C takes a seventh of the time, and an experiment has hundreds of runs.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def open_user_file(path: str | Path, accepted: str, most_bytes: int) -> BufferedReader:
    """Open a file for reading.

    `accepted` is for messages; a file of its kind can have `most_bytes`.

    Raises:
        BadInput: it is missing, not a regular file (a pipe or a device never ends), larger, or cannot be read.
    """
    with reading(path, accepted):
        return plain_file(path, accepted, most_bytes).open("rb")


def plain_file(path: str | Path, accepted: str, most_bytes: int) -> Path:
    """Return the path of a file that a library will open; arguments and errors as for `open_user_file`."""
    with reading(path, accepted):
        status = Path(path).stat()
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "no file")
        raise BadInput(path, f"is {kind}", accepted)
    _check_size(path, status.st_size, accepted, most_bytes)
    return Path(path)


def read_bytes(path: str | Path, accepted: str, most_bytes: int = SETTINGS_BYTES) -> bytes:
    """Return the bytes of a file; arguments and errors as for `open_user_file`."""
    with open_user_file(path, accepted, most_bytes) as file, reading(path, accepted):
        raw = file.read(most_bytes + 1)
    _check_size(path, len(raw), accepted, most_bytes)
    return raw


def read_text(path: str | Path, accepted: str, most_bytes: int = SETTINGS_BYTES) -> str:
    """Return the text of a file in UTF-8; arguments and errors as for `open_user_file`."""
    raw = read_bytes(path, accepted, most_bytes)
    with reading(path, accepted):
        # Editors on Windows put a byte order mark at the beginning.
        return raw.decode("utf-8-sig")


def read_json(path: str | Path, accepted: str, raw: bytes | None = None) -> Any:
    """Return the content of a JSON file.

    `raw` is its content where that is known: of a member of an archive, or a part of a log.

    Raises:
        BadInput: it cannot be read, is too large, or not JSON.
    """
    raw = read_bytes(path, accepted) if raw is None else raw
    _check_size(path, len(raw), accepted, SETTINGS_BYTES)
    with reading(path, accepted, "not JSON"):
        return json.loads(raw.decode("utf-8-sig"))


def read_yaml(
    path: str | Path, accepted: str, load: Callable[[str], Content] | None = None, raw: bytes | None = None
) -> Content | Any:
    """Return the content of a YAML file as plain values.

    `load` parses the text, None: into plain values; `raw` is as for `read_json`.

    Raises:
        BadInput: it cannot be read, is too large, not YAML, has aliases, or has more values or levels than a
            hand-written file.
    """
    raw = read_bytes(path, accepted) if raw is None else raw
    _check_size(path, len(raw), accepted, SETTINGS_BYTES)
    with reading(path, accepted, "not YAML"):
        text = raw.decode("utf-8-sig")
        _check_structure(path, text)
        return _LOADER(text).get_single_data() if load is None else load(text)


def read_json_as(file: Path, adapter: "TypeAdapter[Content]", writer: str) -> Content | None:
    """Read a JSON file whose keys and types are those of a dataclass; None where there is no file.

    `writer` names the writer of such files in messages: ``a clone``.

    Raises:
        BadInput: the file cannot be read or holds something else.
    """
    if not os.path.lexists(file):
        return None
    accepted = f"what {writer} writes there"
    return _validated(file, read_bytes(file, accepted), adapter, accepted)


def read_yaml_as(path: str | Path, adapter: "TypeAdapter[Content]", accepted: str) -> Content:
    """Read a YAML file whose keys and types are those of a dataclass.

    Raises:
        BadInput: the file cannot be read or holds something else.
    """
    content = read_yaml(path, accepted)
    with reading(path, accepted):
        raw = json.dumps(content).encode()
    return _validated(path, raw, adapter, accepted)


def _validated(path: str | Path, raw: bytes, adapter: "TypeAdapter[Content]", accepted: str) -> Content:
    from pydantic import ValidationError

    try:
        return adapter.validate_json(raw, strict=True, extra="forbid")
    except ValidationError as error:
        finding = error.errors(include_url=False)[0]
        where = "".join(f" {part}:" for part in finding["loc"])
        raise BadInput(f"{path}:{where} {finding['msg']}", accepted=accepted) from error


def atomic_write(path: Path, content: str | bytes) -> Path:
    """Write a file completely or not at all; of several processes that write it at once, the last one wins."""
    # Each process writes a temporary file of its own: a shared one could be moved away by another process.
    aside = path.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        aside.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
        return aside.replace(path)
    except BaseException:
        # A disk that refuses a file may refuse to delete one as well.
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
        raise


def _check_size(path: str | Path, size: int, accepted: str, most_bytes: int) -> None:
    if size > most_bytes:
        raise BadInput(path, f"is larger than {most_bytes // 2**20} MiB", accepted)


def _check_structure(path: str | Path, text: str) -> None:
    """Refuse files that would take forever to build, and aliases, of which a few lines stand for billions of values."""
    values = levels = 0
    for event in yaml.parse(text, _LOADER):
        if isinstance(event, yaml.AliasEvent):
            raise BadInput(path, f"has an alias, *{event.anchor}", "the value itself")
        values += isinstance(event, yaml.NodeEvent)
        levels += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if values > _MOST_VALUES or levels > _DEEPEST:
            raise BadInput(path, f"has more than {_MOST_VALUES:,} values or {_DEEPEST} levels")
