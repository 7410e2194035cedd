"""Print what other libraries are in a process, function by function, as JSON; run as a program of its own.

Arguments are the modules to import first. On standard input come the libraries' modules that are then compared, one a
line; without any, they are all that are there.
"""

import gc
import importlib
import json
import logging
import multiprocessing
import os
import signal
import sys
import warnings
from types import FunctionType
from typing import Any

OURS = "deepracer_exp"
LIBRARIES = {
    *(
        "torch",
        "torchrl",
        "tensordict",
        "numpy",
        "numba",
        "pandas",
        "pyarrow",
        "scipy",
        "mujoco",
        "gymnasium",
    ),
    *(
        "optuna",
        "hydra",
        "omegaconf",
        "rich",
        "ray",
        "multiprocessing",
        "pickle",
        "os",
        "tempfile",
        "threading",
    ),
}


def described(value: Any) -> Any:
    """Return where a function, or each function of a class, was written; None of other values."""
    if issubclass(type(value), type):
        methods = {name: described_function(method) for name, method in vars(value).items()}
        return [value.__module__, value.__qualname__, {name: at for name, at in methods.items() if at}]
    return described_function(value)


def described_function(value: Any) -> str | None:
    function = value
    if type(value) is property:
        function = value.fget
    elif type(value) in (classmethod, staticmethod):
        function = value.__func__
    if type(function) is not FunctionType:
        return None
    return f"{function.__qualname__} of {function.__code__.co_filename}:{function.__code__.co_firstlineno}"


def main() -> None:
    """Import and print."""
    for module in sys.argv[1:]:
        importlib.import_module(module)
    names = sys.stdin.read().split() or [name for name in sys.modules if name.partition(".")[0] in LIBRARIES]
    functions = {}
    for name in names:
        importlib.import_module(name)
    for name in names:
        found = {key: described(value) for key, value in list(vars(sys.modules[name]).items())}
        functions[name] = {key: at for key, at in found.items() if at}
    loggers = {"": logging.root, **logging.root.manager.loggerDict}
    process = {
        "environment": dict(os.environ),
        "files": {name: getattr(sys.modules[name], "__file__", None) for name in names},
        "warnings": sorted({str(entry) for entry in warnings.filters}),
        "loggers": {
            name: [logger.level, len(logger.handlers)]
            for name, logger in loggers.items()
            if name.partition(".")[0] in LIBRARIES | {""} and isinstance(logger, logging.Logger)
        },
        "start method": multiprocessing.get_start_method(allow_none=True),
        "signals": [str(signal.getsignal(number)) for number in sorted(signal.valid_signals())],
        "garbage": [gc.isenabled(), *gc.get_threshold()],
        "hooks": [sys.excepthook.__qualname__, *(type(finder).__qualname__ for finder in sys.meta_path)],
        "threads": sys.modules["torch"].get_num_threads(),
        "compiled code": sys.modules["numba"].config.CACHE_DIR,
    }
    print(json.dumps([functions, process]))


if __name__ == "__main__":
    main()
