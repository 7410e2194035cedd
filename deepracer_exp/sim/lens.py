"""A pinhole camera on a car: the place of its eye and its direction."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.jit import njit

NEAREST_M = 0.02
"""Nothing nearer to the picture's plane is seen (deepracer-simapp, `bundle/models/camera/model.sdf`)."""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A pinhole camera bolted to the chassis.

    Attributes:
        width, height: of the picture, pixels.
        field_of_view_rad: horizontal.
        x_m, y_m, z_m: from the chassis origin: ahead, to the left, above the floor.
        pitch_rad: downwards.
    """

    width: int
    height: int
    field_of_view_rad: float
    x_m: float
    y_m: float
    z_m: float
    pitch_rad: float

    @property
    def mount(self) -> NDArray[np.float64]:
        """Place ahead, to the left and above, pitch, and focal length in pixels, (5,)."""
        focal = 0.5 * self.width / np.tan(0.5 * self.field_of_view_rad)
        return np.array([self.x_m, self.y_m, self.z_m, self.pitch_rad, focal])


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def view(pose, mount, rotation):  # type: ignore[no-untyped-def]
    """Return the eye of a camera in the world, and its picture's axis, right and bottom.

    Args:
        pose: of the chassis, (5,), see `camera.take_pictures`.
        mount: of the camera, (5,), see `Lens.mount`.
        rotation: (3, 3), overwritten.
    """
    mount_x, mount_y, mount_z, tilt, _ = mount
    cos, sin = np.cos(tilt), np.sin(tilt)
    _rotation(pose[2], pose[3], pose[4], rotation)
    eye_x = pose[0] + rotation[0, 0] * mount_x + rotation[0, 1] * mount_y + rotation[0, 2] * mount_z
    eye_y = pose[1] + rotation[1, 0] * mount_x + rotation[1, 1] * mount_y + rotation[1, 2] * mount_z
    eye_z = rotation[2, 0] * mount_x + rotation[2, 1] * mount_y + rotation[2, 2] * mount_z
    axis = (
        rotation[0, 0] * cos - rotation[0, 2] * sin,
        rotation[1, 0] * cos - rotation[1, 2] * sin,
        rotation[2, 0] * cos - rotation[2, 2] * sin,
    )
    down = (
        -rotation[0, 0] * sin - rotation[0, 2] * cos,
        -rotation[1, 0] * sin - rotation[1, 2] * cos,
        -rotation[2, 0] * sin - rotation[2, 2] * cos,
    )
    return (eye_x, eye_y, eye_z), axis, (-rotation[0, 1], -rotation[1, 1], -rotation[2, 1]), down


@njit(cache=True)
def _rotation(yaw, pitch, roll, out):  # type: ignore[no-untyped-def]
    """Write the matrix whose columns are ahead, left and up of a chassis: roll, then pitch, then yaw."""
    cos_y, sin_y = np.cos(yaw), np.sin(yaw)
    cos_p, sin_p = np.cos(pitch), np.sin(pitch)
    cos_r, sin_r = np.cos(roll), np.sin(roll)
    out[0, 0] = cos_y * cos_p
    out[1, 0] = sin_y * cos_p
    out[2, 0] = -sin_p
    out[0, 1] = cos_y * sin_p * sin_r - sin_y * cos_r
    out[1, 1] = sin_y * sin_p * sin_r + cos_y * cos_r
    out[2, 1] = cos_p * sin_r
    out[0, 2] = cos_y * sin_p * cos_r + sin_y * sin_r
    out[1, 2] = sin_y * sin_p * cos_r - cos_y * sin_r
    out[2, 2] = cos_p * cos_r
