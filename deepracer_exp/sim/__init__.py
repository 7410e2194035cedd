"""The car, its tyres, batched physics, camera and LIDAR.

MuJoCo loads the graphics library that MUJOCO_GL names while it is imported, and fails to be imported where that
fails. Only films are drawn with it; everything else works without.
"""

import os

try:
    import mujoco as mujoco
except Exception:  # noqa: BLE001 - graphics libraries raise anything; MuJoCo's own errors are raised again below
    os.environ["MUJOCO_GL"] = "disable"
    import mujoco as mujoco
