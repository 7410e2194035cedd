"""The outline of a track for drawing, and its picture from above for films and environments."""

from dataclasses import dataclass
from itertools import chain

import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from shapely.geometry.base import BaseGeometry

from .track import Track

Points = NDArray[np.float64]

_FINER = 2
_MARGIN_M = 0.5
_BORDER_M, _DASH_M, _DASH_WIDTH_M = 0.05, 0.15, 0.025
_DASH_COLOR = "#f5a623"


@dataclass(frozen=True, eq=False)
class Outline:
    """The lines of a track, in metres: arrays of points (n, 2)."""

    polygons: list[list[Points]]
    """The polygons of the road; see `polygons`."""
    borders: tuple[Points, Points]
    """The inner and the outer border, along the track."""

    @classmethod
    def of(cls, track: Track) -> "Outline":
        """Return the outline of a track."""
        return cls(polygons(track.road), (track.inner, track.outer))

    @property
    def rings(self) -> list[Points]:
        """All rings of the road."""
        return list(chain.from_iterable(self.polygons))

    @property
    def start_line(self) -> Points:
        """The ends of the start line on the two borders, (2, 2)."""
        return np.stack([border[0] for border in self.borders])

    def corners(self, margin_m: float = 0.0) -> tuple[Points, Points]:
        """Return the lowest and the highest x and y, (2,) each, of the borders with a margin around them."""
        points = np.concatenate(self.borders)
        return points.min(axis=0) - margin_m, points.max(axis=0) + margin_m


def polygons(area: BaseGeometry) -> list[list[Points]]:
    """Return the polygons of an area, each as its closed rings: the outer one counter-clockwise, then holes clockwise.

    With rings in opposite directions, holes stay empty by either fill rule.
    """
    parts = [
        part for part in shapely.get_parts(area) if isinstance(part, shapely.Polygon) and not part.is_empty
    ]
    return [
        [shapely.get_coordinates(ring) for ring in shapely.get_rings(shapely.orient_polygons(part))]
        for part in parts
    ]


def rings_of(area: BaseGeometry) -> list[Points]:
    """Return the rings of all polygons of an area, which lies to their left."""
    return list(chain.from_iterable(polygons(area)))


def extent(track: Track) -> tuple[Points, Points]:
    """Return the lowest and the highest x and y that a view from above shows, (2,) each."""
    return Outline.of(track).corners(_MARGIN_M)


def draw_track(track: Track, pixels_per_m: float) -> Image.Image:
    """Draw the `extent` of a track from above, x to the right and y up."""
    outline, scale = Outline.of(track), _FINER * pixels_per_m
    low, high = outline.corners(_MARGIN_M)
    width, height = (int(size) for size in np.ceil((high - low) * scale))
    image = Image.new("RGB", (width, height), track.floor.ground_color)
    draw = ImageDraw.Draw(image)

    def pixels(points: Points) -> list[tuple[float, float]]:
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
