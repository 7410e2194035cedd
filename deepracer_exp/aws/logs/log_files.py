"""The files of a folder or an archive, with the jobs that their paths name."""

import bz2
import contextlib
import gzip
import lzma
import os
import re
import tarfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import IO, Any

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
from deepracer_exp.files import LOG_BYTES, open_user_file

from .recorded import LogProblem, readable

_ACCEPTED = "trace CSVs or logs of the service"

_KIND = re.compile(r"(?:^|[-_.])(training|evaluation|leaderboard)(?=[-_.]|$)", re.IGNORECASE)
_FOLDERS = ("training", "evaluation", "leaderboard")
_DRFC_EVALUATION = re.compile(r"evaluation-\d{14}")
_WORKER = re.compile(r"(?:TrainingMetrics_|(?:worker|robomaker|simulation)[-_.]?)(\d{1,3})(?=\D|$)")
_WORKER_FOLDER = re.compile(r"(?:worker[-_.]?)?(\d{1,3})")
_STAMP = re.compile(r"\d{14}|\d{4}-\d\d-\d\dT[\d:.]+Z")
_ENDINGS = re.compile(
    r"(?:-(?:robomaker|sagemaker|simulation|training))?(?:\.(?:log|txt|csv|json))?(?:\.\d+)?$"
)
LOG = re.compile(r"(?:\.(?:log|txt|out|err)(?:\.\d{1,4})?|^(?:stdout|stderr))$", re.IGNORECASE)
"""Names of files that may be logs."""
# The group matches for a single compressed file, not for an archive.
PACKED = re.compile(r"\.(?:zip|tar|tgz|tbz2?|txz|tar\.(?:gz|bz2|xz)|(gz|bz2|xz))$", re.IGNORECASE)
_OPEN: Mapping[str, Any] = {"gz": gzip.open, "bz2": bz2.open, "xz": lzma.open}
_MARKS = {b"\x1f\x8b": "gz", b"BZh": "bz2", b"\xfd7zXZ": "xz"}


@dataclass(frozen=True)
class LogFile:
    """A file in a folder or an archive."""

    path: Path
    """Path for messages; a member of an archive has a path below the archive's."""
    parts: tuple[str, ...]
    """Names of the folders it is in, as far as they matter, and its own name."""
    opener: Callable[..., IO[bytes]]
    arguments: tuple[object, ...] = ()

    def __post_init__(self) -> None:
        """Make the names printable."""
        object.__setattr__(self, "parts", tuple(readable(part) for part in self.parts))

    def open(self) -> IO[bytes]:
        """Open it for reading."""
        return self.opener(*self.arguments)

    def head(self, most_bytes: int) -> bytes:
        """Return its first bytes, at most `most_bytes`."""
        with self.open() as stream:
            return stream.read(most_bytes)

    @property
    def name(self) -> str:
        """Name of the file itself."""
        return self.parts[-1]

    @property
    def order(self) -> tuple[tuple[int, int | str], ...]:
        """Sorts 10-iteration.csv after 9-iteration.csv."""
        return natural("/".join(self.parts))


@dataclass
class LogFolder:
    """The files found in a folder or an archive."""

    files: list[LogFile] = field(default_factory=list)
    """Files in the order in which they are fastest to read."""
    problems: list[LogProblem] = field(default_factory=list)


@dataclass(frozen=True)
class Place:
    """The job that a file belongs to, by its path."""

    kind: str
    """`training`, `evaluation` or `leaderboard`."""
    root: tuple[str, ...]
    """The folder of one training with all its workers, or of one evaluation."""
    name: str
    """Name of that training or evaluation."""
    worker: int


def named_parts(path: Path) -> tuple[str, ...]:
    """Return the parts of an absolute path without resolving links."""
    return Path(os.path.abspath(path)).parts  # noqa: PTH100 - `resolve` would follow links


def place_of(parts: tuple[str, ...]) -> Place:
    """Return the job of a trace or log, by its folders and its name."""
    for depth in range(len(parts) - 2, -1, -1):
        if parts[depth] in ("training-simtrace", "evaluation-simtrace"):
            kind = parts[depth].partition("-")[0]
            above = parts[:depth]
            worker = 0
            numbered = _WORKER_FOLDER.fullmatch(above[-1]) if kind == "training" and above else None
            if numbered:
                worker, above = int(numbered[1]), above[:-1]
            return Place(kind, above, above[-1] if above else kind, worker)
    name = label(parts[-1])
    named = _KIND.search(parts[-1])
    kind = named[1].lower() if named else "training"
    if named is None:
        for folder in reversed(parts[:-1]):
            if folder in _FOLDERS or _DRFC_EVALUATION.fullmatch(folder):
                kind = folder.partition("-")[0]
                break
    if kind != "training":
        return Place(kind, parts[:-1], name, 0)
    if len(parts) > 1 and (of_folder := _WORKER_FOLDER.fullmatch(parts[-2])) and not parts[-2].isdigit():
        return Place(kind, parts[:-2], name, int(of_folder[1]))
    numbered = _WORKER.search(parts[-1])
    return Place(kind, parts[:-1], name, int(numbered[1]) if numbered else 0)


def label(name: str) -> str:
    """Return the name of a log or metrics file without its ending and kind."""
    return _ENDINGS.sub("", name) or name


def without_worker(name: str) -> str:
    """Return the name of a log with # for the number of its worker: the same for all workers of a training."""
    match = _WORKER.search(name)
    return name if match is None else f"{name[: match.start(1)]}#{name[match.end(1) :]}"


def same_job(name: str, other: str) -> bool:
    """Return whether two names belong to one job, by the time stamp in them or the id after it."""
    stamps = [set(_STAMP.findall(name)) for name in (name, other)]
    if stamps[0] & stamps[1]:
        return True
    first, second = (_STAMP.split(label(name))[-1].strip("-_") for name in (name, other))
    return bool(stamps[0] and stamps[1] and first and first == second)


@contextlib.contextmanager
def log_folder(path: Path) -> Iterator[LogFolder]:
    """Find the files below a folder and in the archives there, in one archive, or the one file.

    Links are not followed. Archives and compressed files are read without being unpacked.

    Raises:
        BadInput: nothing is there, or it cannot be opened.
    """
    try:
        if not path.exists():
            raise BadInput(path, "no such file or folder", _ACCEPTED)
        with contextlib.ExitStack() as opened:
            if path.is_dir():
                yield _walk(path, opened)
            elif _is_packed(path):
                listed = LogFolder()
                archives = opened.enter_context(contextlib.closing(_Archives()))
                _unpack(listed, path, (), named_parts(path)[-3:-1], archives)
                yield listed
            else:
                yield LogFolder([_plain(path, named_parts(path)[-3:])])
    except (*READ_ERRORS, ValueError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(path, f"cannot be read: {reason_of(error)}") from error


def _walk(root: Path, opened: contextlib.ExitStack) -> LogFolder:
    listed = LogFolder()
    above = root.resolve().parts[-2:]
    waiting, packed = [root], []
    while waiting:
        folder = waiting.pop()
        try:
            entries = list(folder.iterdir())
        except OSError as error:
            listed.problems.append(LogProblem(str(folder), None, f"cannot be read: {error.strerror}"))
            continue
        for entry in entries:
            if entry.is_symlink():
                listed.problems.append(LogProblem(str(entry), None, "a link; not followed"))
            elif entry.is_dir():
                waiting.append(entry)
            elif entry.is_file() and PACKED.search(entry.name):
                packed.append(entry)
            elif entry.is_file():
                listed.files.append(_plain(entry, (*above, *entry.relative_to(root).parts)))
    listed.files.sort(key=lambda file: file.order)
    archives = opened.enter_context(contextlib.closing(_Archives()))
    for path in sorted(packed):
        folders = (*above, *path.relative_to(root).parts[:-1])
        plain = path.with_name(PACKED.sub("", path.name))
        try:
            if plain.is_file():
                listed.problems.append(LogProblem(str(path), None, f"not read: {plain.name} lies beside it"))
            else:
                _unpack(listed, path, (*folders, path.name), folders, archives)
        except (*READ_ERRORS, ValueError) as error:
            listed.problems.append(LogProblem(str(path), None, f"cannot be read ({reason_of(error)})"))
    return listed


def _plain(path: Path, parts: tuple[str, ...]) -> LogFile:
    return LogFile(path, parts, open_user_file, (path, _ACCEPTED, LOG_BYTES))


def _is_packed(path: Path) -> bool:
    with open_user_file(path, _ACCEPTED, LOG_BYTES) as file:
        head = file.read(512)
    return head.startswith((*_MARKS, *ZIP)) or head[257:262] == b"ustar"


class _Archives:
    """Opens members of archives, keeping one archive open at a time: a folder may hold very many."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._archive: Archive | None = None

    def open(self, path: Path, member: ArchiveMember) -> IO[bytes]:
        """Open a member for reading; a member of another archive must have been read completely."""
        if self._archive is None or self._path != path:
            self.close()
            self._path, self._archive = path, open_archive(path)
        stream = open_member(self._archive, member)
        ending = _ending(member.name)
        return stream if ending is None else _OPEN[ending](stream)

    def close(self) -> None:
        """Close the open archive."""
        if self._archive is not None:
            self._archive.close()


def _unpack(
    listed: LogFolder, path: Path, inside: tuple[str, ...], beside: tuple[str, ...], archives: _Archives
) -> None:
    """Add the members of an archive, or a compressed file.

    Args:
        listed: the files to add to.
        path: path of the archive or compressed file.
        inside: folders that the members are in; empty if the archive is all there is.
        beside: folders that the archive or compressed file is in.
        archives: opens the members.
    """
    try:
        with open_archive(path) as archive:
            members = _members(path, archive, archives)
    except tarfile.ReadError:
        with open_user_file(path, _ACCEPTED, LOG_BYTES) as file:
            head = file.read(8)
        opener = next((_OPEN[ending] for mark, ending in _MARKS.items() if head.startswith(mark)), None)
        if opener is None:
            raise OSError("neither an archive nor compressed" if head else "empty") from None
        with opener(path) as stream:
            stream.read(1)
        listed.files.append(LogFile(path, (*beside, PACKED.sub("", path.name)), opener, (path,)))
        return
    if inside and not any(map(_may_hold_data, members.files)):
        listed.problems += members.problems
        listed.files.append(_plain(path, (*beside, path.name)))  # perhaps a model for the car
        return
    listed.problems += members.problems
    rest = [file for file in members.files if not inside or not _lies_beside(path, file)]
    if len(rest) < len(members.files):
        count = len(members.files) - len(rest)
        reason = f"{count} of {len(members.files)} files are not read: the same are unpacked beside it"
        listed.problems.append(LogProblem(str(path), None, reason))
    listed.files += [replace(file, parts=(*inside, *file.parts)) for file in rest]


def _lies_beside(path: Path, file: LogFile) -> bool:
    """Return whether a member of an archive is also unpacked beside it, with the same name and size."""
    named = (PACKED.sub("", path.name),)
    _, member = file.arguments
    assert isinstance(member, ArchiveMember)
    for place in (file.parts, (*named, *file.parts), (*named, *file.parts[1:])):
        with contextlib.suppress(OSError):  # not there, or a name that no file system takes
            if path.parent.joinpath(*place).stat().st_size == member.size:
                return True
    return False


def _may_hold_data(file: LogFile) -> bool:
    """Return whether a file may be a trace, a log or metrics."""
    name = "/".join(file.parts).lower()
    return (
        name.endswith(".csv")
        or LOG.search(file.name) is not None
        or ("metric" in name and name.endswith(".json"))
    )


def _ending(name: str) -> str | None:
    """Return the compression of a single file by its name; None for an archive and any other file."""
    packed = PACKED.search(name)
    return packed[1].lower() if packed is not None and packed[1] else None


def _members(path: Path, archive: Archive, archives: _Archives) -> LogFolder:
    """List the members."""
    listed = LogFolder()
    members: dict[tuple[str, ...], ArchiveMember] = {}
    try:
        for member in members_of(archive):
            if member.kind == "file":
                parts = tuple(
                    part for part in PurePosixPath(member.name).parts if part not in ("/", "..", ".")
                )
                members.pop(parts, None)
                members[parts] = member  # the later one counts, as in unpacking
            elif member.kind == "link":
                listed.problems.append(LogProblem(f"{path}/{member.name}", None, "a link; not followed"))
    except (*READ_ERRORS, ValueError, OverflowError) as error:
        reason = f"cannot be read to its end ({reason_of(error)})"
        listed.problems.append(LogProblem(str(path), None, reason))
    for parts, member in members.items():
        if parts:
            plain = parts if _ending(parts[-1]) is None else (*parts[:-1], PACKED.sub("", parts[-1]))
            listed.files.append(LogFile(path.joinpath(*parts), plain, archives.open, (path, member)))
    return listed
