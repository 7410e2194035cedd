"""Pictures of a track from above, for films and environments."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from .outline import Outline
from .track import Track

_FINER = 2
_MARGIN_M = 0.5
_BORDER_M, _DASH_M, _DASH_WIDTH_M = 0.05, 0.15, 0.025
_DASH_COLOR = "#f5a623"


def extent(track: Track) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest x and y that a view from above shows, (2,) each."""
    return Outline.of(track).corners(_MARGIN_M)


def draw_track(track: Track, pixels_per_m: float) -> Image.Image:
    """Draw the `extent` of a track from above, x to the right and y up."""
    outline, scale = Outline.of(track), _FINER * pixels_per_m
    low, high = outline.corners(_MARGIN_M)
    width, height = (int(size) for size in np.ceil((high - low) * scale))
    image = Image.new("RGB", (width, height), track.floor.ground_color)
    draw = ImageDraw.Draw(image)

    def pixels(points: NDArray[np.float64]) -> list[tuple[float, float]]:
        scaled = (points - low) * scale
        return [(x, height - y) for x, y in scaled.tolist()]

    for around, *holes in outline.polygons:
        draw.polygon(pixels(around), fill=track.floor.road_color)
        for hole in holes:
            draw.polygon(pixels(hole), fill=track.floor.ground_color)
    for at_m in np.arange(0.0, track.length_m - _DASH_M, 2 * _DASH_M):
        ends = track.points_at(np.array([at_m, at_m + _DASH_M]) / track.length_m)
        draw.line(pixels(ends), fill=_DASH_COLOR, width=max(1, round(_DASH_WIDTH_M * scale)))
    width = max(2, round(_BORDER_M * scale))
    for border in outline.borders:
        draw.line(pixels(border), fill=track.floor.line_color, width=width, joint="curve")
    draw.line(pixels(outline.start_line), fill="#ffffff", width=2 * width)
    # Drawn at a higher resolution and reduced, for smooth edges.
    return image.reduce(_FINER)
