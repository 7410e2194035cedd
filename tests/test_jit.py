"""Cars never drive on compiled code of other sources than those that are there."""

import ast
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import deepracer_exp
from deepracer_exp import cache, jit

BRAKES = """
    import numpy as np

    from deepracer_exp.jit import njit

    FRICTION = {friction}
    SHARES = {shares}
    LIMITS = np.array({limits})

    @njit(cache=True)
    def slowed(speed):
        return {factor} * speed
"""
CAR = """
    from deepracer_exp.jit import njit
    from deepracer_exp.sim.brakes import FRICTION, LIMITS, SHARES, slowed

    @njit(cache=True)
    def drive(speed):
        return min(SHARES[0] * stop(speed) - FRICTION, LIMITS[0])

    @njit(cache=True)
    def stop(speed):
        return slowed(speed)
"""

COMPILERS = {"njit", "cfunc", "compiled", "inlined"}
VALUES = {"factor": 0.5, "friction": 1.0, "shares": (1.0, 1.0), "limits": [9.0]}


def driven(package: Path, **variables: str) -> tuple[float, int]:
    """Drive in a new process and return the speed, and how many signatures were taken from the disk."""
    code = "from deepracer_exp.sim.mujoco_model import drive; print(drive(8.0), sum(drive.stats.cache_hits.values()))"
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    made = subprocess.run(
        # Without bytecode: one of a file of the same second and size would be taken for the changed file's.
        [sys.executable, "-B", "-c", code],
        cwd=package.parent,
        env=environment | {"XDG_CACHE_HOME": str(package.parent / "cache")} | variables,
        check=True,
        capture_output=True,
        text=True,
    )
    speed, hits = made.stdout.split()
    return float(speed), int(hits)


@pytest.fixture
def package(tmp_path) -> Path:
    """Write a package with the two files."""
    package = tmp_path / "deepracer_exp"
    (package / "sim").mkdir(parents=True)
    for place in (package, package / "sim"):
        (place / "__init__.py").touch()
    for module in (jit, cache):
        file = Path(module.__file__)
        (package / file.name).write_text(file.read_text())
    (package / "sim" / "brakes.py").write_text(textwrap.dedent(BRAKES).format(**VALUES))
    (package / "sim" / "mujoco_model.py").write_text(textwrap.dedent(CAR))
    return package


def test_code_on_disk_is_that_of_all_files_it_was_compiled_from(package):
    brakes = package / "sim" / "brakes.py"
    assert driven(package) == (3.0, 0)
    assert driven(package) == (3.0, 1)
    changes = [({"factor": 0.25}, 1.0), ({"friction": 3.0}, 1.0), ({"shares": (0.5, 1.0)}, 1.0)]
    for changed, speed in (*changes, ({"limits": [2.0]}, 2.0)):
        brakes.write_text(textwrap.dedent(BRAKES).format(**VALUES | changed))
        assert driven(package) == (speed, 0)
    assert driven(package) == (speed, 1)
    assert len(list((package.parent / "cache" / "deepracer_exp").iterdir())) == 5
    assert not list(package.rglob("*.nb?"))


def test_code_is_kept_where_numba_is_asked_to_keep_it(package, tmp_path):
    assert driven(package, NUMBA_CACHE_DIR=str(tmp_path / "numba")) == (3.0, 0)
    assert list((tmp_path / "numba").glob("compiled-*/*/mujoco_model.drive-*.nbi"))
    assert not (tmp_path / "cache").exists()


def test_code_is_compiled_in_memory_where_no_folder_can_be_written(package):
    assert driven(package, XDG_CACHE_HOME="/dev/null/cache") == (3.0, 0)
    assert not list(package.rglob("*.nb?"))


def test_a_command_says_in_one_line_that_code_cannot_be_kept():
    code = """
from deepracer_exp.commands.output import print_start, warnings_on_stderr
print_start()
with warnings_on_stderr():
    pass
"""
    made = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"NUMBA_CACHE_DIR": "/dev/null/cache"},
        check=True,
        capture_output=True,
        text=True,
    )
    line, started = made.stderr.splitlines()
    assert line.startswith(
        "warning: each command compiles the physics again, for about 20 s: NUMBA_CACHE_DIR"
    )
    assert started == "starting: loading PyTorch and MuJoCo"


def test_folders_of_compiled_code_that_are_no_longer_used_are_removed(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for number in range(25):
        (tmp_path / f"compiled-{number}").mkdir()
        os.utime(tmp_path / f"compiled-{number}", (number, number))
    (tmp_path / "of_another_package").mkdir()
    new = cache.compiled_folder.__wrapped__()
    kept = {f"compiled-{number}" for number in range(6, 25)} | {new.name, "of_another_package"}
    assert {path.name for path in tmp_path.iterdir()} == kept


def names_in(node: ast.AST) -> set[str]:
    return {inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)}


def used_by_compiled_functions(tree: ast.Module) -> set[str]:
    """Return the names of a file that its compiled functions use, and those that their values are made from."""
    used, makes = set(), {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and any(
            COMPILERS & names_in(decorator) for decorator in node.decorator_list
        ):
            used |= names_in(node)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            makes[node.name] = names_in(node)
        elif isinstance(node, ast.Assign):
            makes |= {name: names_in(node.value) for target in node.targets for name in names_in(target)}
    reached = set()
    while used:
        reached.add(name := used.pop())
        used |= makes.get(name, set()) - reached
    return reached


def test_the_folder_is_named_by_all_files_of_which_compiled_functions_use_something():
    top = Path(deepracer_exp.__file__).parent
    hashed = {
        ".".join(file.relative_to(top.parent).with_suffix("").parts): ast.parse(file.read_bytes())
        for file in top.rglob("*.py")
        if cache.has_compiled_functions(file.read_bytes())
    }
    assert {"deepracer_exp.jit", "deepracer_exp.sim.tyres"} <= hashed.keys()
    others = set()
    for name, tree in hashed.items():
        used = used_by_compiled_functions(tree)
        for node in tree.body:
            if not isinstance(node, ast.Import | ast.ImportFrom):
                continue
            imported = {alias.asname or alias.name: alias.name for alias in node.names}
            if isinstance(node, ast.ImportFrom):
                package = ".".join(name.split(".")[: -node.level]) + "." if node.level else ""
                imported = dict.fromkeys(imported, f"{package}{node.module}")
            others |= {imported[each] for each in used & imported.keys()}
    assert "deepracer_exp.tracks.segments" in others
    # Of numpy the version is in the name, too.
    assert others - hashed.keys() <= {"math", "numpy", "numpy.typing", "functools", "typing"}
