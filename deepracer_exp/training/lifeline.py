"""Processes that end with the one that started them."""

import ctypes
import sys


def die_with_parent() -> None:
    """Have the kernel kill this process once its parent is dead, whatever it is doing; on Linux only."""
    if sys.platform == "linux":
        PR_SET_PDEATHSIG, SIGKILL = 1, 9
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, SIGKILL)
