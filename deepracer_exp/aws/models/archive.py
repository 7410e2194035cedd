"""A trained model as the AWS console, deepracer-for-cloud and deepracer-on-aws store it: a folder or an archive.

None of it is run or unpacked. Sizes are compared with limits before anything is read into memory.
"""

import json
import math
import os
import re
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from deepracer_exp.aws.archives import (
    READ_ERRORS,
    ZIP,
    Archive,
    ArchiveMember,
    members_of,
    natural,
    open_archive,
    open_member,
    reason_of,
)
from deepracer_exp.errors import BadInput
from deepracer_exp.files import LOG_BYTES, SETTINGS_BYTES, open_user_file

from .graph_def import GRAPH_BYTES, read_weights
from .protobuf import field
from .tf_checkpoint import (
    DATA,
    DATA_BYTES,
    INDEX,
    INDEX_BYTES,
    META,
    read_index,
    read_tensors,
    write_checkpoint,
)

Tensors = Mapping[str, npt.NDArray[np.float32]]

SMALL_FILES = ("model_metadata.json", "reward_function.py", "hyperparameters.json", "training_params.yaml")
"""Files of a model that are read besides its weights; of several, the one nearest to the top."""
CHECKPOINTS = "deepracer_checkpoints.json"
NEWEST = ".coach_checkpoint"
"""Beside the checkpoints: the names of the best and the last, and of the newest."""
_ACCEPTED = "a model's folder or archive (.tar.gz, .tar, .zip) with NAME.ckpt.index and its data file, or with model.pb"
_MOST_FILES = 100_000
_LOGS = re.compile(r"simtrace/.*\.csv$|\.log$")
_EMPTY_GRAPH = field(2, field(4, field(1, 27)))
"""A MetaGraphDef whose graph has no nodes; the service requires the file but does not use it to restore weights."""


class StoredModel(NamedTuple):
    """The weights of a model with the files beside them."""

    tensors: Tensors
    source: str
    """The file of the weights, for messages; a frozen graph has only the policy."""
    files: Mapping[str, bytes]
    """Contents by their names in SMALL_FILES."""
    has_logs: bool
    notes: tuple[str, ...]


class _Files:
    """The files of a folder or archive; refuses paths that lead out of it, and too many or too large files."""

    def __init__(self, path: str, opener: Callable[[str], IO[bytes]], most_bytes: float = LOG_BYTES) -> None:
        self.path, self._open, self._most_bytes = path, opener, most_bytes
        self.sizes: dict[str, int] = {}
        """Bytes of each file, by its path below the model's folder or archive."""
        self._given: dict[str, str] = {}
        """Names as they are in the archive, which `opener` takes."""
        self._total = 0

    def add(self, name: str, size: int) -> None:
        parts = PurePosixPath(name.replace("\\", "/"))
        if parts.is_absolute() or ".." in parts.parts or re.match(r"[A-Za-z]:", name):
            raise BadInput(self.path, f"{name}: leads out of the archive", _ACCEPTED)
        if parts.parts[:1] == ("__MACOSX",) or parts.name.startswith("._"):
            return  # what a Mac adds to its archives
        self._total += size
        if len(self.sizes) >= _MOST_FILES or self._total > self._most_bytes:
            raise BadInput(
                self.path, f"holds more than {_MOST_FILES:,} files or {LOG_BYTES // 2**30} GiB", _ACCEPTED
            )
        self.sizes[parts.as_posix()] = size
        self._given[parts.as_posix()] = name

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return a file's content.

        Raises:
            BadInput: it is larger than accepted, or incomplete.
        """
        size, where = self.sizes[name], f"{self.path}/{name}"
        if size > most_bytes:
            raise BadInput(where, f"has {size:,} bytes; such a file of a model has at most {most_bytes:,}")
        with self._open(self._given[name]) as file:
            raw = file.read(size + 1)
        if len(raw) != size:
            raise BadInput(where, f"has {len(raw):,} bytes and not {size:,}; copy it again")
        return raw


def read_model(path: str, checkpoint: str) -> StoredModel:
    """Read the weights of a model and the files beside them.

    `checkpoint` is `best` or `last`, of `deepracer_checkpoints.json`.

    Raises:
        BadInput: there is no such file, it is corrupt or larger than a model, or holds none or several.
    """
    try:
        with _opened(path) as files:
            return _read(files, checkpoint)
    except BadInput:
        raise
    except (*READ_ERRORS, ValueError) as error:
        reason = getattr(error, "strerror", None) or reason_of(error)
        raise BadInput(path, f"cannot be read: {reason}", _ACCEPTED) from error


def checkpoint_names(path: str, raw: bytes) -> dict[str, str]:
    """Return the names in `deepracer_checkpoints.json`, by the keys `best_checkpoint` and `last_checkpoint`.

    Raises:
        BadInput: it does not have them.
    """
    try:
        return {kind: value["name"] for kind, value in json.loads(raw).items() if value["name"]}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        accepted = "the names of best_checkpoint and last_checkpoint"
        raise BadInput(path, f"{error!r}", accepted) from error


def _read(files: _Files, checkpoint: str) -> StoredModel:
    weights = [name for name in files.sizes if name.endswith((INDEX, ".pb"))]  # as in `commands.exchange`
    whole = [
        name for name in weights if name.endswith(INDEX) and f"{name[: -len(INDEX)]}{DATA}" in files.sizes
    ]
    graphs = [name for name in weights if name.endswith(".pb")]
    if not whole and not graphs:
        lacking = f": {min(weights)} has no {DATA} beside it" if weights else ""
        raise BadInput(files.path, f"holds no model{lacking}", _ACCEPTED)
    chosen, note = _choose(files, whole or graphs, checkpoint)
    where = f"{files.path}/{chosen}"
    tensors: Tensors
    if whole:
        entries = read_index(files.read(chosen, INDEX_BYTES), where)
        data = f"{chosen[: -len(INDEX)]}{DATA}"
        tensors = read_tensors(entries, files.read(data, DATA_BYTES), f"{files.path}/{data}")
    else:
        tensors = read_weights(where, files.read(chosen, GRAPH_BYTES))
    nearest = {name: _nearest(files.sizes, name) for name in SMALL_FILES}
    small = {name: files.read(place, SETTINGS_BYTES) for name, place in nearest.items() if place is not None}
    has_logs = any(map(_LOGS.search, files.sizes))
    return StoredModel(tensors, where, small, has_logs, (note,) if note else ())


def _nearest(names: Mapping[str, int], wanted: str) -> str | None:
    matches = [name for name in names if PurePosixPath(name).name == wanted]
    return min(matches, key=lambda name: (name.count("/"), name), default=None)


def _choose(files: _Files, weights: list[str], checkpoint: str) -> tuple[str, str]:
    """Return the file with the weights, and a note if it differs from the requested one."""
    folders = {str(PurePosixPath(name).parent) for name in weights}
    if len(folders) > 1:
        raise BadInput(
            files.path,
            f"holds models in {len(folders)} folders: {', '.join(sorted(folders)[:4])}",
            "the path of one of them",
        )
    (folder,) = folders
    by_stem = {PurePosixPath(name).name.removesuffix(INDEX): name for name in sorted(weights, key=natural)}
    if len(by_stem) == 1:
        return weights[0], ""

    def beside(name: str) -> str:
        return name if folder == "." else f"{folder}/{name}"

    listed: Any = {}
    if beside(CHECKPOINTS) in files.sizes:
        raw = files.read(beside(CHECKPOINTS), SETTINGS_BYTES)
        listed = checkpoint_names(f"{files.path}/{beside(CHECKPOINTS)}", raw)
    newest = (
        files.read(beside(NEWEST), SETTINGS_BYTES).decode("utf-8", "replace")
        if beside(NEWEST) in files.sizes
        else ""
    )
    listed_name = str(listed.get(f"{checkpoint}_checkpoint", ""))
    for name in (listed_name, str(listed.get("last_checkpoint", "")), newest.strip(), list(by_stem)[-1]):
        # The frozen graph of 11_Step-38428.ckpt is model_11.pb.
        for stem in (name, f"model_{name.partition('_')[0]}.pb"):
            if stem in by_stem:
                same = stem == listed_name or name == listed_name
                what = f"the {checkpoint} checkpoint" + (f", {listed_name}," if listed_name else "")
                return by_stem[stem], "" if same else f"{what} is not among the files: {stem} is used"
    raise AssertionError("the newest is among them")


@contextmanager
def _opened(path: str) -> Iterator[_Files]:
    if Path(path).is_dir():
        yield _folder(path)
        return
    with open_user_file(path, _ACCEPTED, LOG_BYTES) as file:
        head = file.read(512)
    if not (head.startswith((*ZIP, b"\x1f\x8b")) or head[257:262] == b"ustar"):
        raise BadInput(path, "is no archive", _ACCEPTED)
    with open_archive(Path(path)) as archive:
        yield _packed(path, archive)


def _folder(path: str) -> _Files:
    """List the files of a folder; links are not followed."""

    def opened(name: str) -> IO[bytes]:
        return open_user_file(Path(path, name), _ACCEPTED, LOG_BYTES)

    files = _Files(path, opened, math.inf)
    for folder, _, names in os.walk(path):
        for name in names:
            file = Path(folder, name)
            status = file.lstat()
            if stat.S_ISREG(status.st_mode):
                files.add(file.relative_to(path).as_posix(), status.st_size)
    return files


def _packed(path: str, archive: Archive) -> _Files:
    """List the files of an archive."""
    members: dict[str, ArchiveMember] = {}
    files = _Files(path, lambda name: open_member(archive, members[name]))
    for member in members_of(archive):
        if member.kind == "link":
            raise BadInput(path, f"{member.name}: is a link", "archives of files alone")
        if member.kind == "other":
            raise BadInput(path, f"{member.name}: is no file", _ACCEPTED)
        if member.kind == "file":
            files.add(member.name, member.size)
            members[member.name] = member  # the later one counts, as in unpacking
    return files


def checkpoint_files(tensors: Tensors, number: int, steps: int, progress: float | None) -> dict[str, bytes]:
    """Return the files of a model's only checkpoint by their names.

    `progress` is the mean of its evaluation in per cent, None without one; `steps` were driven before it.
    """
    name = f"{number}_Step-{steps}.ckpt"
    evaluated = {"name": name, "avg_eval_metric": progress, "time_stamp": time.time()}
    listed = json.dumps({"last_checkpoint": evaluated, "best_checkpoint": evaluated})
    index, data = write_checkpoint(tensors)
    return {
        f"model/{CHECKPOINTS}": listed.encode(),
        f"model/{NEWEST}": name.encode(),
        f"model/{name}{INDEX}": index,
        f"model/{name}{DATA}": data,
        f"model/{name}{META}": _EMPTY_GRAPH,
    }
