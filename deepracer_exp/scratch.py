"""A command's temporary files and semaphores outside of its run folder.

The files lie in a folder of the command's own, so that the next command can clear the remains of a killed one.
"""

import atexit
import fcntl
import os
import re
import shutil
import signal
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_PREFIX = "deepracer_exp-"
_SEMAPHORE = re.compile(r"sem\.mp-[a-z0-9_]{8}")
"""Name of a semaphore of Python's `multiprocessing`; TorchRL makes four for cars in several processes."""
_LONGEST_BASE = 50
"""Longest parent path in bytes: a fork server's socket adds 55, and its path has at most 107 (unix(7))."""


def own_scratch() -> None:
    """Keep the temporary files of this process in a folder that ends with it; clear the remains of killed processes.

    Processes of `multiprocessing` use the folder, too. Other programs do not: Ray finds its cluster in the usual one.
    """
    base = Path(tempfile.gettempdir())
    clear(base, _PREFIX)
    clear_semaphores(Path("/dev/shm"))
    if len(os.fsencode(base)) > _LONGEST_BASE:
        return
    with suppress(OSError):
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=base))
        _hold(folder)
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        tempfile.tempdir = str(folder)


@contextmanager
def folder_aside(parent: Path, prefix: str) -> Iterator[Path]:
    """Make a folder whose content is moved into place whole, with a name that begins with `prefix`; remove the rest.

    Such folders of killed commands are removed, too.

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


def clear_semaphores(folder: Path) -> None:
    """Remove this user's semaphores of `multiprocessing` that no process has open; on Linux only.

    Python's resource tracker removes them, unless it is killed as well. A semaphore in use is open in the process that
    made it, so that one that no process has open is useless.
    """
    for file in folder.glob("sem.mp-*"):
        if not _SEMAPHORE.fullmatch(file.name):
            continue
        with suppress(OSError):  # in use
            opened = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                if os.fstat(opened).st_uid == os.getuid():
                    # A lease to read is refused as long as any process, also of another container, can write: fcntl(2).
                    # A process that opens the file meanwhile causes a signal, which would be SIGIO and end this
                    # process.
                    fcntl.fcntl(opened, fcntl.F_SETSIG, signal.SIGCHLD)
                    fcntl.fcntl(opened, fcntl.F_SETLEASE, fcntl.F_RDLCK)
                    file.unlink()
            finally:
                os.close(opened)


def _hold(folder: Path) -> int:
    """Lock a folder as long as this process or one that it forked lives; return the lock.

    Raises:
        OSError: another command is clearing it at this moment.
    """
    opened = os.open(folder, os.O_RDONLY)
    fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return opened
