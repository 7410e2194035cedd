"""The track an experiment drives on (`conf/track/`)."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

from .bounds import Finite, NonNegative, Positive

Point = tuple[Finite, Finite]
Color = Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")]
# Each dash is drawn.
DashLength = Annotated[float, Field(ge=0.01, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class FloorConfig:
    """Grip, lines and colours of a track and its surroundings."""

    friction: Positive
    road_color: Color
    ground_color: Color
    line_color: Color
    lines_inside: bool = True
    dash_color: Color = "#e38b05"
    dash_length_m: DashLength = 0.0508
    dash_gap_m: DashLength = 0.0508
    start_line_color: Color | None = None
    kerb_color: Color | None = None
    wall_color: Color = "#244651"
    sky_color: Color = "#272727"
    walls_beyond_m: Positive | None = 0.91
    walls_height_m: Positive = 1.0
    walls_follow_road: bool = False
    walls_light: tuple[NonNegative, NonNegative, NonNegative, NonNegative] = (1.0, 0.3, 1.0, 0.3)


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """A course: a world of the service, spline knots, or a file."""

    name: str
    title: str
    direction: Literal["forward", "reversed", "alternate"]
    weight: Positive
    file: str | None
    knots: tuple[Point, ...] | None
    width_m: Positive | tuple[Positive, ...] | None
    closed: bool
    floor: FloorConfig


def _kind(value: Any) -> str:
    """Return whether this is one track or several; the values of one are not all mappings."""
    several = isinstance(value, dict) and value and all(isinstance(item, dict) for item in value.values())
    return "several" if several else "one"


Tracks = Annotated[
    Annotated[TrackConfig, Tag("one")] | Annotated[dict[str, TrackConfig], Tag("several")],
    Discriminator(_kind),
]
