"""The worlds of the DeepRacer service, today's 127 and seven of earlier years.

`worlds.zip` holds their names and their routes: the coordinates of deepracer-simapp (Apache-2.0) and, of the earlier
ones, deepracer-analysis (MIT-0), rounded to 0.1 mm. Every world has the rows of its own file in their order, so that
waypoints have the numbers they have in the service.
`python -m benchmarks.build_catalogue` writes it; `tracks.track.world_track` builds a course from it.
"""

import json
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

FILE = Path(__file__).with_name("worlds.zip")
INDEX, ROUTES = "index.json", "routes.npy"
UNITS_PER_M = 10_000
"""The stored coordinates are in tenths of a millimetre."""


class World(NamedTuple):
    """A world, without its route."""

    name: str
    family: str
    """Name of the first world of the same course: others are resampled, mirrored, or have other scenery or floors."""
    title: str
    """The course's official title; where the service publishes none, a readable name."""
    rows: int


@cache
def worlds() -> Mapping[str, World]:
    """Return the worlds by name; those of a family are adjacent, its best known world first."""
    with zipfile.ZipFile(FILE) as file:
        listed = [World(**fields) for fields in json.loads(file.read(INDEX))["worlds"]]
    return {world.name: world for world in listed}


@cache
def leaders() -> tuple[str, ...]:
    """Return the name of the first world of each family."""
    first: dict[str, str] = {}
    for world in worlds().values():
        first.setdefault(world.family, world.name)
    return tuple(first.values())


def find_world(name: str) -> str | None:
    """Return the name of a world by its name or official title, ignoring case; None if there is none.

    A path or ARN before the name is ignored. A title stands for the first world that has it.
    """
    wanted = name.rsplit("/", 1)[-1].casefold()
    for called in ("name", "title"):
        for world in worlds().values():
            if getattr(world, called).casefold() == wanted:
                return world.name
    return None
