"""Physics needs no graphics library, whatever MUJOCO_GL says; only films do."""

import os
import subprocess
import sys

import pytest

STEP = (
    "import deepracer_exp.sim.batch; from deepracer_exp.evaluation.video import can_draw; print(can_draw())"
)


@pytest.mark.skipif(sys.platform != "linux", reason="names of libraries on Linux")
@pytest.mark.parametrize("library", ["bogus", "osmesa", "glfw", "egl", "disable", ""])
def test_a_graphics_library_that_cannot_be_used_stops_nothing_else(library):
    env = {**os.environ, "MUJOCO_GL": library}
    env.pop("DISPLAY", None)
    done = subprocess.run([sys.executable, "-c", STEP], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in ("True", "False")
    if library in ("bogus", "glfw", "disable"):
        assert done.stdout.strip() == "False"
    assert done.stderr == ""
