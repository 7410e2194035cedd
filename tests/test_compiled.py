import os
import subprocess
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path

import pytest

BRAKES = """
    from deepracer_exp.compiled import njit

    FRICTION = {friction}

    @njit(cache=True)
    def slowed(speed):
        return {factor} * speed
"""
CAR = """
    from deepracer_exp.compiled import njit
    from deepracer_exp.sim.brakes import FRICTION, slowed

    @njit(cache=True)
    def drive(speed):
        return stop(speed) - FRICTION

    @njit(cache=True)
    def stop(speed):
        return slowed(speed)
"""


VALUES = {"factor": 0.5, "friction": 1.0}


def driven(package: Path, environment: Mapping[str, str] | None = None) -> tuple[float, int]:
    """Drive in a new process and return the speed, and how many signatures were taken from the disk."""
    code = "from deepracer_exp.sim.car import drive; print(drive(8.0), sum(drive.stats.cache_hits.values()))"
    made = subprocess.run(
        [sys.executable, "-c", code],
        cwd=package.parent,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    speed, hits = made.stdout.split()
    return float(speed), int(hits)


def written(folder: Path) -> Path:
    """Write a package with the two files."""
    import deepracer_exp.compiled

    package = folder / "deepracer_exp"
    (package / "sim").mkdir(parents=True)
    for place in (package, package / "sim"):
        (place / "__init__.py").touch()
    (package / "compiled.py").write_text(Path(deepracer_exp.compiled.__file__).read_text())
    (package / "sim" / "brakes.py").write_text(textwrap.dedent(BRAKES).format(**VALUES))
    (package / "sim" / "car.py").write_text(textwrap.dedent(CAR))
    return package


@pytest.mark.parametrize(("changed", "speed"), [({"factor": 0.25}, 1.0), ({"friction": 3.0}, 1.0)])
def test_code_on_disk_is_that_of_all_files_it_was_compiled_from(tmp_path, changed, speed):
    package = written(tmp_path)
    brakes = package / "sim" / "brakes.py"
    assert driven(package) == (3.0, 0)
    assert driven(package) == (3.0, 1)
    brakes.write_text(textwrap.dedent(BRAKES).format(**VALUES | changed))
    assert driven(package) == (speed, 0)
    assert driven(package) == (speed, 1)


def test_code_is_compiled_where_neither_the_package_nor_home_can_be_written(tmp_path):
    package = written(tmp_path)
    for folder in (package, package / "sim"):
        (folder / "__pycache__").touch()  # no folder, which stops root as well
    nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null/cache", "TMPDIR": str(tmp_path / "tmp")}
    (tmp_path / "tmp").mkdir()
    assert driven(package, os.environ | nowhere) == (3.0, 0)
    assert not list((tmp_path / "tmp").iterdir())
