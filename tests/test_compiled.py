import subprocess
import sys
import textwrap
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


def driven(package: Path) -> tuple[float, int]:
    """Drive in a new process and return the speed, and how many signatures were taken from the disk."""
    code = "from deepracer_exp.sim.car import drive; print(drive(8.0), sum(drive.stats.cache_hits.values()))"
    made = subprocess.run(
        [sys.executable, "-c", code], cwd=package.parent, check=True, capture_output=True, text=True
    )
    speed, hits = made.stdout.split()
    return float(speed), int(hits)


@pytest.mark.parametrize(("changed", "speed"), [({"factor": 0.25}, 1.0), ({"friction": 3.0}, 1.0)])
def test_code_on_disk_is_that_of_all_files_it_was_compiled_from(tmp_path, changed, speed):
    import deepracer_exp.compiled

    package = tmp_path / "deepracer_exp"
    (package / "sim").mkdir(parents=True)
    for folder in (package, package / "sim"):
        (folder / "__init__.py").touch()
    (package / "compiled.py").write_text(Path(deepracer_exp.compiled.__file__).read_text())
    values = {"factor": 0.5, "friction": 1.0}
    brakes, car = package / "sim" / "brakes.py", package / "sim" / "car.py"
    brakes.write_text(textwrap.dedent(BRAKES).format(**values))
    car.write_text(textwrap.dedent(CAR))
    assert driven(package) == (3.0, 0)
    assert driven(package) == (3.0, 1)
    brakes.write_text(textwrap.dedent(BRAKES).format(**values | changed))
    assert driven(package) == (speed, 0)
    assert driven(package) == (speed, 1)
