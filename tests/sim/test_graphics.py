"""Physics needs no graphics library, whatever MUJOCO_GL says; only films do."""

import json
import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="names of libraries on Linux")

LIBRARIES = ("bogus", "")
"""One that MuJoCo refuses when it is imported, and its own choice, GLFW, which here has no display."""
STEP = """
import deepracer_exp.sim.batch
from deepracer_exp.evaluation.video import can_draw
print(can_draw())
"""
FILM = """
from pathlib import Path
from deepracer_exp.cli import main
from deepracer_exp.config.compose import compose_experiment
run = Path("runs/a/x")
(run / "checkpoints" / "000001").mkdir(parents=True)
(run / "checkpoints" / "last").symlink_to("000001")
(run / "config.yaml").write_text(compose_experiment([])[1].yaml())
main(["evaluate", str(run), "--video", "lap.mp4"])
"""

# What takes seconds to import is imported once, and a process forked for each call. MuJoCo is not among it: it reads
# the variable when it is imported.
FORKS = """
import json, os, sys, traceback
import hydra, numba, PIL, pyarrow, pydantic, requests, rich, scipy, shapely, torch
import torchrl
import deepracer_exp.config.compose, deepracer_exp.rewards.source, deepracer_exp.tracks.track
assert "mujoco" not in sys.modules
for number, (library, code) in enumerate(json.loads(sys.argv[1])):
    if child := os.fork():
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
        continue
    for stream in (1, 2):
        os.dup2(os.open(f"{number}-{stream}.txt", os.O_WRONLY | os.O_CREAT), stream)
    os.environ["MUJOCO_GL"] = library
    try:
        exec(code, {"__name__": "__main__"})
        code = 0
    except SystemExit as ended:
        code = ended.code
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
"""


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """Exit code, output and errors of a process for each library, and of a command that films without one."""
    folder = tmp_path_factory.mktemp("graphics")
    calls = [*((library, STEP) for library in LIBRARIES), ("disable", FILM)]
    env = {key: value for key, value in os.environ.items() if key != "DISPLAY"}
    done = subprocess.run(
        # From Python 3.12 on, a fork of a process with threads is warned of.
        [sys.executable, "-W", "ignore::DeprecationWarning:__main__", "-c", FORKS, json.dumps(calls)],
        cwd=folder, env=env, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    said = [
        [(folder / f"{number}-{stream}.txt").read_text() for stream in (1, 2)] for number in range(len(calls))
    ]
    codes = map(int, done.stdout.split())
    return dict(
        zip(
            (*LIBRARIES, "film"),
            ((code, *texts) for code, texts in zip(codes, said, strict=True)),
            strict=True,
        )
    )


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_graphics_library_that_cannot_be_used_stops_nothing_else(ended, library):
    code, out, err = ended[library]
    assert (code, err) == (0, "")
    assert out.strip() in ("True", "False")
    if library == "bogus":
        assert out.strip() == "False"


def test_a_library_that_cannot_draw_is_one_line_before_anything_is_driven(ended):
    code, _, err = ended["film"]
    assert code == 2
    assert err.startswith(
        "deepracer-exp: --video: MuJoCo cannot draw with MUJOCO_GL=disable here; accepted: "
    )
    assert err.count("\n") == 1
