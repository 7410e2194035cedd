"""Anti-aliased rasterisation of straight edges, by exact coverage of each pixel.

An edge adds its change of colour to the pixels that it crosses, weighted by the share of the pixel below it; the
running sum down each column is the picture, in which each pixel is the mean of what it sees. Glyph rasterisers do the
same (R. Levien, "Inside the fastest font renderer in the world", 2016).
"""

import numpy as np

from deepracer_exp.jit import njit


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def add_edge(changes, size, begin, end, change):  # type: ignore[no-untyped-def]
    """Add an edge between two points x, y in pixels: `change` below it where it runs to the right, else its opposite.

    `size` is the picture's height and width, `changes` (channels, (height + 3) * width): what lies below the picture
    goes to rows that are not drawn.
    """
    height, width = size
    ax, ay = begin
    bx, by = end
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
        _add_flat(changes, size, (ax, ay, bx), slope, sign, change)
        return
    # What lies above or below the picture, as if it were level there.
    if min(ay, by) < 0.0:
        x = ax - ay / slope
        if max(ay, by) <= 0.0:
            _add_flat(changes, size, (ax, 0.0, bx), 0.0, sign, change)
            return
        if ay < 0.0:
            _add_flat(changes, size, (ax, 0.0, x), 0.0, sign, change)
            ax, ay = x, 0.0
        else:
            _add_flat(changes, size, (x, 0.0, bx), 0.0, sign, change)
            bx, by = x, 0.0
    if ay > height:
        ax, ay = ax + (height - ay) / slope, np.float64(height)
    if by > height:
        bx, by = bx + (height - by) / slope, np.float64(height)
    _add_steep(changes, width, (ax, ay, by), 1.0 / slope, sign, change)


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _add_flat(changes, size, from_to, slope, sign, change):  # type: ignore[no-untyped-def]
    """Add an edge column by column; in one it crosses two rows at most. No branches: they would be mispredicted.

    `from_to` is x and y of its left end and x of its right end.
    """
    height, width = size
    ax, ay, bx = from_to
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
def _add_steep(changes, width, from_to, x_per_row, sign, change):  # type: ignore[no-untyped-def]
    """Add an edge within the picture row by row; in one it crosses two columns at most.

    `from_to` is x and y of its left end and y of its right end.
    """
    ax, ay, by = from_to
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
