"""Checks of a reward function's text by AWS: deepracer-on-aws' validator, and the console's documentation."""

import ast
import io
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import pycodestyle
from pyflakes.checker import Checker as Flakes

Rule = Literal["documented", "validator", "style"]
"""The source of the rule.

- documented: AWS's developer guide has it, and the validator of deepracer-on-aws checks it.
- validator: only that validator has it, as far as is publicly known.
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
ARRAY_METHODS = frozenset(("all", "any", "clip", "max", "mean", "min", "prod", "std", "sum", "var"))
"""Methods of arrays for which NumPy's C code imports a module when they are called first."""
IMPORTING_FUNCTIONS = frozenset(
    f"numpy.{name}"
    for name in (
        *("allclose", "array_equal", "array_equiv", "average", "clip", "corrcoef", "cov", "geomspace"),
        *("histogram", "isclose", "linalg.eig", "linalg.matrix_rank", "median", "nanargmax", "nanargmin"),
        *("nanmax", "nanmean", "nanmedian", "nanmin", "nanpercentile", "nanquantile", "nanstd", "nanvar"),
        *("percentile", "polydiv", "polyfit", "polymul", "quantile", "roots", "trapezoid", "trim_zeros"),
        "unique",
    )
) | {"scipy.optimize.lsq_linear"}
"""Functions that call such a method or have an import statement: of NumPy 2.3, and the one of SciPy in the zoo."""
_LATE = "is imported while the function is called; imports belong at the top of the file"
_BY_NUMPY = (
    "imports a module while the function is called; methods of arrays, such as x.sum(), x.max(), x.all(), do that, and "
    "a few functions; most, such as np.sum(x), do not"
)
_NOT_READ = (
    "the validator reads only calls and attributes that begin with a name; give this part a name first"
)


def text_findings(text: str) -> list[AwsFinding]:
    """Return the reasons, by line, why deepracer-on-aws would refuse the text of a reward function.

    The rules are those of its source/libs/reward-function-validation. The text must be valid Python. Its findings by
    calling the function are in `aws_dry_run`.
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


def late_imports(text: str, lines: Collection[int], loaded: Sequence[str]) -> list[AwsFinding]:
    """Return the imports while a function was called that executed these lines and loaded these modules, in order.

    The syntax tree has the import statements, and the calls that make NumPy import. A name of an array's method counts
    whatever it is called on, unless the text defines a function of that name.
    """
    tree = ast.parse(text)
    names = _imported_names(tree)
    methods = ARRAY_METHODS - {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    late: list[AwsFinding] = []
    by_numpy: list[AwsFinding] = []
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=aliases) if node.lineno in lines:
                late += (AwsFinding(node.lineno, f"{a.name} {_LATE}", "documented") for a in aliases)
            case ast.ImportFrom(module=module) if node.lineno in lines:
                late.append(AwsFinding(node.lineno, f"{module or '.'} {_LATE}", "documented"))
            case ast.Call(func=function) if node.lineno in lines:
                name = _full_name(function, names)
                if name in IMPORTING_FUNCTIONS or (
                    name is None and isinstance(function, ast.Attribute) and function.attr in methods
                ):
                    by_numpy.append(AwsFinding(node.lineno, f"{_shortened(function)} {_BY_NUMPY}"))
    if loaded and not late:  # the last one was requested, those before it are its own imports
        late.append(AwsFinding(0, f"{loaded[-1]} {_LATE}"))
    return late + by_numpy


def _imported_names(tree: ast.Module) -> dict[str, str]:
    """Return the full name of each imported name, such as numpy for np and numpy.mean for mean."""
    names: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.asname: alias.name for alias in node.names if alias.asname}
            names |= {
                alias.name.split(".")[0]: alias.name.split(".")[0] for alias in node.names if not alias.asname
            }
        elif isinstance(node, ast.ImportFrom):
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _full_name(node: ast.expr, names: Mapping[str, str]) -> str | None:
    """Return the full name of an imported name, or of an attribute of it; None for anything else."""
    if isinstance(node, ast.Attribute):
        owner = _full_name(node.value, names)
        return None if owner is None else f"{owner}.{node.attr}"
    return names.get(node.id) if isinstance(node, ast.Name) else None


def _calls(tree: ast.Module) -> Iterator[AwsFinding]:
    for node, name in _dotted_names(tree):
        if name is None:
            yield AwsFinding(node.lineno, f"{_shortened(node)}: {_NOT_READ}")
        elif name in BUILTINS:
            yield AwsFinding(node.lineno, f"use of {name}, which is forbidden")


def _dotted_names(node: ast.AST) -> Iterator[tuple[ast.expr, str | None]]:
    """Yield each chain of calls and attributes with its name (`a(x).b`: a.b); None if it does not begin with a name.

    As the validator does it: keyword arguments, and other beginnings of a chain, are not searched.
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
