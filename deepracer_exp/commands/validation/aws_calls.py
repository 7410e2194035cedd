"""The process in which a reward function is called as deepracer-on-aws' validator calls it; see `aws_dry_run`.

It imports little itself, because a call's import goes unnoticed if the module is already loaded.
"""

import inspect
import json
import os
import reprlib
import signal
import sys
from contextlib import suppress
from typing import Any

import numpy as np

from deepracer_exp.rewards.time_limit import run_module, what_was_raised

from .coverage import Coverage

_TRACED = 10.0
"""Time limit of a call whose lines are recorded, over that of a plain call."""


def _main() -> None:
    """Read the calls from stdin, and write a line of JSON to stdout after each step: its name and result.

    The steps are `started`, `load`, `signature`, each situation and `imports`; the result is the error, or null. The
    process is killed in a step that takes more than its CPU time, whatever the function catches.
    """
    request = json.load(sys.stdin)
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of the function is not a result

    def answer(step: str, result: object = None) -> None:
        output.write(json.dumps([step, result]) + "\n")
        output.flush()

    answer("started")
    module = _Module(request)
    wrong = module.load()
    answer("load", wrong)
    if wrong is not None:
        return
    answer("signature", module.signature())
    loaded: list[str] | None = None
    for situation, params in request["situations"].items():
        before = set(sys.modules)
        answer(situation, module.call(_as_in_python(params)))
        if loaded is None:
            loaded = [name for name in sys.modules if name not in before]
    first = next(iter(request["situations"].values()))
    answer("imports", {"lines": _Module(request).executed_lines(_as_in_python(first)), "loaded": loaded})


class _Module:
    """A reward module in a namespace of its own."""

    def __init__(self, request: dict[str, Any]) -> None:
        self._path, self._limit_s, self._most = request["path"], request["limit_s"], request["most"]
        self._code = compile(request["text"], self._path, "exec", dont_inherit=True)
        self._namespace: dict[str, Any] = {"__name__": "reward_function", "print": _format}

    def load(self) -> str | None:
        """Run the module's text; return its error, if any."""
        _limit(self._limit_s)
        try:
            run_module(self._code, self._namespace)
            function = self._namespace.get("reward_function")
            return (
                None
                if inspect.isfunction(function)
                else f"reward_function is {reprlib.repr(function)}, no function"
            )
        except BaseException as error:  # noqa: BLE001 - of the module's code
            return f"cannot be imported: {what_was_raised(error, self._path)}"

    def signature(self) -> str | None:
        """Return the function's parameters unless there is exactly one."""
        signature = inspect.signature(self._namespace["reward_function"])
        return None if len(signature.parameters) == 1 else str(signature)

    def call(self, params: dict[str, Any]) -> str | None:
        """Run the module again and call the function; return the error of the answer, if any."""
        _limit(self._limit_s)
        try:
            reward = self._run(params)
            # The subclass np.float64 is one; a bool, an int or np.float32 is not.
            if isinstance(reward, float) and -self._most <= reward <= self._most:
                return None
            returned = f"returned {reprlib.repr(reward)} of type {type(reward).__name__}"
            _limit(self._limit_s * _TRACED)
            with Coverage(self._path) as coverage:
                self._run(params)
            accepted = f"a float from {-self._most:g} to {self._most:g}"
            return f"line {coverage.returned_at} {returned}; accepted: {accepted}"
        except BaseException as error:  # noqa: BLE001 - of the module's code
            return what_was_raised(error, self._path)

    def executed_lines(self, params: dict[str, Any]) -> list[int]:
        """Return the lines that a call executes, after the module is run."""
        _limit(self._limit_s * _TRACED)
        run_module(self._code, self._namespace)
        with Coverage(self._path) as coverage, suppress(BaseException):  # `call` has reported its errors
            self._namespace["reward_function"](params)
        return sorted(coverage.lines)

    def _run(self, params: dict[str, Any]) -> object:
        # What only a function has assigned (`global`) is kept.
        run_module(self._code, self._namespace)
        result: object = self._namespace["reward_function"](dict(params))
        return result


def _limit(cpu_s: float) -> None:
    """Have the kernel kill this process after an amount of CPU time from now (SIGPROF)."""
    signal.setitimer(signal.ITIMER_PROF, cpu_s)


def _as_in_python(params: dict[str, Any]) -> dict[str, Any]:
    """Return params from JSON with NumPy's types where the validator has them."""
    numbers = {name: np.float64(params[name]) for name in ("x", "y")}
    return params | numbers | {"waypoints": np.array(params["waypoints"])}


def _format(*values: object, **_: object) -> None:
    """Stand in for `print`: printed values must be printable there, too."""
    for value in values:
        str(value)


if __name__ == "__main__":
    _main()
