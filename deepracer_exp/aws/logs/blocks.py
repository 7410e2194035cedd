"""Large files read in blocks of whole lines."""

import codecs
from collections.abc import Iterator
from typing import IO

from deepracer_exp.aws.archives import READ_ERRORS, reason_of
from deepracer_exp.files import LOG_BYTES

SIZE = 2**23
"""Size of a block in bytes."""
_PIECE = 2**16
_LONGEST_LINE = 2**24
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


class Blocks:
    """Reads a stream in blocks of whole lines, so that memory does not grow with the file.

    A file with the byte order mark of UTF-16, as PowerShell writes logs, is converted to UTF-8.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self.stream = stream
        self._ended = False
        self._bytes = 0
        self._block = b""
        self.lines = 0
        """Lines before the current block."""
        self.refused: list[tuple[int | None, str]] = []
        """Line (None: from here on) and reason of each unreadable part."""

    def __iter__(self) -> Iterator[bytes]:
        """Yield blocks; only the last may end without a line break."""
        rest, skipping = b"", False
        for chunk in self._chunks():
            if skipping:
                _, separator, chunk = chunk.partition(b"\n")
                if not separator:
                    continue
                skipping = False
                self.lines += 1
            end = chunk.rfind(b"\n") + 1
            if not end:
                rest += chunk
                if len(rest) > _LONGEST_LINE:
                    self.refused.append((self.lines + 1, f"a line of more than {_LONGEST_LINE // 2**20} MiB"))
                    rest, skipping = b"", True
                continue
            block = rest + chunk[:end]
            self._block = block
            yield block
            self.lines += block.count(b"\n")
            rest = chunk[end:]
        if rest:
            self._block = rest
            yield rest

    def line(self, offset: int) -> int:
        """Return the number of the line, from 1, that an offset in the current block is in."""
        return self.lines + self._block.count(b"\n", 0, offset) + 1

    def _chunks(self) -> Iterator[bytes]:
        decoder = None
        chunk = self._read()
        if chunk[:2] in _UTF_16:
            decoder = codecs.getincrementaldecoder("utf-16")(errors="replace")
        elif chunk.startswith(codecs.BOM_UTF8):
            chunk = chunk[len(codecs.BOM_UTF8) :]
        while chunk:
            yield chunk if decoder is None else decoder.decode(chunk).encode("utf-8", "replace")
            chunk = self._read()

    def _read(self) -> bytes:
        # In pieces: a truncated archive loses only the piece that fails, not what was read before.
        pieces, size = [], 0
        while size < SIZE and not self._ended:
            if self._bytes > LOG_BYTES:
                self.refused.append((None, f"longer than {LOG_BYTES // 2**30} GiB; the rest is not read"))
                self._ended = True
                break
            try:
                piece = self.stream.read(min(_PIECE, SIZE - size))
            except READ_ERRORS as error:
                self.refused.append((None, f"cannot be read to its end ({reason_of(error)})"))
                self._ended = True
                break
            if not piece:
                break
            pieces.append(piece)
            size += len(piece)
            self._bytes += len(piece)
        return b"".join(pieces)
