"""The LIDAR of all cars at once: rays cast in the plane against the segments of walls and of the boxes' sides."""

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.jit import njit

from .scenery import box_corners

RAYS = 64
ANGLES_RAD = np.linspace(-2.61799, 2.61799, RAYS)
"""Angles of the rays from the sensor's middle direction, the rightmost first (these numbers and the next two:
deepracer-simapp, `bundle/markov/sensors/constants.py`)."""
NEAREST_M, FURTHEST_M = 0.15, 12.0
SCANS_PER_S = 10
"""Slower than the camera: every third control step sees the scan of the step before (`racecar.gazebo`)."""
MOUNT_X_M, MOUNT_Z_M = 0.02913, 0.1847
"""Ahead of the chassis origin, and above the floor (`bundle/urdf/deepracer/deepracer_single_cam_lidar.urdf`)."""


def box_sides(boxes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the sides of boxes (N, boxes, 6 or more), see `camera.take_pictures`, as segments (N, 4 * boxes, 4).

    Sides of boxes no higher than the sensor are NaN, which no ray hits.
    """
    corners = box_corners(boxes.astype(np.float64))
    corners[boxes[..., 5] <= MOUNT_Z_M] = np.nan
    return np.concatenate([corners, np.roll(corners, -1, axis=-2)], axis=-1).reshape(len(boxes), -1, 4)


def scan(poses: NDArray[np.float64], segments_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance along each ray, (N, RAYS), metres; infinite where nothing is hit.

    Args:
        poses: x and y in metres and direction in radians of each sensor, (N, 3).
        segments_m: ends ax, ay, bx, by of the segments around each sensor, (N, segments, 4); NaN where there is
            nothing.
    """
    out = np.empty((len(poses), RAYS))
    _scan(np.ascontiguousarray(poses), segments_m, np.cos(ANGLES_RAD), np.sin(ANGLES_RAD), out)
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def _scan(poses, segments, cosines, sines, out):  # type: ignore[no-untyped-def]
    """Intersect every ray with every segment."""
    rays = len(cosines)
    ray_x, ray_y = np.empty(rays), np.empty(rays)
    for car in range(len(poses)):
        x, y, direction = poses[car]
        cos, sin = np.cos(direction), np.sin(direction)
        nearest = out[car]
        for ray in range(rays):
            ray_x[ray] = cos * cosines[ray] - sin * sines[ray]
            ray_y[ray] = sin * cosines[ray] + cos * sines[ray]
            nearest[ray] = np.inf
        _hit(segments[car], x, y, ray_x, ray_y, nearest)


@njit(cache=True, error_model="numpy", inline="always")
def _hit(segments, x, y, ray_x, ray_y, nearest):  # type: ignore[no-untyped-def]
    """Shorten rays to the segments they hit; without branches the rays of a segment are computed together."""
    end = 1.0 + 1e-9  # rounding opens no gap between two walls
    for index in range(len(segments)):
        from_x, from_y = segments[index, 0] - x, segments[index, 1] - y
        along_x, along_y = segments[index, 2] - segments[index, 0], segments[index, 3] - segments[index, 1]
        area = from_x * along_y - from_y * along_x
        for ray in range(len(nearest)):
            # from + share * along = distance * ray; parallel ones give no number that passes.
            turn = ray_x[ray] * along_y - ray_y[ray] * along_x
            distance = area / turn
            share = (from_x * ray_y[ray] - from_y * ray_x[ray]) / turn
            hit = (distance >= 0.0) & (share >= 1.0 - end) & (share <= end) & (distance < nearest[ray])
            nearest[ray] = distance if hit else nearest[ray]
