"""The 127 worlds of the DeepRacer service.

`worlds.zip` holds their names and their routes: the coordinates of deepracer-simapp (Apache-2.0), rounded to 0.1 mm.
Every world has the rows of its own file in their order, so that waypoints have the numbers they have in the service.
`python -m benchmarks.build_catalogue` writes it; `tracks.catalogue` makes courses of it.
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
    """What is known of a world besides its route."""

    name: str
    family: str
    """Worlds of one course: sampled again for a direction, mirrored, with other scenery or on another floor."""
    title: str
    """The course's official name; where the service publishes none, its name in words."""
    rows: int


@cache
def worlds() -> Mapping[str, World]:
    """Return the worlds by their names; those of a family follow each other, the one it is known by first."""
    with zipfile.ZipFile(FILE) as file:
        found = [World(**one) for one in json.loads(file.read(INDEX))["worlds"]]
    return {world.name: world for world in found}


@cache
def leaders() -> tuple[str, ...]:
    """Return the name of the first world of each family."""
    first: dict[str, str] = {}
    for world in worlds().values():
        first.setdefault(world.family, world.name)
    return tuple(first.values())


def find_world(name: str) -> str | None:
    """Return the world called `name` in any case of letters, or officially so called; None: there is none.

    A path or ARN before the name is ignored. An official name stands for the first world that has it.
    """
    wanted = name.rsplit("/", 1)[-1].casefold()
    for called in ("name", "title"):
        for world in worlds().values():
            if getattr(world, called).casefold() == wanted:
                return world.name
    return None
