"""The checks that the AWS console runs on a reward function before it starts a training."""

import ast
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pycodestyle
from pyflakes.checker import Checker as Flakes


@dataclass(frozen=True, order=True)
class ConsoleFinding:
    """One line the AWS console would reject."""

    line: int
    """Counted from 1; 0: the whole file."""
    text: str

    def __str__(self) -> str:
        """Return `line N: text`."""
        return f"line {self.line}: {self.text}" if self.line else self.text


_IGNORED = ("W", "E5", "E226", "E261")
"""The console runs flake8 with the codes E and F without these (deepracer-on-aws, test_reward_function.py)."""
_NOQA = re.compile(r"#\s*noqa(?::(?P<codes>[\s\w,]+))?", re.IGNORECASE)


class _Report(pycodestyle.BaseReport):
    """Keeps every finding, where the base class only counts them."""

    def __init__(self, options: Any) -> None:
        super().__init__(options)
        self.found: list[ConsoleFinding] = []

    def error(self, line_number: int, offset: int, text: str, check: Any) -> str | None:
        # The base class returns None for ignored codes.
        code: str | None = super().error(line_number, offset, text, check)
        if code:
            self.found.append(ConsoleFinding(line_number, text))
        return code


def style_findings(text: str) -> list[ConsoleFinding]:
    """Return flake8's E and F findings in valid Python, as pycodestyle and pyflakes report them, by line.

    Lines with a comment `# noqa` are skipped, as in flake8.
    """
    lines = io.StringIO(text).readlines()  # splitlines would also split at form feeds
    guide = pycodestyle.StyleGuide(ignore=list(_IGNORED), reporter=_Report)
    pycodestyle.Checker(lines=lines, options=guide.options).check_all()
    found = {(finding, finding.text[:4]) for finding in guide.options.report.found}
    for message in Flakes(ast.parse(text)).messages:
        found.add((ConsoleFinding(message.lineno, f"F {message.message % message.message_args}"), "F"))
    return sorted(finding for finding, code in found if not _excused(lines, finding.line, code))


def _excused(lines: list[str], line: int, code: str) -> bool:
    match = _NOQA.search(lines[line - 1]) if 0 < line <= len(lines) else None
    if match is None:
        return False
    codes = re.findall(r"[A-Z]+[0-9]*", (match["codes"] or "").upper())
    # pyflakes' messages lack flake8's numbers: any F code excuses them.
    return not codes or any(code.startswith(c) if code != "F" else c.startswith("F") for c in codes)


LONGEST = 140_000
"""Longest code the console accepts, in characters."""
IMPORTS = ("math", "random", "numpy", "scipy", "shapely")
BUILTINS = ("open", "exec", "eval", "compile", "input")
WORDS = (
    *("__import__", "load", "fromfile", "genfromtxt", "loadtxt", "tofile", "savez", "save", "savetxt"),
    "memmap",
)
"""Forbidden anywhere in the text, even as part of a longer word."""


def console_findings(text: str) -> list[ConsoleFinding]:
    """Return the reasons, by line, why the console would reject a reward function; empty if it would accept it.

    The rules are those of deepracer-on-aws, source/libs/reward-function-validation. Its dry run is left out:
    ours covers the same situations and more. The text must be valid Python.
    """
    found: list[ConsoleFinding] = []
    if len(text) > LONGEST:
        found.append(ConsoleFinding(0, f"{len(text):,} characters of code; at most {LONGEST:,} are accepted"))
    return sorted({*found, *_imports_and_builtins(ast.parse(text)), *_words(text), *style_findings(text)})


def _imports_and_builtins(tree: ast.Module) -> Iterator[ConsoleFinding]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id in BUILTINS:
            yield ConsoleFinding(node.lineno, f"use of {node.id}, which is forbidden")
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = ["." * node.level + (node.module or "")]
        else:
            continue
        for name in names:
            if name.split(".")[0] not in IMPORTS:
                yield ConsoleFinding(node.lineno, f"import of {name}; allowed are {', '.join(IMPORTS)}")
        if node not in tree.body:
            yield ConsoleFinding(node.lineno, "an import that is not at the top of the file")


def _words(text: str) -> Iterator[ConsoleFinding]:
    # The longest first, so that `loadtxt` is reported as itself and not as `load`.
    words = sorted(WORDS, key=len, reverse=True)
    for number, line in enumerate(text.split("\n"), 1):
        for token in re.findall(r"\w+", line):
            word = next((word for word in words if word in token), None)
            if word is not None:
                inside = f" (in {token})" if token != word else ""
                yield ConsoleFinding(number, f"the word {word}{inside}, forbidden anywhere in the text")
