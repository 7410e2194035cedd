"""The wheel installs one package, which brings the options, the reward zoo and the ready-made studies."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def contents(tmp_path_factory):
    """Names of the files in the project's wheel."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = folder.glob("*.whl")
    return zipfile.ZipFile(wheel).namelist()


def test_the_wheel_has_no_other_package(contents):
    tops = {name.partition("/")[0] for name in contents}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"deepracer_exp"}


@pytest.mark.parametrize(
    ("folder", "suffix"), [("conf", ".yaml"), ("reward_zoo", ".py"), ("sweeps", ".yaml")]
)
def test_the_wheel_has_every_file_that_a_name_may_mean(contents, folder, suffix):
    files = {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob(f"*{suffix}")}
    packed = {name.removeprefix("deepracer_exp/data/") for name in contents}
    assert files
    assert files <= packed
