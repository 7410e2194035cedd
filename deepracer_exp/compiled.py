"""Numba's `njit`, whose code on disk is compiled again when anything that it was compiled from has changed.

Numba looks at the file of a function alone. Functions and constants of other files are part of its code, too: after an
update of the tyres alone cars would still drive on the old ones.
"""

import functools
import hashlib
import os
import tempfile
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np
from numba import njit
from numba.core.caching import (
    CacheImpl,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)
from numba.core.dispatcher import Dispatcher

__all__ = ["compiled", "njit"]

# Divisions as NumPy's: a check for zero at each would keep loops from being optimized.
compiled = njit(cache=True, nogil=True, error_model="numpy")

_PACKAGE = Path(__file__).parent
_COMPILED_IN = (bool, int, float, np.dtype)
"""Kinds of a module's values that become part of the code."""


def source_stamp(function: FunctionType) -> str:
    """Return a hash of a function's file and of the compiled functions and constants that the file has imported.

    They are those at the moment of the call; files import before they define.
    """
    about = function.__globals__
    parts = [_content(function.__code__.co_filename)]
    for name, value in sorted(about.items()):
        if isinstance(value, Dispatcher) and value.py_func.__globals__ is not about:
            parts.append(_imported(value.py_func).encode())
        elif isinstance(value, _COMPILED_IN):
            parts.append(f"{name}={value!r}".encode())
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


_imported = functools.cache(source_stamp)


@functools.cache
def _content(file: str) -> bytes:
    return Path(file).read_bytes()


def _of_package(locator: Any) -> Any:
    """Return a locator of compiled code for functions of this package."""

    class Locator(locator):
        def __init__(self, function: FunctionType, file: str) -> None:
            super().__init__(function, file)
            self._stamp = source_stamp(function)

        def get_source_stamp(self) -> str:
            return self._stamp

        @classmethod
        def from_function(cls, function: FunctionType, file: str) -> Any:
            return super().from_function(function, file) if Path(file).is_relative_to(_PACKAGE) else None

    return Locator


# Numba has no public way to add one: its environment variable replaces them in all packages.
CacheImpl._locator_classes[:0] = map(
    _of_package, (UserProvidedCacheLocator, InTreeCacheLocator, UserWideCacheLocator)
)


def _can_keep() -> bool:
    """Return whether there is a folder for compiled code: in the package, or in the user's own."""
    try:
        njit(cache=True)(_can_keep)
    except RuntimeError:
        return False
    return True


if not _can_keep():
    # Of this process and those that it starts: what others could write into would be run.
    _for_now = tempfile.TemporaryDirectory(prefix="compiled-", ignore_cleanup_errors=True)
    numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = _for_now.name
