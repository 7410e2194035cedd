"""Coverage of a reward function: executed lines, and statements never reached."""

import ast
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef)


class Coverage:
    """Record which lines of one file are executed inside the `with` block.

    A tracer that was active before (a debugger's, a coverage tool's) is suspended meanwhile.
    """

    def __init__(self, path: str):
        """Watch the functions of the file `path`, under which it was compiled."""
        self._path = path
        self._before: Any = None
        self.lines: set[int] = set()
        self.returned_at: int | None = None
        """The line from which the last call returned."""

    def __enter__(self) -> "Coverage":
        """Begin to watch."""
        self._before = sys.gettrace()
        sys.settrace(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        sys.settrace(self._before)

    def _called(self, frame: FrameType, event: str, arg: Any) -> Any:
        return self._executed if frame.f_code.co_filename == self._path else None

    def _executed(self, frame: FrameType, event: str, arg: Any) -> Any:
        if event == "line":
            self.lines.add(frame.f_lineno)
        elif event == "return":
            self.returned_at = frame.f_lineno
        return self._executed


def never_executed(text: str, lines: set[int]) -> list[tuple[int, int]]:
    """Return the statements that were never executed, as (first, last) lines, adjacent ones joined.

    Only functions of which some line was executed are considered; error handling is left out: handlers, `raise`,
    `assert`.
    """
    spans: list[tuple[int, int]] = []
    for function in ast.walk(ast.parse(text)):
        if isinstance(function, ast.FunctionDef):
            body = range(function.body[0].lineno, (function.end_lineno or 0) + 1)
            spans += [] if lines.isdisjoint(body) else _unexecuted(function.body, lines)
    missed: list[tuple[int, int]] = []
    for first, last in sorted(spans):  # functions in classes and in functions are walked last
        if missed and missed[-1][1] >= first - 1:
            missed[-1] = missed[-1][0], max(last, missed[-1][1])
        else:
            missed.append((first, last))
    return missed


def _unexecuted(body: list[ast.stmt], lines: set[int]) -> Iterator[tuple[int, int]]:
    for statement in body:
        first, last = statement.lineno, statement.end_lineno or statement.lineno
        if lines.isdisjoint(range(first, last + 1)):
            if not _has_no_line(statement):
                yield first, last
        elif not isinstance(statement, _FUNCTIONS):
            for block in ("body", "orelse", "finalbody"):
                yield from _unexecuted(getattr(statement, block, []), lines)
            for case in getattr(statement, "cases", []):
                yield from _unexecuted(case.body, lines)


def _has_no_line(statement: ast.stmt) -> bool:
    """Return whether a statement is not traced when it is executed, or need not be executed."""
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        return True  # a docstring
    return isinstance(
        statement, ast.Raise | ast.Assert | ast.Global | ast.Nonlocal | ast.Pass | ast.FunctionDef
    )
