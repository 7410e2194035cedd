"""Files that a reader must read or refuse in one line, without hanging."""

import os
from collections.abc import Callable
from pathlib import Path

TEXTS: dict[str, bytes] = {
    "empty": b"",
    "binary": bytes(range(256)) * 8,
    "UTF-16": "knots: [[0, 0], [1, 0]]".encode("utf-16"),
    "Latin-1": "name: Schlo\xdf".encode("latin-1"),
    "null characters": b"\0" * 4096,
    "one long line": b"x" * 200_000,
    "deep lists": b"[" * 100_000,
    "deep mappings": b'{"a":' * 50_000,
    "a bomb of aliases": b"a: &a [1,1,1,1,1,1,1,1]\n"
    + b"".join(b"%c: &%c [%b]\n" % (98 + n, 98 + n, b",".join([b"*%c" % (97 + n)] * 8)) for n in range(12)),
    "an alias of itself": b"a: &a [*a]\n",
    "a number of 5,000 digits": b"seed: " + b"9" * 5000,
    "a tag that lies": b"kind: !!int abc\n",
    "a date": b"kind: 2026-01-01\nname: !!timestamp 2026-01-01\n",
    "no date": b"kind: !!timestamp abc\n",
    "code": b"!!python/object/apply:os.system ['true']\n",
    "a set": b"!!set {a, b}\n",
    "keys that are no text": b"? [1, 2]\n: 3\n? {a: b}\n: 4\n",
    "twice the same key": b"kind: none\nkind: none\n",
    "not a number": b"kind: .nan\nwindow: .inf\n",
    "two documents": b"---\na: 1\n---\nb: 2\n",
    "an array of terabytes": b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, "
    + b"'shape': (999999999999, 6), }   \n",
    "an array of objects": b"\x93NUMPY\x01\x00v\x00{'descr': '|O', 'fortran_order': False, 'shape': (9, 6), }"
    + b" " * 58
    + b"\n",
    "half a header": b"\x93NUMPY\x01\x00v\x00{'descr': ",
    "half an archive": b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\x03abc",
    "JSON that is no object": b"[1, 2, 3]",
    "escapes of a terminal": b"\x1b]0;title\x07\x1b[2J: 1\n",
}
"""Contents by what they are; of no kind of file that is read here."""


def _loop(path: Path) -> None:
    path.symlink_to(path)


def _dangling(path: Path) -> None:
    path.symlink_to(path.with_name("nothing"))


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(32 * 2**30)


PLACES: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "a folder": Path.mkdir,
    "a pipe": lambda path: os.mkfifo(path),
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a terminal": lambda path: path.symlink_to("/dev/tty"),
    "a link to itself": _loop,
    "a dangling link": _dangling,
    "a sparse giant": _sparse,
}
"""What may stand where a file should, by what it is."""


def make(kind: str, path: Path) -> Path:
    """Make one of `TEXTS` or `PLACES` at a path and return the path."""
    if kind in TEXTS:
        path.write_bytes(TEXTS[kind])
    else:
        PLACES[kind](path)
    return path


KINDS = (*TEXTS, *PLACES)
