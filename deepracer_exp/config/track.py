"""The track an experiment drives on (`conf/track/`)."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

from .bounds import Finite, Positive

Point = tuple[Finite, Finite]
Color = Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")]
# Each dash is drawn.
DashLength = Annotated[float, Field(ge=0.01, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class FloorConfig:
    """What the road is made of."""

    friction: Positive
    """Tyre friction on this floor relative to the car's own `tyre_friction` (1 = as is)."""
    road_color: Color
    ground_color: Color
    line_color: Color
    lines_inside: bool = True
    """Whether the edge lines lie inside the road's border, as in most worlds, or beyond it."""
    dash_color: Color = "#e38b05"
    """Of the centre line."""
    dash_length_m: DashLength = 0.0508
    dash_gap_m: DashLength = 0.0508
    start_line_color: Color | None = None
    """Of the dark fields of the start line, whose light ones have that of the edge lines; None: there is none."""
    kerb_color: Color | None = None
    """Of kerbs beyond the edge lines, which are striped with the lines' colour; None: there are none."""
    wall_color: Color = "#244651"
    sky_color: Color = "#272727"
    walls_beyond_m: Positive | None = 0.91
    """Distance of the walls around the field from the road's extreme coordinates; None: there are no walls."""
    walls_height_m: Positive = 1.0
    walls_follow_road: bool = False
    """Whether the walls stand at that distance around the road's convex hull, as barriers do, or in a rectangle."""


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """A course: a world of the service, spline knots, or a file."""

    name: str
    """The world's name in the DeepRacer service; of a track with knots or a file, any."""
    title: str
    direction: Literal["forward", "reversed", "alternate"]
    """Drive in the order of the waypoints (or knots), against it, or alternating from episode to episode."""
    weight: Positive
    """Share of the cars that drive here, relative to the other tracks of the experiment."""
    file: str | None
    """A route (.npy) or a YAML of knots, which replaces the world or the knots."""
    knots: tuple[Point, ...] | None
    """Centre-line spline knots (x, y) in metres, which replace the world."""
    width_m: Positive | tuple[Positive, ...] | None
    """Distance between the borders of a road of knots in metres: one number, or one per knot."""
    closed: bool
    """Whether the last knot joins the first."""
    floor: FloorConfig


def _kind(value: Any) -> str:
    """Return whether this is one track or several; the values of one are not all mappings."""
    several = isinstance(value, dict) and value and all(isinstance(item, dict) for item in value.values())
    return "several" if several else "one"


Tracks = Annotated[
    Annotated[TrackConfig, Tag("one")] | Annotated[dict[str, TrackConfig], Tag("several")],
    Discriminator(_kind),
]
