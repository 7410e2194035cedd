"""The track an experiment drives on (`conf/track/`)."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import Finite, Positive

Point = tuple[Finite, Finite]
Color = Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")]


@dataclass(frozen=True, kw_only=True)
class FloorConfig:
    """What the road is made of."""

    friction: Positive
    """Tyre friction on this floor relative to the car's own `tyre_friction` (1 = as is)."""
    road_color: Color
    ground_color: Color
    line_color: Color


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """A course given by spline knots, or by a file that replaces them."""

    name: str
    """The world's name in the DeepRacer service."""
    title: str
    closed: bool
    """Whether the last knot joins the first."""
    direction: Literal["forward", "reversed"]
    """Drive in the order of the knots (or route rows), or against it."""
    width_m: Positive | tuple[Positive, ...]
    """Distance between the borders in metres: one number, or one per knot."""
    knots: tuple[Point, ...]
    """Centre-line spline knots (x, y) in metres, evenly spaced in arc length."""
    floor: FloorConfig
    file: str | None
    """A route (.npy) or a YAML of knots that takes the place of name, title, closed, width_m and knots."""
