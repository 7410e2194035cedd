"""Libraries are used by their public interface; docs/architecture.md lists the exceptions."""

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import deepracer_exp

TOP = Path(deepracer_exp.__file__).parent
LIBRARIES = {
    *(
        "torch",
        "torchrl",
        "tensordict",
        "mlflow",
        "numba",
        "multiprocessing",
        "ray",
        "optuna",
        "mujoco",
        "pandas",
    ),
    *(
        "pyarrow",
        "hydra",
        "omegaconf",
        "rich",
        "numpy",
        "scipy",
        "gymnasium",
        "stable_baselines3",
        "sqlalchemy",
    ),
}
TO_OVERRIDE = {"_reset", "_step", "_set_seed"}
"""Methods that TorchRL's documentation asks every environment for."""
_ROW = re.compile(r"^\| `([\w/]+\.py)` \| ([^|]+) \|", re.MULTILINE)


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def root_of(node: ast.expr) -> str:
    """Return the name with which an expression such as `a.b().c` begins."""
    while not isinstance(node, ast.Name):
        if isinstance(node, ast.Attribute | ast.Subscript):
            node = node.value
        elif isinstance(node, ast.Call):
            node = node.func
        else:
            return ""
    return node.id


def private_names(file: Path) -> Iterator[str]:
    """Yield the private names of libraries that a file reads, calls or overrides."""
    tree = ast.parse(file.read_text())
    imported: dict[str, tuple[str, str | None]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                imported[alias.asname or alias.name.partition(".")[0]] = alias.name, None
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                imported[alias.asname or alias.name] = str(node.module), alias.name
    imported = {name: of for name, of in imported.items() if of[0].partition(".")[0] in LIBRARIES}
    for module, name in imported.values():
        yield from filter(is_private, [*module.split("."), name or ""])
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr) and root_of(node.value) in imported:
            yield node.attr
        if not isinstance(node, ast.ClassDef):
            continue
        for base in node.bases:
            if isinstance(base, ast.Name) and base.id in imported:
                module, name = imported[base.id]
                names = set(dir(getattr(importlib.import_module(module), str(name))))
                used = {inner.name for inner in node.body if isinstance(inner, ast.FunctionDef)} | {
                    inner.attr
                    for inner in ast.walk(node)
                    if isinstance(inner, ast.Attribute) and root_of(inner.value) in ("self", "super", "cls")
                }
                yield from sorted(filter(is_private, used & names - TO_OVERRIDE))


def test_private_names_of_libraries_are_used_in_the_listed_files_alone():
    table = (
        (TOP.parent / "docs" / "architecture.md").read_text().partition("## Private names of libraries")[2]
    )
    rows = {match[1]: set(re.findall(r"`(_\w+)`", match[2])) for match in _ROW.finditer(table)}
    listed = {file: names for file, names in rows.items() if names}
    found = {str(file.relative_to(TOP.parent)): set(private_names(file)) for file in TOP.rglob("*.py")}
    assert listed == {name: names for name, names in found.items() if names}
