"""Renders the pictures of all cars' cameras at once: the road and its surroundings, with boxes over them.

A pinhole camera maps straight edges to straight edges, which are rasterised column by column (`edges`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.jit import njit

from .camera_boxes import draw_boxes
from .edges import add_edge
from .lens import NEAREST_M, Lens, view
from .scenery import Scenery


def take_pictures(
    lens: Lens,
    scenery: Scenery,
    poses: ArrayLike,
    track_index: NDArray[np.intp],
    colors: NDArray[np.float32],
    out: NDArray[np.uint8],
    mounts: NDArray[np.float64] | None = None,
    boxes: NDArray[np.float32] | None = None,
) -> NDArray[np.uint8]:
    """Take a picture of each of N cars.

    Args:
        lens: of all cars.
        scenery: of all tracks.
        poses: x and y of the chassis origin in metres, yaw, pitch (nose down) and roll (to the right) in radians,
            (N, 5).
        track_index: of each car's track in the scenery, (N,).
        colors: of each car's `scenery.MATERIALS`, 0 to 255, (N, materials, channels).
        out: (N, channels, height, width), written and returned.
        mounts: of each car's camera, (N, 5), see `Lens.mount`; None: the lens's own for all.
        boxes: that stand on the floor around each car, between the walls and apart from each other: x, y, yaw, length,
            width and height in metres and radians, and the colour in each channel, (N, boxes, 6 + channels); one of
            height 0 is none.
    """
    if mounts is None:
        mounts = np.tile(lens.mount, (len(out), 1))
    scene = _Scene(scenery.points_m, scenery.joined, scenery.pieces, scenery.first_piece)
    colors = np.ascontiguousarray(colors, np.float32)
    _take(np.ascontiguousarray(poses, np.float64), mounts, track_index, colors, scene, out)
    if boxes is not None:
        draw_boxes(np.ascontiguousarray(poses, np.float64), boxes, mounts, out)
    return out


class _Scene(NamedTuple):
    """The arrays of a `Scenery`."""

    points: NDArray[np.floating]
    joined: NDArray[np.bool_]
    pieces: NDArray[np.void]
    first_piece: NDArray[np.integer]


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _take(poses, mounts, track_index, colors, scene, out):  # type: ignore[no-untyped-def]
    """Take the pictures."""
    points, joined, pieces, first_piece = scene
    cars, channels, height, width = out.shape
    # Edges at the bottom of the picture also change the rows below it, which are not drawn.
    changes = np.zeros((channels, (height + 3) * width), np.float32)
    running = np.empty(width, np.float32)
    change = np.empty(channels, np.float32)
    rotation = np.empty((3, 3))
    middle_x, middle_y = 0.5 * width, 0.5 * height
    for car in range(cars):
        focal = mounts[car, 4]
        # Of the planes through the picture's left and right edges: the normal's parts along the axis and across.
        side_axis = middle_x / np.hypot(middle_x, focal)
        side_across = focal / np.hypot(middle_x, focal)
        eye, axis, sideways, downwards = view(poses[car], mounts[car], rotation)
        eye_x, eye_y, eye_z = eye
        axis_x, axis_y, axis_z = axis
        right_x, right_y, right_z = sideways
        down_x, down_y, down_z = downwards
        track = track_index[car]
        for index in range(first_piece[track], first_piece[track + 1]):
            piece = pieces[index]
            from_x, from_y = piece.middle_m[0] - eye_x, piece.middle_m[1] - eye_y
            reach = np.float64(piece.radius_m) + 0.2
            square = from_x * from_x + from_y * from_y
            if square < piece.near_m * piece.near_m or square >= piece.far_m * piece.far_m:
                continue
            depth = from_x * axis_x + from_y * axis_y
            across = from_x * right_x + from_y * right_y
            if depth < -reach or side_across * abs(across) - side_axis * depth > reach:
                continue
            for channel in range(channels):
                change[channel] = colors[car, piece.outside, channel] - colors[car, piece.inside, channel]
            was_depth = was_x = was_y = 0.0
            for point in range(piece.first, piece.last):
                x, y, z = points[point, 0] - eye_x, points[point, 1] - eye_y, points[point, 2] - eye_z
                depth = x * axis_x + y * axis_y + z * axis_z
                right = x * right_x + y * right_y + z * right_z
                down = x * down_x + y * down_y + z * down_z
                if joined[point] and (depth > NEAREST_M or was_depth > NEAREST_M):
                    ax, ay, bx, by, a_depth, b_depth = was_x, was_y, right, down, was_depth, depth
                    # What is cut off here lies beside or below the picture.
                    if a_depth < NEAREST_M:
                        share = (NEAREST_M - a_depth) / (b_depth - a_depth)
                        ax, ay, a_depth = ax + share * (bx - ax), ay + share * (by - ay), NEAREST_M
                    elif b_depth < NEAREST_M:
                        share = (NEAREST_M - b_depth) / (a_depth - b_depth)
                        bx, by, b_depth = bx + share * (ax - bx), by + share * (ay - by), NEAREST_M
                    a_focal, b_focal = focal / a_depth, focal / b_depth
                    begin = middle_x + ax * a_focal, middle_y + ay * a_focal
                    end = middle_x + bx * b_focal, middle_y + by * b_focal
                    add_edge(changes, (height, width), begin, end, change)
                was_depth, was_x, was_y = depth, right, down
        for channel in range(channels):
            running[:] = colors[car, 0, channel] + np.float32(0.5)  # the sky, rounded
            for row in range(height):
                first = row * width
                for column in range(width):
                    running[column] += changes[channel, first + column]
                    changes[channel, first + column] = 0
                    out[car, channel, row, column] = np.uint8(
                        min(max(running[column], np.float32(0)), np.float32(255))
                    )
            changes[channel, height * width :] = 0
