"""Numba's `njit` and `cfunc`, with an on-disk cache that is invalidated by a change of any compiled source.

Numba's own cache checks only the file that defines a function, not those whose functions and constants are compiled
into it: after a change of the tyres alone, cars would still drive on the old ones. So the cache folder is named after a
hash of all these files.
"""

import threading
from collections.abc import Callable
from typing import Any

import numba
from numba import config

from deepracer_exp.cache import compiled_folder

_folder = compiled_folder()
_choosing = threading.RLock()


def njit(*, cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return numba's decorator of this name; with `cache`, code is kept if a folder for it can be written."""
    return _kept(numba.njit(cache=cache and _folder is not None, **options))


def cfunc(signature: str, *, cache: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Return numba's decorator of this name; with `cache`, code is kept if a folder for it can be written."""
    return _kept(numba.cfunc(signature, cache=cache and _folder is not None))


def _kept(decorate: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Cache this package's code in its own folder; that of other packages stays where numba keeps it."""

    def decorated(function: Callable[..., Any]) -> Any:
        # Numba chooses a function's folder when it is decorated.
        with _choosing:
            usual = config.CACHE_DIR
            config.CACHE_DIR = str(_folder or usual)
            try:
                return decorate(function)
            finally:
                config.CACHE_DIR = usual

    return decorated


# Divisions as NumPy's: a check for zero at each would keep loops from being optimized.
compiled = njit(cache=True, nogil=True, error_model="numpy")
