"""Which tests a busy machine could fail, and a machine that is busy to run them on.

    python -m tests.busy_machine [--times 20] [--busy 12] [PYTEST_ARGUMENT...]

runs those that start processes, wait or read a clock twenty times beside twelve processes that compute, each time in
another order of the modules. It ends with the exit code of the first run that fails.
"""

import argparse
import dis
import inspect
import subprocess
import sys
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Any

import pytest

_OUTSIDE = {
    "multiprocessing",
    "psutil",
    "signal",
    "socket",
    "subprocess",
    "threading",
    "time",
    "tests.waiting",
}
"""Modules of what starts a process, waits, or reads a clock."""
_TESTS = "processes and not slow and not faults"


def depends_on_the_machine(item: pytest.Item) -> bool:
    """Return whether a test, or one of its fixtures, uses a module of `_OUTSIDE`."""
    rooms = [item.module]
    package = item.module.__name__
    while package := package.rpartition(".")[0]:
        if conftest := sys.modules.get(f"{package}.conftest"):
            rooms.append(conftest)
    fixtures = [getattr(room, name, None) for name in item.fixturenames for room in rooms]
    return any(_goes_outside(used, set()) for used in (item.function, *fixtures))


def _goes_outside(used: Any, seen: set[int]) -> bool:
    """Return whether a function, class or fixture of the tests, or one that it names, does."""
    used = inspect.unwrap(used)
    if id(used) in seen:
        return False
    seen.add(id(used))
    if (used.__name__ if isinstance(used, ModuleType) else getattr(used, "__module__", None)) in _OUTSIDE:
        return True
    if isinstance(used, type) and used.__module__.startswith("tests."):
        return any(_goes_outside(method, seen) for method in vars(used).values())
    if isinstance(used, FunctionType) and used.__module__.startswith("tests."):
        return bool(_imported(used.__code__)) or any(
            _goes_outside(used.__globals__.get(name), seen) for name in _names(used.__code__)
        )
    return False


@cache
def _names(code: CodeType) -> set[str]:
    return set(code.co_names).union(*map(_names, _within(code)))


@cache
def _imported(code: CodeType) -> set[str]:
    """Return the modules of `_OUTSIDE` that code imports."""
    lines = dis.get_instructions(code) if _OUTSIDE & {*code.co_names} else ()
    modules = {line.argval for line in lines if line.opname == "IMPORT_NAME"} & _OUTSIDE
    return modules.union(*map(_imported, _within(code)))


def _within(code: CodeType) -> list[CodeType]:
    return [one for one in code.co_consts if isinstance(one, CodeType)]


def main() -> int:
    """Run them; print a line a run."""
    parser = argparse.ArgumentParser(prog="python -m tests.busy_machine", description=__doc__)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--busy", type=int, default=12, help="processes that compute all the time")
    options, arguments = parser.parse_known_args()
    pytest_line = [sys.executable, "-m", "pytest", "-q", "-m", _TESTS, "-n", "2", "--dist", "worksteal"]
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(options.busy)]
    try:
        for turn in range(1, options.times + 1):
            done = subprocess.run([*pytest_line, f"--random-order-seed={turn}", *arguments], check=False)
            print(f"{turn} of {options.times}: exit code {done.returncode}", flush=True)
            if done.returncode:
                return done.returncode
    finally:
        for process in busy:
            process.kill()
    return 0


if __name__ == "__main__":
    sys.exit(main())
