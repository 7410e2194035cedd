"""The files of a folder or of an archive, and what their places in it say."""

import re
import stat
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import IO

from deepracer_exp.errors import BadInput

from .log_blocks import READ_ERRORS
from .recording import LogProblem

_KIND = re.compile(r"(?:^|[-_.])(training|evaluation|leaderboard)(?=[-_.]|$)", re.IGNORECASE)
_FOLDERS = {"training": "training", "evaluation": "evaluation", "leaderboard": "leaderboard"}
_DRFC_EVALUATION = re.compile(r"evaluation-\d{14}")
_WORKER = re.compile(r"(?:TrainingMetrics_|(?:worker|robomaker|simulation)[-_.]?)(\d{1,3})(?=\D|$)")
_STAMP = re.compile(r"\d{14}|\d{4}-\d\d-\d\dT[\d:.]+Z")
_ENDINGS = re.compile(
    r"(?:-(?:robomaker|sagemaker|simulation|training))?(?:\.(?:log|txt|csv|json))?(?:\.\d+)?$"
)


@dataclass(frozen=True)
class LogFile:
    """One file, wherever it is."""

    path: Path
    """For messages; a member of an archive stands below the archive."""
    parts: tuple[str, ...]
    """Names of the folders it is in, as far as they may tell something, and its own."""
    opener: Callable[..., IO[bytes]]
    given: tuple[object, ...] = ()

    def open(self) -> IO[bytes]:
        """Open it for reading."""
        return self.opener(*self.given)

    @property
    def name(self) -> str:
        """Its own name."""
        return self.parts[-1]

    @property
    def order(self) -> tuple[tuple[int, int | str], ...]:
        """Sorts 10-iteration.csv after 9-iteration.csv."""
        return natural("/".join(self.parts))


@dataclass
class LogFolder:
    """What was found."""

    files: list[LogFile] = field(default_factory=list)
    """In the order in which they are best read."""
    problems: list[LogProblem] = field(default_factory=list)
    apart: bool = True
    """Whether files can be read side by side."""


@dataclass(frozen=True)
class Place:
    """What the place of a file says of the drives in it."""

    kind: str
    """`training`, `evaluation` or `leaderboard`."""
    root: tuple[str, ...]
    """The folder of one training with all its workers, or of one evaluation."""
    name: str
    """Of that training or evaluation."""
    worker: int


def natural(text: str) -> tuple[tuple[int, int | str], ...]:
    """Return a key that sorts numbers in names by size."""
    pieces = re.split(r"(\d+)", text)
    return tuple((1, int(piece)) if piece.isdigit() else (0, piece) for piece in pieces)


def place_of(parts: tuple[str, ...]) -> Place:
    """Return what the folders and the name of a trace or log say."""
    for at in range(len(parts) - 2, -1, -1):
        if parts[at] in ("training-simtrace", "evaluation-simtrace"):
            kind = parts[at].partition("-")[0]
            above = parts[:at]
            worker = 0
            if kind == "training" and above and above[-1].isdigit() and len(above[-1]) <= 3:
                worker, above = int(above[-1]), above[:-1]
            return Place(kind, above, above[-1] if above else kind, worker)
    name = label(parts[-1])
    told = _KIND.search(parts[-1])
    kind = told[1].lower() if told else "training"
    if told is None:
        for folder in reversed(parts[:-1]):
            if folder in _FOLDERS or _DRFC_EVALUATION.fullmatch(folder):
                kind = folder.partition("-")[0]
                break
    numbered = _WORKER.search(parts[-1])
    return Place(kind, parts[:-1], name, int(numbered[1]) if numbered and kind == "training" else 0)


def label(name: str) -> str:
    """Return the name of a log or metrics file without what all have in common."""
    return _ENDINGS.sub("", name) or name


def same_job(one: str, other: str) -> bool:
    """Tell whether two names are of one job: by the time stamp in them, or by the id behind it."""
    stamps = [set(_STAMP.findall(name)) for name in (one, other)]
    if stamps[0] & stamps[1]:
        return True
    first, second = (_STAMP.split(label(name))[-1].strip("-_") for name in (one, other))
    return bool(stamps[0] and stamps[1] and first and first == second)


@contextmanager
def log_folder(path: Path) -> Iterator[LogFolder]:
    """Find the files below a folder, in an archive, or the one file.

    Links are not followed. An archive stays as it is: its members are read out of it.

    Raises:
        BadInput: nothing is there, or it cannot be opened.
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            yield _walk(path)
        elif not stat.S_ISREG(mode):
            raise BadInput(f"{path}: is no file or folder; accepted: logs of the service or a run's folder")
        elif _is_archive(path):
            with tarfile.open(path, "r:*") as archive:
                yield _members(path, archive)
        else:
            parts = path.resolve().parts[-3:]
            yield LogFolder([LogFile(path, parts, path.open, ("rb",))])
    except FileNotFoundError as error:
        raise BadInput(
            f"{path}: no such file or folder; accepted: trace CSVs or logs of the service"
        ) from error
    except (*READ_ERRORS, ValueError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"{path}: cannot be read: {' '.join(str(error).split())}") from error


def _walk(root: Path) -> LogFolder:
    found = LogFolder()
    above = root.resolve().parts[-2:]
    waiting = [root]
    while waiting:
        folder = waiting.pop()
        try:
            entries = list(folder.iterdir())
        except OSError as error:
            found.problems.append(LogProblem(str(folder), None, f"cannot be read: {error.strerror}"))
            continue
        for entry in entries:
            if entry.is_symlink():
                found.problems.append(LogProblem(str(entry), None, "a link; not followed"))
            elif entry.is_dir():
                waiting.append(entry)
            elif entry.is_file():
                parts = (*above, *entry.relative_to(root).parts)
                found.files.append(LogFile(entry, parts, entry.open, ("rb",)))
    found.files.sort(key=lambda file: file.order)
    return found


def _is_archive(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(512)
    return head.startswith((b"\x1f\x8b", b"BZh", b"\xfd7zXZ")) or head[257:262] == b"ustar"


def _members(path: Path, archive: tarfile.TarFile) -> LogFolder:
    """List the members in the order in which they stand: going back in an archive means reading it anew."""
    found = LogFolder(apart=False)
    members: dict[str, tarfile.TarInfo] = {}
    try:
        while (member := archive.next()) is not None:
            if member.isfile():
                members.pop(member.name, None)
                members[member.name] = member  # the later one counts, as in unpacking
            elif member.islnk() or member.issym():
                found.problems.append(LogProblem(f"{path}/{member.name}", None, "a link; not followed"))
    except (*READ_ERRORS, ValueError, OverflowError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        found.problems.append(LogProblem(str(path), None, f"cannot be read to its end ({reason})"))
    for name, member in members.items():
        parts = tuple(part for part in PurePosixPath(name).parts if part not in ("/", "..", "."))
        if parts:
            found.files.append(LogFile(path.joinpath(*parts), parts, _open, (archive, member)))
    return found


def _open(archive: tarfile.TarFile, member: tarfile.TarInfo) -> IO[bytes]:
    stream = archive.extractfile(member)
    if stream is None:
        raise OSError(f"{member.name} is no plain file")
    return stream
