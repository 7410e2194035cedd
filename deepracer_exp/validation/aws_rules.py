"""Checks of a reward function's text by AWS: deepracer-on-aws' validator, and the console's documentation."""

import ast
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import pycodestyle
from pyflakes.checker import Checker as Flakes

Rule = Literal["documented", "validator", "style"]
"""Whose rule it is.

- documented: AWS's developer guide has it, and the validator of deepracer-on-aws checks it.
- validator: only that validator has it, as far as anybody outside AWS knows.
- style: flake8, which that validator runs. The AWS console trained functions with such findings (E302, F401).
"""


@dataclass(frozen=True, order=True)
class AwsFinding:
    """A reason for which deepracer-on-aws refuses a reward function."""

    line: int
    """Counted from 1; 0: the whole file, or a place that the text names."""
    text: str
    rule: Rule = "validator"

    def __str__(self) -> str:
        """Return `line N: text`."""
        return f"line {self.line}: {self.text}" if self.line else self.text


LONGEST = 140_000
"""Most characters of code that deepracer-on-aws takes (its model.smithy)."""
IMPORTS = ("math", "random", "numpy", "scipy", "shapely")
BUILTINS = ("open", "exec", "eval", "compile", "input")
WORDS = (
    *("__import__", "load", "fromfile", "genfromtxt", "loadtxt", "tofile", "savez", "save", "savetxt"),
    "memmap",
)
"""Forbidden anywhere in the text, even as part of a longer word."""
_NOT_READ = (
    "the validator reads only calls and attributes that begin with a name; give this part a name first"
)


def text_findings(text: str) -> list[AwsFinding]:
    """Return the reasons, by line, why deepracer-on-aws would refuse the text of a reward function.

    The rules are those of its source/libs/reward-function-validation. The text must be valid Python. What that
    validator finds by calling the function is in `aws_dry_run`.
    """
    findings: list[AwsFinding] = []
    if len(text) > LONGEST:
        findings.append(AwsFinding(0, f"{len(text):,} characters of code; at most {LONGEST:,} are accepted"))
    tree = ast.parse(text)
    return sorted({*findings, *_imports(tree), *_calls(tree), *_words(text), *style_findings(text)})


def _imports(tree: ast.Module) -> Iterator[AwsFinding]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or "."]
        else:
            continue
        for name in names:
            if name.split(".")[0] not in IMPORTS:
                text = f"import of {name}; allowed are {', '.join(IMPORTS)}"
                yield AwsFinding(node.lineno, text, "documented")


def _calls(tree: ast.Module) -> Iterator[AwsFinding]:
    for node, name in _dotted_names(tree):
        if name is None:
            yield AwsFinding(node.lineno, f"{_shortened(node)}: {_NOT_READ}")
        elif name in BUILTINS:
            yield AwsFinding(node.lineno, f"use of {name}, which is forbidden")


def _dotted_names(node: ast.AST) -> Iterator[tuple[ast.expr, str | None]]:
    """Yield each chain of calls and attributes with its name (`a(x).b`: a.b); None if it does not begin with a name.

    As the validator does it: keyword arguments, and what else a chain begins with, are not looked into.
    """
    if not isinstance(node, ast.Call | ast.Attribute):
        for child in ast.iter_child_nodes(node):
            yield from _dotted_names(child)
        return
    names: list[str] = []
    first: ast.expr = node
    while isinstance(first, ast.Call | ast.Attribute):
        if isinstance(first, ast.Attribute):
            names.append(first.attr)
            first = first.value
        else:
            for argument in first.args:
                yield from _dotted_names(argument)
            first = first.func
    yield node, ".".join([first.id, *reversed(names)]) if isinstance(first, ast.Name) else None


def _shortened(node: ast.expr) -> str:
    text = ast.unparse(node)
    return text if len(text) <= 40 else f"{text[:39]}…"


def _words(text: str) -> Iterator[AwsFinding]:
    # The longest first, so that `loadtxt` is reported as itself and not as `load`.
    words = sorted(WORDS, key=len, reverse=True)
    for number, line in enumerate(text.split("\n"), 1):
        for token in re.findall(r"\w+", line):
            word = next((word for word in words if word in token), None)
            if word is not None:
                inside = f" (in {token})" if token != word else ""
                yield AwsFinding(number, f"the word {word}{inside}, forbidden anywhere in the text")


_IGNORED = ("W", "E5", "E226", "E261")
"""The validator runs flake8 with the codes E and F without these (its test_reward_function.py)."""
_NOQA = re.compile(r"#\s*noqa(?::(?P<codes>[\s\w,]+))?", re.IGNORECASE)


class _Report(pycodestyle.BaseReport):
    """Keeps every finding, where the base class only counts them."""

    def __init__(self, options: Any) -> None:
        super().__init__(options)
        self.found: list[AwsFinding] = []

    def error(self, line_number: int, offset: int, text: str, check: Any) -> str | None:
        # The base class returns None for ignored codes.
        code: str | None = super().error(line_number, offset, text, check)
        if code:
            self.found.append(AwsFinding(line_number, text, "style"))
        return code


def style_findings(text: str) -> list[AwsFinding]:
    """Return flake8's E and F findings in valid Python, as pycodestyle and pyflakes report them, by line.

    Lines with a comment `# noqa` are skipped, as in flake8.
    """
    lines = io.StringIO(text).readlines()  # splitlines would also split at form feeds
    guide = pycodestyle.StyleGuide(ignore=list(_IGNORED), reporter=_Report)
    pycodestyle.Checker(lines=lines, options=guide.options).check_all()
    codes = {(finding, finding.text[:4]) for finding in guide.options.report.found}
    for message in Flakes(ast.parse(text)).messages:
        codes.add((AwsFinding(message.lineno, f"F {message.message % message.message_args}", "style"), "F"))
    return sorted(finding for finding, code in codes if not _excused(lines, finding.line, code))


def _excused(lines: list[str], line: int, code: str) -> bool:
    match = _NOQA.search(lines[line - 1]) if 0 < line <= len(lines) else None
    if match is None:
        return False
    codes = re.findall(r"[A-Z]+[0-9]*", (match["codes"] or "").upper())
    # pyflakes' messages lack flake8's numbers: any F code excuses them.
    return not codes or any(code.startswith(c) if code != "F" else c.startswith("F") for c in codes)
