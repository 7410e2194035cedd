"""The options of the group `track`: the service's worlds and your own tracks, one or several at once.

Worlds need no files: Hydra finds them by name. Keys that an option omits have the values of
`conf/track/reinvent_base.yaml`, so that a track of your own needs `knots` and `width_m` only.
"""

import re
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from hydra.core.override_parser.types import Override

from deepracer_exp.aws.worlds.catalogue import find_world, leaders, worlds
from deepracer_exp.errors import BadInput, Unknown, nearest

from .driving import TrackConfig
from .options import conf_dir, listed, options
from .overrides import override_line, parse_single

GROUP = "track"
ALL = "all"
BASE = "reinvent_base"
"""The option whose values are the defaults of all others."""

# Meshes and textures of the service's worlds (deepracer-simapp, `bundle/meshes`), the first pattern that matches; those
# of 2018 have colours of their own. Walls of 9.14 m (30 ft) and 0.76 m beyond the road are of the generated worlds;
# less is known of worlds whose meshes are spread over many files.
_OF_2018 = re.compile(r"reinvent_")
_LATER_FLOOR: dict[str, Any] = {
    "road_color": "#403f3d",
    "ground_color": "#7e8541",
    "line_color": "#dfdfdf",
    "dash_color": "#e18f00",
    "sky_color": "#b2b2b2",
    "walls_beyond_m": None,
}
_START_LINE: dict[str, Any] = {"start_line_color": "#3f3e3d"}
_FLOORS: dict[str, dict[str, Any]] = {
    # The barrier is open towards the pits, where ours is closed.
    "Spain_track": {
        "lines_inside": False,
        "dash_length_m": 0.076,
        "dash_gap_m": 0.055,
        "kerb_color": "#880c0c",
        "wall_color": "#312529",
        "walls_beyond_m": 0.82,
        "walls_height_m": 0.19,
        "walls_follow_road": True,
    },
    r"AWS_track|Bowtie|Oval|Straight|Virtual_May19": {"walls_beyond_m": 0.76, "lines_inside": False},
    r"reInvent2019_(track|wide|wide_mirrored)$|Canada|China|H_track|London|Mexico|New_York|Tokyo|Vegas": {
        "walls_beyond_m": 0.76
    },
    r"2022_reinvent_champ|2022_(april|may|june|july|august|september|october)_(open|pro)$": _START_LINE,
    r"20.*(cw|mini)$|.*_c?cw$": _START_LINE | {"walls_beyond_m": 0.76},
    r"LGSWide": {"walls_beyond_m": 9.14},
    r"20|A[lmr]|Belille|FS_|arctic|dubai|hamption|jyllands|morgan|penbay|red_star|thunder": _START_LINE
    | {"walls_beyond_m": 9.14},
}


def world_values(option: str) -> dict[str, Any] | None:
    """Return the values of a world that has no file in `conf/track`; None for any other option."""
    world = worlds().get(option)
    if world is None or (conf_dir() / GROUP / f"{option}.yaml").is_file():
        return None
    values: dict[str, Any] = {"name": world.name, "title": world.title}
    if not _OF_2018.match(world.name):
        floors = (floor for pattern, floor in _FLOORS.items() if re.match(pattern, world.name))
        values["floor"] = _LATER_FLOOR | next(floors, {})
    return values


def by_world_name(override: Override) -> Override:
    """Return the choice of a track with official titles of worlds replaced by their names."""
    value = override.value()
    if override.key_or_group != GROUP or not isinstance(value, str | list):
        return override
    names = options(GROUP)

    def world_name(name: object) -> object:
        return name if name in (ALL, *names) or "/" in str(name) else find_world(str(name)) or name

    named = [world_name(name) for name in value] if isinstance(value, list) else world_name(value)
    return override if named == value else parse_single(override_line(GROUP, named))


def several_tracks(
    choosing: Sequence[Override], changing: Sequence[Override]
) -> tuple[tuple[str, ...], list[Override]]:
    """Return the several tracks that overrides choose, and the overrides of values with a track's name in their keys.

    `choosing` are overrides of groups, `changing` those of values.

    Returns:
        Names; none if one track or none is chosen. Overrides of all tracks before those of single ones, which have
        priority.

    Raises:
        BadInput: a track is unknown or chosen twice, the list is empty, or a value is set for a track not chosen.
    """
    chosen = [choice for choice in choosing if choice.key_or_group == GROUP and not choice.is_delete()]
    value = chosen[-1].value() if chosen else None
    tracks = options(GROUP)
    if value == ALL and ALL not in tracks:
        variants = worlds().keys() - set(leaders())
        names = tuple(name for name in tracks if name not in variants)
    elif isinstance(value, list):
        names = tuple(str(name) for name in value)
        _check(chosen[-1].input_line or "", names, tracks)
    else:
        _check_single(changing, tracks)
        return (), list(changing)
    others: list[Override] = []
    of_all: list[Override] = []
    of_one: list[Override] = []
    for override in changing:
        group, _, key = override.key_or_group.partition(".")
        first = key.partition(".")[0]
        if group != GROUP:
            others.append(override)
        elif first in names:
            of_one.append(override)
        else:
            _check_first(override, first, names)
            of_all += [replace(override, key_or_group=f"{GROUP}.{name}.{key}") for name in names]
    return names, [*others, *of_all, *of_one]


def _check(line: str, names: Sequence[str], tracks: Sequence[str]) -> None:
    if not names:
        raise BadInput(line, "no track", f"{GROUP}=[A,B], {GROUP}={ALL}; tracks: {listed(GROUP, tracks)}")
    for index, name in enumerate(names):
        if name not in tracks:
            raise Unknown(
                line, f"no such track {name}{nearest(name, tracks)}; options: {listed(GROUP, tracks)}"
            )
        if name in names[:index]:
            raise BadInput(line, f"{name} is listed twice; {GROUP}.{name}.weight=2 gives it twice the cars")


def _check_single(changing: Sequence[Override], tracks: Sequence[str]) -> None:
    for override in changing:
        group, _, key = override.key_or_group.partition(".")
        name, _, key = key.partition(".")
        if group == GROUP and name in tracks:
            raise BadInput(
                override.key_or_group,
                f"accepted with several tracks ({GROUP}=[A,B]) only; with one track write {GROUP}.{key}",
            )


def _check_first(override: Override, first: str, names: Sequence[str]) -> None:
    keys = [field.name for field in fields(TrackConfig)]
    if first not in keys:
        raise BadInput(
            f"{override.key_or_group}: {first} is neither a chosen track nor a key of all tracks"
            f"{nearest(first, [*names, *keys])}; tracks: {', '.join(names)}; keys: {', '.join(keys)}"
        )
