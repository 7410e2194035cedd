"""Hundreds of AWS-DeepRacer-style racing experiments a day."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .api import Callback, Trainer, compose, evaluate, load_policy, make_env, read_run, train

__version__ = "0.1.0"
__all__ = [
    "Callback",
    "Trainer",
    "__version__",
    "compose",
    "evaluate",
    "load_policy",
    "make_env",
    "read_run",
    "train",
]


def __getattr__(name: str) -> Any:
    # Not before they are asked for: torch takes seconds to import, and the command line answers before that.
    if name in __all__:
        return getattr(import_module("deepracer_exp.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
