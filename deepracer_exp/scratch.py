"""What a command keeps outside of its run folder while it runs: temporary files.

They lie in a folder of the command's own, so that the next command can clear away what a killed one has left.
"""

import atexit
import fcntl
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_PREFIX = "deepracer_exp-"
_LONGEST_BASE = 50
"""Bytes of the path above: the name of a fork server's socket, 55 below it, has at most 107 (unix(7))."""


def own_scratch() -> None:
    """Keep the temporary files of this process in a folder that ends with it; clear away those of killed processes.

    What it starts through `multiprocessing` uses the folder, too. Other programs do not: Ray finds its cluster in the
    usual one.
    """
    base = Path(tempfile.gettempdir())
    clear(base, _PREFIX)
    if len(os.fsencode(base)) > _LONGEST_BASE:
        return
    with suppress(OSError):
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=base))
        _hold(folder)
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        tempfile.tempdir = str(folder)


@contextmanager
def folder_aside(parent: Path, prefix: str) -> Iterator[Path]:
    """Make a folder for what is moved into place whole, with a name that begins with `prefix`; remove what is left.

    What killed commands have left of such folders is removed, too.

    Raises:
        OSError: it cannot be made.
    """
    clear(parent, prefix)
    folder = parent / f"{prefix}{uuid.uuid4().hex}"
    folder.mkdir()
    held = _hold(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def clear(parent: Path, prefix: str) -> None:
    """Remove the folders of this user whose names begin so and that no process holds."""
    for folder in parent.iterdir():
        if not folder.name.startswith(prefix):
            continue
        with suppress(OSError):  # in use
            opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                if os.fstat(opened).st_uid == os.getuid():
                    fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(folder)
            finally:
                os.close(opened)


def _hold(folder: Path) -> int:
    """Lock a folder as long as this process or one that it forked lives; return what holds it.

    Raises:
        OSError: a command that clears has taken it at this moment.
    """
    opened = os.open(folder, os.O_RDONLY)
    fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return opened
