"""The files of a folder or an archive, and what their paths say about them."""

import bz2
import gzip
import lzma
import re
import tarfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any

from deepracer_exp.errors import BadInput
from deepracer_exp.files import LOG_BYTES, open_user_file

from .recording import LogProblem, readable

READ_ERRORS = (OSError, EOFError, zlib.error, lzma.LZMAError, tarfile.TarError)
"""Errors of reading a file or a member of an archive."""
_ACCEPTED = "trace CSVs or logs of the service"

_KIND = re.compile(r"(?:^|[-_.])(training|evaluation|leaderboard)(?=[-_.]|$)", re.IGNORECASE)
_FOLDER = re.compile(r"training|evaluation(?:-\d{14})?|leaderboard")
_WORKER = re.compile(r"(?:TrainingMetrics_|(?:worker|robomaker|simulation)[-_.]?)(\d{1,3})(?=\D|$)")
_STAMP = re.compile(r"\d{14}|\d{4}-\d\d-\d\dT[\d:.]+Z")
_ENDINGS = re.compile(
    r"(?:-(?:robomaker|sagemaker|simulation|training))?(?:\.(?:log|txt|csv|json))?(?:\.\d+)?$"
)
LOG = re.compile(r"(?:\.(?:log|txt|out|err)(?:\.\d{1,4})?|^(?:stdout|stderr))$", re.IGNORECASE)
"""Names of files that may be logs."""
# The group matches for a single compressed file, not for an archive.
_PACKED = re.compile(r"\.(?:tar|tgz|tbz2?|txz|tar\.(?:gz|bz2|xz)|(gz|bz2|xz))$", re.IGNORECASE)
_OPEN: Mapping[str, Any] = {"gz": gzip.open, "bz2": bz2.open, "xz": lzma.open}
_MARKS = {b"\x1f\x8b": "gz", b"BZh": "bz2", b"\xfd7zXZ": "xz"}


@dataclass(frozen=True)
class LogFile:
    """One file, wherever it is."""

    path: Path
    """For messages; a member of an archive has a path below the archive's."""
    parts: tuple[str, ...]
    """Names of the folders it is in, as far as they matter, and its own name."""
    open: Callable[[], IO[bytes]]

    def __post_init__(self) -> None:
        """Make the names printable."""
        object.__setattr__(self, "parts", tuple(readable(part) for part in self.parts))

    @property
    def name(self) -> str:
        """Its own name."""
        return self.parts[-1]

    @property
    def order(self) -> tuple[tuple[int, int | str], ...]:
        """Sorts 10-iteration.csv after 9-iteration.csv."""
        return natural("/".join(self.parts))

    @property
    def piece(self) -> tuple[tuple[str, ...], int]:
        """The whole log that `robomaker.log.1` is a piece of, and a key that sorts its pieces from the oldest.

        The highest number is the oldest piece; the one without a number is still being written.
        """
        stem, _, number = self.name.rpartition(".")
        return ((*self.parts[:-1], stem), -int(number)) if stem and number.isdigit() else (self.parts, 1)


def log_files(path: Path, problems: list[LogProblem]) -> Iterator[LogFile]:
    """Yield the files below a folder and in the archives there, in one archive, or the one file.

    Links are not followed. Archives and compressed files are read without being unpacked: a file has to be read before
    the next one is asked for.

    Args:
        path: a folder, an archive or a file.
        problems: gets what cannot be read.

    Raises:
        BadInput: it does not exist or cannot be read at all.
    """
    parts = path.resolve().parts
    if path.is_dir():
        yield from _below(path, parts[-2:], problems)
        return
    open_user_file(path, _ACCEPTED, LOG_BYTES).close()
    try:
        yield from _packed(path, parts[-3:], (), problems)
    except _NotPackedError:
        yield LogFile(path, parts[-3:], partial(open_user_file, path, _ACCEPTED, LOG_BYTES))
    except (*READ_ERRORS, ValueError) as error:
        raise BadInput(f"{path}: cannot be read: {reason_of(error)}") from error


def reason_of(error: Exception) -> str:
    """Return the message of an error of reading on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _below(root: Path, above: tuple[str, ...], problems: list[LogProblem]) -> Iterator[LogFile]:
    files: list[LogFile] = []
    waiting, packed = [root], []
    while waiting:
        folder = waiting.pop()
        try:
            entries = list(folder.iterdir())
        except OSError as error:
            problems.append(LogProblem(str(folder), None, f"cannot be read: {error.strerror}"))
            continue
        for entry in entries:
            if entry.is_symlink():
                problems.append(LogProblem(str(entry), None, "a link; not followed"))
            elif entry.is_dir():
                waiting.append(entry)
            elif entry.is_file() and _PACKED.search(entry.name):
                packed.append(entry)
            elif entry.is_file():
                parts = (*above, *entry.relative_to(root).parts)
                files.append(LogFile(entry, parts, partial(open_user_file, entry, _ACCEPTED, LOG_BYTES)))
    yield from sorted(files, key=lambda file: file.order)
    for path in sorted(packed):
        parts = (*above, *path.relative_to(root).parts)
        try:
            yield from _packed(path, parts, parts, problems)
        except (*READ_ERRORS, ValueError) as error:
            problems.append(LogProblem(str(path), None, f"cannot be read ({reason_of(error)})"))


class _NotPackedError(ValueError):
    """A file is neither an archive nor compressed."""


def _packed(
    path: Path, parts: tuple[str, ...], inside: tuple[str, ...], problems: list[LogProblem]
) -> Iterator[LogFile]:
    """Yield the members of an archive, or a compressed file.

    Args:
        path: of the archive or compressed file.
        parts: its folders and its name.
        inside: folders that members are in; empty if the archive is all there is.
        problems: gets what cannot be read.
    """
    try:
        archive = tarfile.open(path, "r:*")  # noqa: SIM115 - closed below
    except tarfile.ReadError:
        with path.open("rb") as file:
            head = file.read(8)
        opener = next((_OPEN[ending] for mark, ending in _MARKS.items() if head.startswith(mark)), None)
        if opener is None:
            raise _NotPackedError("neither an archive nor compressed") from None
        with opener(path) as stream:
            stream.read(1)
        yield LogFile(path, (*parts[:-1], _PACKED.sub("", path.name)), partial(opener, path))
        return
    with archive:
        try:
            for member in archive:
                if member.islnk() or member.issym():
                    problems.append(LogProblem(f"{path}/{member.name}", None, "a link; not followed"))
                names = PurePosixPath(member.name).parts
                own = tuple(part for part in names if part not in ("/", "..", "."))
                if member.isfile() and own:
                    unpacked = own if _ending(own[-1]) is None else (*own[:-1], _PACKED.sub("", own[-1]))
                    yield LogFile(path.joinpath(*own), (*inside, *unpacked), partial(_open, archive, member))
        except (*READ_ERRORS, ValueError, OverflowError) as error:
            problems.append(LogProblem(str(path), None, f"cannot be read to its end ({reason_of(error)})"))


def _open(archive: tarfile.TarFile, member: tarfile.TarInfo) -> IO[bytes]:
    stream = archive.extractfile(member)
    assert stream is not None
    ending = _ending(member.name)
    opened: IO[bytes] = stream if ending is None else _OPEN[ending](stream)
    return opened


def _ending(name: str) -> str | None:
    """Return the compression of a single file by its name; None for an archive and any other file."""
    packed = _PACKED.search(name)
    return packed[1].lower() if packed is not None and packed[1] else None


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


def natural(text: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that orders numbers in names by value."""
    pieces = re.split(r"(\d+)", text)
    return tuple((1, int(piece)) if piece.isdigit() else (0, piece) for piece in pieces)


def place_of(parts: tuple[str, ...]) -> Place:
    """Return the job of a trace or log, by its folders and its name."""
    for at in range(len(parts) - 2, -1, -1):
        if parts[at] in ("training-simtrace", "evaluation-simtrace"):
            kind = parts[at].partition("-")[0]
            above = parts[:at]
            worker = 0
            if kind == "training" and above and above[-1].isdigit() and len(above[-1]) <= 3:
                worker, above = int(above[-1]), above[:-1]
            return Place(kind, above, above[-1] if above else kind, worker)
    name = label(parts[-1])
    named = _KIND.search(parts[-1])
    kind = named[1].lower() if named else "training"
    if named is None:
        for folder in reversed(parts[:-1]):
            if _FOLDER.fullmatch(folder):
                kind = folder.partition("-")[0]
                break
    numbered = _WORKER.search(parts[-1])
    return Place(kind, parts[:-1], name, int(numbered[1]) if numbered and kind == "training" else 0)


def label(name: str) -> str:
    """Return the name of a log or metrics file without its ending and kind."""
    return _ENDINGS.sub("", name) or name


def same_job(one: str, other: str) -> bool:
    """Return whether two names belong to one job, by the time stamp in them or the id after it."""
    stamps = [set(_STAMP.findall(name)) for name in (one, other)]
    if stamps[0] & stamps[1]:
        return True
    first, second = (_STAMP.split(label(name))[-1].strip("-_") for name in (one, other))
    return bool(stamps[0] and stamps[1] and first and first == second)
