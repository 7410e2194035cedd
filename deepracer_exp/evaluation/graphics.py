"""Choose MuJoCo's offscreen renderer; to be called before MuJoCo is imported."""

import ctypes.util
import os
import sys

from deepracer_exp.errors import BadInput


def choose_graphics() -> None:
    """Set MUJOCO_GL to a library this machine has, unless it is set already.

    Raises:
        BadInput: the machine has no such library.
    """
    if os.environ.get("MUJOCO_GL") or sys.platform != "linux":
        return
    for name, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if ctypes.util.find_library(library):
            os.environ["MUJOCO_GL"] = name
            return
    raise BadInput(
        "--video: this machine has neither EGL nor OSMesa to draw with; install libegl1 (with libgl1-mesa-dri) or "
        "libosmesa6, or set MUJOCO_GL"
    )
