"""Names and docstrings say what they mean to a reader who sees them alone."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PRODUCT = Path(__file__).parents[1] / "deepracer_exp"
REWARD_ZOO = PRODUCT.with_name("reward_zoo")
VAGUE = {"one", "found", "at", "known", "own", "given", "asked", "told", "heard"}
FRAGMENT = re.compile(r"(Of|Likewise|As for|The same|That of|Those of|It|Its|These)\b")
# A reward function returns a reward; arguments are "as for" another function.
DIALECT = re.compile(
    r"\b(pays?|whoever|somebody|nobody|anew|goes on|what came of)\b|\bas of `", re.IGNORECASE
)


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text())


def names_in(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


def docstrings_in(tree: ast.AST) -> Iterator[str]:
    """Yield the texts that stand alone: docstrings of modules, classes and functions, and those below an assignment."""
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            yield node.value.value


def test_a_name_says_what_it_holds():
    for file in PRODUCT.rglob("*.py"):
        vague = {name for name in names_in(parsed(file)) if name.strip("_") in VAGUE}
        # The number 1 beside the number 0 of compiled code.
        assert vague <= ({"one"} if file.name == "inner_loop.py" else set()), file


def test_a_docstring_names_its_subject():
    for file in PRODUCT.rglob("*.py"):
        fragments = [text for text in docstrings_in(parsed(file)) if FRAGMENT.match(text)]
        assert not fragments, file


def test_a_docstring_speaks_the_fields_language():
    for file in [*PRODUCT.rglob("*.py"), *REWARD_ZOO.glob("*.py")]:
        dialect = [text for text in docstrings_in(parsed(file)) if DIALECT.search(text)]
        assert not dialect, file
