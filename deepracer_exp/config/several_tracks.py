"""Several tracks at once: `track=[A,B]` or `track=all`, and overrides of one of them or of all.

Hydra composes each option into a place of its own under `PLACE`; afterwards they stand by their names under `track`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from hydra.core.override_parser.types import Override

from deepracer_exp.errors import BadInput, nearest

from .options import options
from .overrides import parse_single
from .track import TrackConfig

GROUP = "track"
ALL = "all"
PLACE = "several_tracks"


@dataclass(frozen=True)
class SeveralTracks:
    """What the overrides say of the tracks."""

    names: tuple[str, ...]
    choosing: tuple[str, ...]
    """Expressions that make Hydra compose the options."""
    changing: tuple[Override, ...]
    """Overrides of their values: those of all tracks first, so that a track's own win."""

    def put_in_place(self, mapping: dict[Any, Any]) -> None:
        """Put the tracks under `track`, by their names."""
        places = mapping.pop(PLACE)
        mapping[GROUP] = {name: places[_place(at)] for at, name in enumerate(self.names)}


def several_tracks(own: Sequence[Override]) -> SeveralTracks | None:
    """Return what the overrides say of several tracks; None where they choose one, or none.

    Raises:
        BadInput: a track is unknown or chosen twice, none is chosen, or a value is given to no chosen track.
    """
    chosen = [override for override in own if override.key_or_group == GROUP and not override.is_delete()]
    value = chosen[-1].value() if chosen else None
    known = options(GROUP)
    if value == ALL and ALL not in known:
        names = tuple(known)
    elif isinstance(value, list):
        names = tuple(str(name) for name in value)
        _check(chosen[-1].input_line or "", names, known)
    else:
        _check_single(own, known)
        return None
    choosing = [f"{GROUP}={names[0]}"]
    choosing += [f"+{GROUP}@{PLACE}.{_place(at)}={name}" for at, name in enumerate(names)]
    of_all: list[Override] = []
    of_one: list[Override] = []
    for override in own:
        if override.key_or_group.startswith(f"{GROUP}."):
            first, *_ = override.key_or_group.removeprefix(f"{GROUP}.").split(".")
            if first in names:
                of_one.append(_moved(override, f"{GROUP}.{first}", names.index(first)))
            else:
                _check_first(override, first, names)
                of_all += [_moved(override, GROUP, at) for at in range(len(names))]
    return SeveralTracks(names, tuple(choosing), (*of_all, *of_one))


def in_own_words(text: str) -> str:
    """Return a message of Hydra with the keys as they were typed."""
    return re.sub(rf"\b{PLACE}\.\w+\b", GROUP, text)


def _place(at: int) -> str:
    # Not its name: Hydra's keys begin with a letter.
    return f"place_{at}"


def _moved(override: Override, prefix: str, at: int) -> Override:
    line = override.input_line or ""
    return parse_single(line.replace(prefix, f"{PLACE}.{_place(at)}", 1))


def _check(line: str, names: Sequence[str], known: Sequence[str]) -> None:
    if not names:
        raise BadInput(
            f"{line}: no track; accepted: {GROUP}=[A,B], {GROUP}={ALL}; tracks: {', '.join(known)}"
        )
    for at, name in enumerate(names):
        if name not in known:
            raise BadInput(f"{line}: no such track {name}{nearest(name, known)}; options: {', '.join(known)}")
        if name in names[:at]:
            raise BadInput(
                f"{line}: {name} stands there twice; {GROUP}.{name}.weight=2 gives it twice the cars"
            )


def _check_single(own: Sequence[Override], known: Sequence[str]) -> None:
    for override in own:
        group, _, key = override.key_or_group.partition(".")
        name, _, key = key.partition(".")
        if group == GROUP and name in known:
            raise BadInput(
                f"{override.key_or_group}: accepted where several tracks are chosen ({GROUP}=[A,B]); of one track it "
                f"is {GROUP}.{key}"
            )


def _check_first(override: Override, first: str, names: Sequence[str]) -> None:
    keys = [field.name for field in fields(TrackConfig)]
    if first not in keys:
        raise BadInput(
            f"{override.key_or_group}: {first} is neither a chosen track nor a key of all tracks"
            f"{nearest(first, [*names, *keys])}; tracks: {', '.join(names)}; keys: {', '.join(keys)}"
        )
