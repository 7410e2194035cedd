"""The outline of a track for whatever draws it: the rings of its road, its borders, its start line and its extent."""

from dataclasses import dataclass
from itertools import chain

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from .track import Track

Points = NDArray[np.float64]


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
