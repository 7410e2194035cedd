"""The pictures of all cars' cameras at once, exact to the share of each pixel that an outline covers.

Straight edges of the scenery are straight in the picture. Where an edge crosses a column, the colour below differs from
the one above by a known amount: the sum of these changes from the top of the column down is the picture. A change
within a pixel counts by the area below the edge, so that each pixel is the mean of what it sees (as glyph rasterisers
do, R. Levien, "Inside the fastest font renderer in the world", 2016). Boxes are drawn over it, the farthest first: the
visible faces of one are added up in the same way, with the share that they cover as one more channel.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from .scenery import Scenery, box_corners

NEAREST_M = 0.02
"""Nothing nearer to the picture's plane is seen (deepracer-simapp, `bundle/models/camera/model.sdf`)."""

FACE_LIGHT = (1.0, 0.85, 0.7)
"""Brightness of a box's top, of its front and back, and of its sides, relative to its colour."""


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
    _take(
        np.ascontiguousarray(poses, np.float64),
        track_index,
        np.ascontiguousarray(colors, np.float32),
        scenery.points_m,
        scenery.joined,
        scenery.pieces,
        scenery.first_piece,
        mounts,
        out,
    )
    if boxes is not None:
        _take_boxes(
            np.ascontiguousarray(poses, np.float64),
            boxes.astype(np.float64),
            box_corners(boxes.astype(np.float64)),
            mounts,
            out,
        )
    return out


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _take(  # type: ignore[no-untyped-def]
    poses, track_index, colors, points, joined, pieces, first_piece, mounts, out
):
    """Take the pictures."""
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
        eye, axis, sideways, downwards = _camera(poses[car], mounts[car], rotation)
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
                    _add_edge(
                        changes,
                        height,
                        width,
                        middle_x + ax * a_focal,
                        middle_y + ay * a_focal,
                        middle_x + bx * b_focal,
                        middle_y + by * b_focal,
                        change,
                    )
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


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _take_boxes(poses, boxes, corners, mounts, out):  # type: ignore[no-untyped-def]
    """Draw each car's boxes over its picture."""
    cars, channels, height, width = out.shape
    count = boxes.shape[1]
    changes = np.zeros((channels + 1, (height + 3) * width), np.float32)
    running = np.empty((channels + 1, width), np.float32)
    change = np.empty(channels + 1, np.float32)  # the last: share covered
    rotation = np.empty((3, 3))
    # Of the corners, those on the floor first: depth, right and down from the eye.
    seen = np.empty((count, 8, 3))
    columns, distance = np.empty((count, 2)), np.empty(count)
    left = np.empty(count, np.int64)
    face, polygon = np.empty(4, np.int64), np.empty((5, 2))
    middle_x, middle_y = 0.5 * width, 0.5 * height
    for car in range(cars):
        focal = mounts[car, 4]
        eye, axis, right, down = _camera(poses[car], mounts[car], rotation)
        # What is in the picture, the farthest first.
        n_left = 0
        for box in range(count):
            top = boxes[car, box, 5]
            if top <= 0.0:
                continue
            beyond_left = beyond_right = behind = 0
            columns[box] = np.inf, -np.inf
            for corner in range(8):
                x = corners[car, box, corner % 4, 0] - eye[0]
                y = corners[car, box, corner % 4, 1] - eye[1]
                z = (top if corner >= 4 else 0.0) - eye[2]
                depth = x * axis[0] + y * axis[1] + z * axis[2]
                across = x * right[0] + y * right[1] + z * right[2]
                seen[box, corner] = depth, across, x * down[0] + y * down[1] + z * down[2]
                beyond_left += focal * across < -middle_x * depth
                beyond_right += focal * across > middle_x * depth
                behind += depth <= NEAREST_M
                projected = middle_x + focal * across / max(depth, NEAREST_M)
                columns[box, 0], columns[box, 1] = (
                    min(columns[box, 0], projected),
                    max(columns[box, 1], projected),
                )
            if beyond_left == 8 or beyond_right == 8 or behind == 8:
                continue
            if behind:
                columns[box] = 0.0, np.float64(width)
            distance[box] = np.hypot(boxes[car, box, 0] - eye[0], boxes[car, box, 1] - eye[1])
            place = n_left
            while place > 0 and distance[left[place - 1]] < distance[box]:
                left[place] = left[place - 1]
                place -= 1
            left[place] = box
            n_left += 1
        while n_left > 0:
            # The first that hides none of the others; if each of them hides another, the farthest.
            chosen = 0
            for candidate in range(n_left):
                box, hides = left[candidate], False
                for place in range(n_left):
                    other = left[place]
                    if (
                        other != box
                        and columns[box, 0] < columns[other, 1]
                        and columns[other, 0] < columns[box, 1]
                    ):
                        nearer = distance[box] < distance[other]
                        hides |= _may_hide(corners[car, box], corners[car, other], eye, nearer)
                if not hides:
                    chosen = candidate
                    break
            box = left[chosen]
            n_left -= 1
            left[chosen:n_left] = left[chosen + 1 : n_left + 1].copy()
            first_column, last_column, first_row, last_row = width, 0, height, 0
            for side in range(5):
                if side == 4:
                    face[:] = 7, 6, 5, 4
                    visible, light = eye[2] > boxes[car, box, 5], FACE_LIGHT[0]
                else:
                    after = (side + 1) % 4
                    face[:] = 4 + side, 4 + after, after, side
                    visible = _outside(corners[car, box], side, eye[0], eye[1]) > 0.0
                    light = FACE_LIGHT[1 if side % 2 else 2]
                if not visible:
                    continue
                points = 0
                for corner in range(4):
                    now, was = seen[box, face[corner]], seen[box, face[corner - 1]]
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
                    change[channel] = light * boxes[car, box, 6 + channel]
                change[channels] = 1.0
                for point in range(points):
                    begin, end = polygon[(point or points) - 1], polygon[point]
                    _add_edge(changes, height, width, begin[0], begin[1], end[0], end[1], change)
                    first_column = min(first_column, int(max(end[0], 0.0)))
                    last_column = max(last_column, int(min(end[0] + 1.0, width)))
                    first_row = min(first_row, int(max(end[1], 0.0)))
                    last_row = max(last_row, int(min(end[1] + 1.0, height)))
            running[:] = 0
            for row in range(first_row, last_row):
                for column in range(first_column, last_column):
                    projected = row * width + column
                    for channel in range(channels + 1):
                        running[channel, column] += changes[channel, projected]
                    behind_it = 1 - min(max(running[channels, column], np.float32(0)), np.float32(1))
                    for channel in range(channels):
                        value = behind_it * out[car, channel, row, column] + running[channel, column]
                        out[car, channel, row, column] = np.uint8(
                            min(max(value + np.float32(0.5), np.float32(0)), np.float32(255))
                        )
            # Edges at a row or column change the next two as well.
            for row in range(first_row, min(last_row, height) + 3):
                changes[:, row * width + first_column : row * width + min(last_column + 1, width)] = 0


@njit(cache=True)
def _may_hide(corners, others, eye, nearer):  # type: ignore[no-untyped-def]
    """Return whether a box may hide a part of another, given their corners on the floor.

    If the line of a side separates them, only the one on the side of the eye can hide the other. `nearer` is the answer
    for boxes that overlap.
    """
    apart = False
    for side in range(4):
        least = min([_outside(corners, side, others[k, 0], others[k, 1]) for k in range(4)])
        if least >= 0.0:
            if _outside(corners, side, eye[0], eye[1]) > 0.0:
                return False
            apart = True
        least = min([_outside(others, side, corners[k, 0], corners[k, 1]) for k in range(4)])
        if least >= 0.0:
            if _outside(others, side, eye[0], eye[1]) <= 0.0:
                return False
            apart = True
    return apart or nearer


@njit(cache=True, inline="always")
def _outside(corners, side, x, y):  # type: ignore[no-untyped-def]
    """Return how far a point is beyond the line of a side, times the side's length."""
    begin, end = corners[side], corners[(side + 1) % 4]
    return (end[1] - begin[1]) * (x - begin[0]) - (end[0] - begin[0]) * (y - begin[1])


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _add_edge(changes, height, width, ax, ay, bx, by, change):  # type: ignore[no-untyped-def]
    """Add an edge from a to b, in pixels: `change` below it where it runs to the right, else its opposite.

    `changes` is (channels, (height + 3) * width): what lies below the picture goes to rows that are not drawn.
    """
    sign = 1.0
    if ax > bx:
        ax, ay, bx, by, sign = bx, by, ax, ay, -1.0
    if bx <= 0.0 or ax >= width or ax == bx or (ay >= height and by >= height):
        return
    slope = (by - ay) / (bx - ax)
    if ax < 0.0:
        ay -= ax * slope
        ax = 0.0
    if bx > width:
        by -= (bx - width) * slope
        bx = np.float64(width)
    if abs(slope) <= 1.0:
        _add_flat(changes, height, width, ax, ay, bx, slope, sign, change)
        return
    # What lies above or below the picture, as if it were level there.
    if min(ay, by) < 0.0:
        x = ax - ay / slope
        if max(ay, by) <= 0.0:
            _add_flat(changes, height, width, ax, 0.0, bx, 0.0, sign, change)
            return
        if ay < 0.0:
            _add_flat(changes, height, width, ax, 0.0, x, 0.0, sign, change)
            ax, ay = x, 0.0
        else:
            _add_flat(changes, height, width, x, 0.0, bx, 0.0, sign, change)
            bx, by = x, 0.0
    if ay > height:
        ax, ay = ax + (height - ay) / slope, np.float64(height)
    if by > height:
        bx, by = bx + (height - by) / slope, np.float64(height)
    _add_steep(changes, width, ax, ay, by, 1.0 / slope, sign, change)


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _add_flat(changes, height, width, ax, ay, bx, slope, sign, change):  # type: ignore[no-untyped-def]
    """Add an edge column by column; in one it crosses two rows at most. No branches: they would be mispredicted."""
    bottom = np.float64(height)
    for column in range(int(ax), int(np.ceil(bx))):
        begin, end = max(ax, np.float64(column)), min(bx, column + 1.0)
        weight = sign * (end - begin)
        y = min(max(ay + (begin - ax) * slope, 0.0), bottom)
        end_y = min(max(ay + (end - ax) * slope, 0.0), bottom)
        low, high = min(y, end_y), max(y, end_y)
        row = int(low)
        # Mean height below the edge down to the end of its first row, and of the one after.
        in_first = row + 1.0 - low
        mean = 0.5 * (high - low)
        first = in_first - mean if low + in_first >= high else 0.25 * in_first * in_first / mean
        both = in_first + 1.0 - mean
        pixel = np.uint64(row * width + column)
        for channel in range(len(change)):
            step = np.float32(weight) * change[channel]
            changes[channel, pixel] += np.float32(first) * step
            changes[channel, pixel + np.uint64(width)] += np.float32(both - 2.0 * first) * step
            changes[channel, pixel + np.uint64(2 * width)] += np.float32(1.0 - both + first) * step


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _add_steep(changes, width, ax, ay, by, x_per_row, sign, change):  # type: ignore[no-untyped-def]
    """Add an edge within the picture row by row; in one it crosses two columns at most."""
    x_at = ax - ay * x_per_row
    low, high = min(ay, by), max(ay, by)
    for row in range(int(low), int(np.ceil(high))):
        begin, end = max(low, np.float64(row)), min(high, row + 1.0)
        x, end_x = x_at + begin * x_per_row, x_at + end * x_per_row
        left, right = min(x, end_x), max(x, end_x)
        column = min(max(int(left), 0), width - 1)
        border = min(max(left, column + 1.0), right)
        # Of the two parts: width, and mean height down to the end of the row.
        at_left = row + 1.0 - (begin if x <= end_x else end)
        per_x = (
            (at_left - (row + 1.0 - (end if x <= end_x else begin))) / (right - left) if right > left else 0.0
        )
        for part in range(2):
            wide = border - left if part == 0 else right - border
            middle = 0.5 * (left + border) if part == 0 else 0.5 * (border + right)
            below = at_left - (middle - left) * per_x
            pixel = np.uint64(row * width + min(column + part, width - 1))
            for channel in range(len(change)):
                step = np.float32(sign * wide) * change[channel]
                changes[channel, pixel] += np.float32(below) * step
                changes[channel, pixel + np.uint64(width)] += np.float32(1.0 - below) * step


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _camera(pose, mount, rotation):  # type: ignore[no-untyped-def]
    """Return the eye, and the picture's axis, right and bottom, in the world; `rotation` is overwritten."""
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
