"""The user's on-disk cache of slow results; anything deleted is recomputed."""

import contextlib
import functools
import hashlib
import os
import platform
import re
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

_PACKAGE = Path(__file__).parent
_COMPILERS = ("numba", "llvmlite", "numpy")
_KEPT = 20
"""Number of folders of compiled code, each of 10 MB, for several installations and changing sources."""


def cache_home() -> Path | None:
    """Return the cache's folder; None where this account has no home."""
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(base) / "deepracer_exp"


@functools.cache
def compiled_folder() -> Path | None:
    """Return the folder of compiled code, made where it is missing; None where none can be written.

    Its name is a hash of everything that the code is compiled from: the files of this package that have compiled
    functions, wherever they lie, and the versions of Python and of the libraries that compile. Numba's variable
    `NUMBA_CACHE_DIR` says where the folder lies, if it is set.
    """
    base = os.environ.get("NUMBA_CACHE_DIR") or cache_home()
    if base is None:
        return None
    content = hashlib.sha256(f"{_PACKAGE} {platform.python_version()}".encode())
    content.update(" ".join(map(version, _COMPILERS)).encode())
    for file in sorted(_PACKAGE.rglob("*.py")):
        if has_compiled_functions(source := file.read_bytes()):
            content.update(b"\0%b\0%b" % (os.fsencode(file), source))
    folder = Path(base, f"compiled-{content.hexdigest()[:32]}")
    try:
        is_new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        # This also marks it as used now.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return None
    if is_new:
        with contextlib.suppress(OSError):  # another process removes the same ones
            folders = sorted(folder.parent.glob("compiled-*"), key=lambda old: old.stat().st_mtime)
            for old in folders[:-_KEPT]:
                shutil.rmtree(old, ignore_errors=True)
    return folder


def has_compiled_functions(source: bytes) -> bool:
    """Return whether a file of this package has functions that are compiled, by its imports."""
    return re.search(rb"^(import numba|from deepracer_exp\.jit)\b", source, re.MULTILINE) is not None
