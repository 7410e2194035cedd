"""Boxes in the cameras' pictures, drawn back to front (painter's algorithm).

The visible faces of a box are rasterised like the scenery (`edges`), with their coverage as an extra channel.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.jit import njit

from .edges import add_edge
from .lens import NEAREST_M, view

FACE_LIGHT = (1.0, 0.85, 0.7)
"""Brightness of a box's top, of its front and back, and of its sides, relative to its colour."""


class _Visible(NamedTuple):
    """The boxes in a picture: arrays with a row per box."""

    seen: NDArray[np.float64]
    """Corners, those on the floor first: depth, right and down from the eye, (boxes, 8, 3)."""
    corners: NDArray[np.float64]
    """Corners on the floor, (boxes, 4, 2)."""
    columns: NDArray[np.float64]
    """The first and the last of the picture's columns that a box may be in, (boxes, 2)."""
    distance: NDArray[np.float64]
    """From the eye to the middle."""
    left: NDArray[np.int64]
    """Numbers of the boxes that are still to be drawn, the farthest first."""


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def draw_boxes(poses, boxes, mounts, out):  # type: ignore[no-untyped-def]
    """Draw each car's boxes over its picture.

    Args:
        poses: of the cars, (N, 5), see `camera.take_pictures`.
        boxes: around each car, (N, boxes, 6 + channels), as there.
        mounts: of each car's camera, (N, 5), see `Lens.mount`.
        out: pictures, (N, channels, height, width), uint8; changed.
    """
    cars, channels, height, width = out.shape
    count = boxes.shape[1]
    # The last channel: share covered.
    changes = np.zeros((channels + 1, (height + 3) * width), np.float32)
    running, uncovered = np.empty((channels + 1, width), np.float32), np.empty(width, np.float32)
    rotation = np.empty((3, 3))
    visible = _Visible(
        np.empty((count, 8, 3)),
        np.empty((count, 4, 2)),
        np.empty((count, 2)),
        np.empty(count),
        np.empty(count, np.int64),
    )
    for car in range(cars):
        eye, axis, right, down = view(poses[car], mounts[car], rotation)
        camera = eye, axis, right, down, mounts[car, 4]
        n_left = _find(boxes[car], camera, width, visible)
        while n_left > 0:
            chosen = _choose(visible, n_left, eye)
            box = visible.left[chosen]
            n_left -= 1
            for place in range(chosen, n_left):
                visible.left[place] = visible.left[place + 1]
            bounds = _add_faces(
                boxes[car, box], visible.seen[box], visible.corners[box], camera, (height, width), changes
            )
            _paint(changes, bounds, running, uncovered, out[car])


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _find(boxes, camera, width, visible):  # type: ignore[no-untyped-def]
    """Find the boxes in a picture, (boxes, 6 + channels), sort them by distance, and return how many there are."""
    eye, axis, right, down, focal = camera
    middle_x = 0.5 * width
    # Of the planes through the picture's left and right edges: the normal's parts along the axis and across.
    side_axis = middle_x / np.hypot(middle_x, focal)
    side_across = focal / np.hypot(middle_x, focal)
    seen, corners, columns, distance, left = visible
    n_left = 0
    for box in range(len(boxes)):
        top = np.float64(boxes[box, 5])
        if top <= 0.0:
            continue
        x, y, z = boxes[box, 0] - eye[0], boxes[box, 1] - eye[1], 0.5 * top - eye[2]
        length, wide = np.float64(boxes[box, 3]), np.float64(boxes[box, 4])
        reach = 0.5 * np.sqrt(length * length + wide * wide + top * top) + 1e-3
        depth = x * axis[0] + y * axis[1] + z * axis[2]
        across = x * right[0] + y * right[1] + z * right[2]
        if depth < -reach or side_across * abs(across) - side_axis * depth > reach:
            continue
        cos, sin = np.cos(np.float64(boxes[box, 2])), np.sin(np.float64(boxes[box, 2]))
        for corner in range(4):
            ahead = 0.5 * length if corner == 1 or corner == 2 else -0.5 * length
            aside = 0.5 * wide if corner >= 2 else -0.5 * wide
            corners[box, corner, 0] = boxes[box, 0] + ahead * cos - aside * sin
            corners[box, corner, 1] = boxes[box, 1] + ahead * sin + aside * cos
        beyond_left = beyond_right = behind = 0
        columns[box] = np.inf, -np.inf
        for corner in range(8):
            x = corners[box, corner % 4, 0] - eye[0]
            y = corners[box, corner % 4, 1] - eye[1]
            z = (top if corner >= 4 else 0.0) - eye[2]
            depth = x * axis[0] + y * axis[1] + z * axis[2]
            across = x * right[0] + y * right[1] + z * right[2]
            seen[box, corner] = depth, across, x * down[0] + y * down[1] + z * down[2]
            beyond_left += focal * across < -middle_x * depth
            beyond_right += focal * across > middle_x * depth
            behind += depth <= NEAREST_M
            projected = middle_x + focal * across / max(depth, NEAREST_M)
            columns[box, 0] = min(columns[box, 0], projected)
            columns[box, 1] = max(columns[box, 1], projected)
        if beyond_left == 8 or beyond_right == 8 or behind == 8:
            continue
        if behind:
            columns[box] = 0.0, np.float64(width)
        distance[box] = np.hypot(boxes[box, 0] - eye[0], boxes[box, 1] - eye[1])
        place = n_left
        while place > 0 and distance[left[place - 1]] < distance[box]:
            left[place] = left[place - 1]
            place -= 1
        left[place] = box
        n_left += 1
    return n_left


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _choose(visible, n_left, eye):  # type: ignore[no-untyped-def]
    """Return the first box that hides no other; if each of them hides another, the farthest."""
    _, corners, columns, distance, left = visible
    for candidate in range(n_left):
        box, hides = left[candidate], False
        for place in range(n_left):
            other = left[place]
            if other != box and columns[box, 0] < columns[other, 1] and columns[other, 0] < columns[box, 1]:
                nearer = distance[box] < distance[other]
                hides |= _may_hide(corners[box], corners[other], eye, nearer)
        if not hides:
            return candidate
    return 0


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _add_faces(box, seen, corners, camera, size, changes):  # type: ignore[no-untyped-def]
    """Add the edges of a box's visible faces; return the first column that they change and the one after the last.

    The same of the rows follows. `seen` and `corners` are those of `_Visible`.
    """
    height, width = size
    eye, focal = camera[0], camera[4]
    middle_x, middle_y = 0.5 * width, 0.5 * height
    face, polygon = np.empty(4, np.int64), np.empty((5, 2))
    channels = len(changes) - 1
    change = np.empty(channels + 1, np.float32)
    change[channels] = 1.0
    first_column, last_column, first_row, last_row = width, 0, height, 0
    for side in range(5):
        if side == 4:
            face[:] = 7, 6, 5, 4
            visible, light = eye[2] > box[5], FACE_LIGHT[0]
        else:
            after = (side + 1) % 4
            face[:] = 4 + side, 4 + after, after, side
            visible = _outside(corners, side, eye[0], eye[1]) > 0.0
            light = FACE_LIGHT[1 if side % 2 else 2]
        if not visible:
            continue
        points = 0
        for corner in range(4):
            now, was = seen[face[corner]], seen[face[corner - 1]]
            depth, x, y = now[0], now[1], now[2]
            was_depth, was_x, was_y = was[0], was[1], was[2]
            if (depth > NEAREST_M) != (was_depth > NEAREST_M):
                share = (NEAREST_M - was_depth) / (depth - was_depth)
                polygon[points, 0] = middle_x + (was_x + share * (x - was_x)) * focal / NEAREST_M
                polygon[points, 1] = middle_y + (was_y + share * (y - was_y)) * focal / NEAREST_M
                points += 1
            if depth > NEAREST_M:
                polygon[points, 0] = middle_x + x * focal / depth
                polygon[points, 1] = middle_y + y * focal / depth
                points += 1
        for channel in range(channels):
            change[channel] = light * box[6 + channel]
        for point in range(points):
            begin, end = polygon[(point or points) - 1], polygon[point]
            add_edge(changes, size, (begin[0], begin[1]), (end[0], end[1]), change)
            first_column = min(first_column, int(max(end[0], 0.0)))
            last_column = max(last_column, int(min(end[0] + 1.0, width)))
            first_row = min(first_row, int(max(end[1], 0.0)))
            last_row = max(last_row, int(min(end[1] + 1.0, height)))
    return first_column, last_column, first_row, last_row


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _paint(changes, bounds, running, uncovered, picture):  # type: ignore[no-untyped-def]
    """Sum up the changes within the bounds, draw the result over the picture, and clear them.

    `running`, (channels + 1, width), and `uncovered`, (width,), are arrays to work with.
    """
    first_column, last_column, first_row, last_row = bounds
    channels, height, width = picture.shape
    running[:, first_column:last_column] = 0
    # Loops over columns alone, which the compiler can turn into vectors.
    for row in range(first_row, last_row):
        base = row * width
        for channel in range(channels + 1):
            for column in range(first_column, last_column):
                running[channel, column] += changes[channel, base + column]
                changes[channel, base + column] = 0
        for column in range(first_column, last_column):
            uncovered[column] = 1 - min(max(running[channels, column], np.float32(0)), np.float32(1))
        for channel in range(channels):
            for column in range(first_column, last_column):
                value = uncovered[column] * picture[channel, row, column] + running[channel, column]
                picture[channel, row, column] = np.uint8(
                    min(max(value + np.float32(0.5), np.float32(0)), np.float32(255))
                )
    # Edges at a row or column change the next two as well.
    beyond = min(last_column + 1, width)
    for row in range(first_row, last_row):
        changes[:, row * width + last_column : row * width + beyond] = 0
    for row in range(last_row, min(last_row, height) + 3):
        changes[:, row * width + first_column : row * width + beyond] = 0


@njit(cache=True)
def _may_hide(corners, others, eye, nearer):  # type: ignore[no-untyped-def]
    """Return whether a box may hide a part of another, given their corners on the floor.

    If the line of a side separates them, only the one on the side of the eye can hide the other. `nearer` is the answer
    for boxes that overlap.
    """
    apart = False
    for side in range(4):
        if _all_outside(corners, side, others):
            if _outside(corners, side, eye[0], eye[1]) > 0.0:
                return False
            apart = True
        if _all_outside(others, side, corners):
            if _outside(others, side, eye[0], eye[1]) <= 0.0:
                return False
            apart = True
    return apart or nearer


@njit(cache=True)
def _all_outside(corners, side, others):  # type: ignore[no-untyped-def]
    """Return whether none of four points is within the line of a side."""
    least = np.inf
    for point in range(4):
        least = min(least, _outside(corners, side, others[point, 0], others[point, 1]))
    return least >= 0.0


@njit(cache=True, inline="always")
def _outside(corners, side, x, y):  # type: ignore[no-untyped-def]
    """Return a point's distance beyond the line of a side, times the side's length."""
    begin, end = corners[side], corners[(side + 1) % 4]
    return (end[1] - begin[1]) * (x - begin[0]) - (end[0] - begin[0]) * (y - begin[1])
