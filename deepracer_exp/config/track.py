"""The track an experiment drives on (`conf/track/`)."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

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
    direction: Literal["forward", "reversed", "alternate"]
    """Drive in the order of the knots (or route rows), against it, or so and so in turn, episode by episode."""
    weight: Positive
    """How many of the cars drive here, relative to the other tracks of the experiment."""
    width_m: Positive | tuple[Positive, ...]
    """Distance between the borders in metres: one number, or one per knot."""
    knots: tuple[Point, ...]
    """Centre-line spline knots (x, y) in metres, evenly spaced in arc length."""
    floor: FloorConfig
    file: str | None
    """A route (.npy) or a YAML of knots that takes the place of name, title, closed, width_m and knots."""


def _kind(value: Any) -> str:
    """Tell several tracks from one, whose values are not all mappings."""
    several = isinstance(value, dict) and value and all(isinstance(item, dict) for item in value.values())
    return "several" if several else "one"


Tracks = Annotated[
    Annotated[TrackConfig, Tag("one")] | Annotated[dict[str, TrackConfig], Tag("several")],
    Discriminator(_kind),
]
