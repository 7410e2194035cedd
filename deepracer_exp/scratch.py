"""What a command keeps outside of its run folder while it runs: temporary files and named semaphores.

They lie in a folder of the command's own, or carry its name, so that the next command can clear away what a killed one
has left.
"""

import fcntl
import multiprocessing
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from multiprocessing import util
from pathlib import Path

_PREFIX = "deepracer_exp-"
_SHARED_MEMORY = Path("/dev/shm")
_LONGEST_BASE = 50
"""Bytes of the path above: the name of a fork server's socket, 55 below it, has at most 107 (unix(7))."""


def own_scratch() -> None:
    """Keep the temporary files of this process in a folder that ends with it; clear away those of killed processes.

    What it starts through `multiprocessing` uses the folder, too. Other programs do not: Ray finds its cluster in the
    usual one.
    """
    base = Path(tempfile.gettempdir())
    for left in base.glob(f"{_PREFIX}*"):
        _remove_if_unused(left)
    if len(os.fsencode(base)) > _LONGEST_BASE:
        return
    with suppress(OSError):
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=base))
        # Locked as long as this process or one that it forked lives; a command that cleared it away at this moment has
        # left nothing to lock.
        fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
        # After multiprocessing has removed its own (-100), and in this process, not in one that it forked.
        util.Finalize(None, shutil.rmtree, (folder, True), exitpriority=-200)
        tempfile.tempdir = str(folder)
        if sys.platform == "linux":  # elsewhere the name is too long
            multiprocessing.current_process()._config["semprefix"] = f"/{folder.name}"  # type: ignore[attr-defined]


def _remove_if_unused(folder: Path) -> None:
    with suppress(OSError):  # of another user, or in use
        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for semaphore in _SHARED_MEMORY.glob(f"sem.{folder.name}-*"):
                semaphore.unlink()
            shutil.rmtree(folder)
        finally:
            os.close(opened)
