"""Rooms in which a track may lie: how its floor, walls and light look to a camera (`track.floor=gym`).

A printed track keeps its shape wherever it is rolled out; what surrounds it and the light change. No room was measured:
colours are this project's judgement of what a camera's own exposure makes of them. Grip is left as it is.
"""

import re
from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.types import Override

from deepracer_exp.errors import Unknown, nearest

from .overrides import override_line, parse_single

ROOMS: dict[str, dict[str, Any]] = {
    # White barriers close to the track, spotlights, a dark ceiling far up.
    "hall": {
        "road_color": "#43484e",
        "ground_color": "#57755e",
        "line_color": "#f4f4f0",
        "dash_color": "#e8a02a",
        "wall_color": "#cfd0d0",
        "sky_color": "#26272a",
        "walls_beyond_m": 0.6,
        "walls_height_m": 0.75,
        "walls_light": [0.9, 0.8, 1.0, 0.8],
    },
    # Daylight from windows on one side, light linoleum, white walls.
    "classroom": {
        "road_color": "#5a5e64",
        "ground_color": "#b9b4a6",
        "line_color": "#fbfbf7",
        "dash_color": "#e6b04a",
        "wall_color": "#e6e4de",
        "sky_color": "#eceeef",
        "walls_beyond_m": 1.5,
        "walls_height_m": 2.4,
        "walls_light": [1.0, 0.65, 0.8, 0.9],
    },
    # A wooden floor in even light, walls far away.
    "gym": {
        "road_color": "#4b4d50",
        "ground_color": "#b98a55",
        "line_color": "#f6f2e6",
        "dash_color": "#e39a20",
        "wall_color": "#c9c0ae",
        "sky_color": "#8d8f90",
        "walls_beyond_m": 4.0,
        "walls_height_m": 4.0,
        "walls_light": [1.0, 0.9, 1.0, 0.9],
    },
    # One warm lamp over grey concrete.
    "garage": {
        "road_color": "#2b2c2d",
        "ground_color": "#5f5a52",
        "line_color": "#c8c0ac",
        "dash_color": "#b5761f",
        "wall_color": "#7d7464",
        "sky_color": "#35322d",
        "walls_beyond_m": 1.0,
        "walls_height_m": 2.2,
        "walls_light": [1.0, 0.5, 0.7, 0.4],
    },
}
"""Values of `track.floor` by the name of a room."""
_FLOOR = re.compile(r"track\.([^.]+\.)?floor")


def in_rooms(overrides: Sequence[Override]) -> list[Override]:
    """Return overrides with the names of rooms replaced by their values, before all others: these have priority.

    Raises:
        BadInput: there is no such room.
    """
    furnished, others = list[Override](), list[Override]()
    for override in overrides:
        key, room = override.key_or_group, override.value()
        if override.is_delete() or not isinstance(room, str) or not _FLOOR.fullmatch(key):
            others.append(override)
            continue
        if room not in ROOMS:
            raise Unknown(
                f"{key}={room}", f"no such room{nearest(room, list(ROOMS))}; rooms: {', '.join(ROOMS)}"
            )
        furnished += [
            parse_single(override_line(f"{key}.{name}", value)) for name, value in ROOMS[room].items()
        ]
    return [*furnished, *others]
