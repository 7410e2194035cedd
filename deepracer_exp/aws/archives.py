"""Archives of logs and models, read without unpacking."""

import lzma
import re
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from deepracer_exp.files import LOG_BYTES, open_user_file

READ_ERRORS = (OSError, EOFError, zlib.error, lzma.LZMAError, tarfile.TarError, zipfile.BadZipFile)
"""Errors of reading a file or a member of an archive."""
ZIP = (b"PK\x03\x04", b"PK\x05\x06")
"""First bytes of a zip archive, with and without members."""
_HEADER_BYTES = 2**20
"""Most bytes of a long name in an archive."""


def reason_of(error: Exception) -> str:
    """Return the message of such an error in one line; its type where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def natural(text: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that orders numbers in names by value."""
    pieces = re.split(r"(\d+)", text)
    return tuple((1, int(piece)) if piece.isdigit() else (0, piece) for piece in pieces)


class _SmallHeader(tarfile.TarInfo):
    """Refuses long names and attributes, which tarfile would read into memory at any size."""

    def _proc_member(self, archive: tarfile.TarFile) -> Any:
        if self.type not in tarfile.REGULAR_TYPES and self.size > _HEADER_BYTES:
            raise tarfile.TarError(f"a header of {self.size:,} bytes")
        return super()._proc_member(archive)  # type: ignore[misc]


Archive = tarfile.TarFile | zipfile.ZipFile


@dataclass(frozen=True)
class ArchiveMember:
    """A member of an archive."""

    name: str
    size: int
    """Unpacked size in bytes."""
    kind: str
    """`file`, `folder`, `link` or `other`."""
    entry: tarfile.TarInfo | zipfile.ZipInfo

    @classmethod
    def of(cls, entry: tarfile.TarInfo | zipfile.ZipInfo) -> "ArchiveMember":
        """Return the member that an archive lists as an entry."""
        if isinstance(entry, tarfile.TarInfo):
            link = entry.islnk() or entry.issym()
            kind = "file" if entry.isfile() else "link" if link else "folder" if entry.isdir() else "other"
            return cls(entry.name, entry.size, kind, entry)
        # Only archives made on Unix have a mode.
        link = stat.S_ISLNK(entry.external_attr >> 16)
        kind = "link" if link else "folder" if entry.is_dir() else "file"
        return cls(entry.filename, entry.file_size, kind, entry)


def open_archive(path: Path) -> Archive:
    """Open a tar or zip archive.

    Raises:
        BadInput: it is not a plain file, or too large.
    """
    with open_user_file(path, "an archive", LOG_BYTES) as file:
        zipped = file.read(4) in ZIP
    return zipfile.ZipFile(path) if zipped else tarfile.open(path, "r:*", tarinfo=_SmallHeader)


def members_of(archive: Archive) -> Iterator[ArchiveMember]:
    """Yield the members in the order of the archive, because going back would read it again."""
    if isinstance(archive, zipfile.ZipFile):
        yield from map(ArchiveMember.of, archive.infolist())
        return
    while (entry := archive.next()) is not None:
        yield ArchiveMember.of(entry)


def open_member(archive: Archive, member: ArchiveMember) -> IO[bytes]:
    """Open a file in an archive for reading.

    Raises:
        OSError: it is encrypted, or packed in an unknown way.
    """
    if isinstance(archive, tarfile.TarFile):
        assert isinstance(member.entry, tarfile.TarInfo)
        stream = archive.extractfile(member.entry)
        if stream is None:
            raise OSError(f"{member.name} is not a regular file")
        return stream
    assert isinstance(member.entry, zipfile.ZipInfo)
    try:
        return archive.open(member.entry)
    except (RuntimeError, NotImplementedError) as error:  # encrypted, or packed in a way unknown to Python
        raise OSError(str(error)) from error
