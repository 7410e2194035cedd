"""What the AWS console would say of a reward function before it lets a training begin."""

import ast
import re
from collections.abc import Iterator

from .findings import Finding
from .style import style_findings

LONGEST = 140_000
"""Characters of code the console takes."""
IMPORTS = ("math", "random", "numpy", "scipy", "shapely")
BUILTINS = ("open", "exec", "eval", "compile", "input")
WORDS = (
    *("__import__", "load", "fromfile", "genfromtxt", "loadtxt", "tofile", "savez", "save", "savetxt"),
    "memmap",
)
"""Forbidden anywhere in the text, even inside a longer word."""


def console_findings(text: str) -> list[Finding]:
    """Return why the console would refuse a reward function, by line; an empty list: it would not.

    The rules are those of deepracer-on-aws, source/libs/reward-function-validation. Its dry run is not among
    them: ours has the same situations and more. The text must be valid Python.
    """
    found: list[Finding] = []
    if len(text) > LONGEST:
        found.append(Finding(0, f"{len(text):,} characters of code; at most {LONGEST:,} are taken"))
    tree = ast.parse(text)
    found += _imports(tree)
    found += _builtins(tree)
    found += _words(text)
    return sorted({*found, *style_findings(text)})


def _imports(tree: ast.Module) -> Iterator[Finding]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = ["." * node.level + (node.module or "")]
        else:
            continue
        for name in names:
            if name.split(".")[0] not in IMPORTS:
                yield Finding(node.lineno, f"import of {name}; allowed are {', '.join(IMPORTS)}")
        if node not in tree.body:
            yield Finding(node.lineno, "an import that is not at the top of the file")


def _builtins(tree: ast.Module) -> Iterator[Finding]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id in BUILTINS:
            yield Finding(node.lineno, f"use of {node.id}, which is forbidden")


def _words(text: str) -> Iterator[Finding]:
    # The longest first, so that `loadtxt` is told as itself and not as `load`.
    words = sorted(WORDS, key=len, reverse=True)
    for number, line in enumerate(text.splitlines(), 1):
        for token in re.findall(r"\w+", line):
            word = next((word for word in words if word in token), None)
            if word is not None:
                inside = f" (in {token})" if token != word else ""
                yield Finding(number, f"the word {word}{inside}, forbidden anywhere in the text")
