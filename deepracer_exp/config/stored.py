"""The stored configuration of a run: changed by overrides, compared with others."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from deepracer_exp.addresses import without_passwords
from deepracer_exp.errors import BadInput, Unknown, nearest

from . import acting, custom_files
from .compose import Composition, compose_entry
from .options import groups
from .overrides import OPEN_MAPPINGS, parse_single
from .own_class import allow, allow_given

_WHOLE = ("experiment", custom_files.KEY)
ABSENT = "\N{EN DASH}"
"""Stands for a missing value."""


def with_overrides(
    config: Mapping[str, Any], choices: Mapping[str, str], overrides: Sequence[str], *, stored: bool = False
) -> Composition:
    """Change a stored configuration, without values that act and are foreign (`acting.leave_out_foreign`).

    Args:
        config: all values, as in config.yaml.
        choices: the options the values came from, by group.
        overrides: of whole groups (``track=Oval_track``), which are composed again, and of single values.
        stored: whether a study holds the overrides; the user's own words otherwise.

    Returns:
        The changed values; a note for each value that was left out and is not among the overrides.

    Raises:
        BadInput: an override cannot be parsed, names something unknown or would replace the whole experiment.
    """
    overrides = without_passwords(list(overrides))
    # The parts of an observation are a list: naming one again changes no value.
    parts = [override for override in overrides if override.startswith("observation.target=")]
    if not stored:
        allow_given(parts)
    parsed = [parse_single(override) for override in overrides if override not in parts]
    values = without_passwords(dict(config))
    left_out = acting.leave_out_foreign(values, "the stored run")
    chosen = [one for one in parsed if one.key_or_group in groups() and not one.is_delete()]
    for one in parsed:
        if one.key_or_group in _WHOLE:
            raise BadInput(
                one.input_line,
                "would replace the whole experiment; give the groups and values to change, such as track=Oval_track",
            )
    new: dict[str, str] = {}
    if chosen:
        composed = compose_entry("train", [one.input_line or "" for one in chosen], stored=stored)
        for one in chosen:
            values[one.key_or_group] = composed.mapping[one.key_or_group]
            new[one.key_or_group] = composed.choices[one.key_or_group]
    for one in parsed:
        if one not in chosen:
            if one.is_delete() or one.package is not None:
                raise BadInput(one.input_line, "accepted here: GROUP=OPTION or KEY=VALUE")
            _set(values, one.key_or_group, one.value())
    keys = [one.key_or_group for one in parsed]
    if stored:
        left_out += acting.leave_out_foreign(values, "the study")
    else:
        for one in parsed:
            allow({one.key_or_group.rpartition(".")[2]: one.value()})
        acting.name([one for one in acting.acting(values) if _touches(keys, one.key)])
    return Composition(
        overrides=tuple(overrides),
        choices={**choices, **new},
        mapping=values,
        names={},
        notes=tuple(line for line in left_out if not _touches(keys, line.partition("=")[0])),
    )


def config_differences(configs: Sequence[Mapping[str, Any]], prefix: str = "") -> dict[str, list[Any]]:
    """Return the values that differ between configurations, by dotted key; ABSENT for a missing key.

    Args:
        configs: the values of each configuration.
        prefix: prefix of the keys.
    """
    found: dict[str, list[Any]] = {}
    for key in dict.fromkeys(key for config in configs for key in config):
        values = [config.get(key, ABSENT) for config in configs]
        if all(isinstance(value, Mapping) for value in values):
            found |= config_differences(values, f"{prefix}{key}.")
        elif any(value != values[0] for value in values):
            found[f"{prefix}{key}"] = values
    return found


def describe_differences(different: Mapping[str, Sequence[Any]]) -> list[str]:
    """Return differences as text, e.g. ``algorithm.lr: 0.001 -> 0.0001``."""
    return [f"{key}: {' -> '.join(map(_short, values))}" for key, values in different.items()]


def _set(values: dict[str, Any], key: str, value: Any) -> None:
    *path, leaf = key.split(".")
    node: Any = values
    for depth, part in enumerate(path):
        if not isinstance(node, dict) or part not in node:
            raise _unknown(key, ".".join(path[: depth + 1]), node)
        node = node[part]
    if not isinstance(node, dict) or (leaf not in node and ".".join(path) not in OPEN_MAPPINGS):
        raise _unknown(key, key, node)
    node[leaf] = value


def _touches(overridden: Sequence[str], key: str) -> bool:
    """Return whether one of the overridden keys is a key, its group, or a part of it."""
    return any(f"{key}.".startswith(f"{one}.") or one.startswith(f"{key}.") for one in overridden)


def _unknown(key: str, at: str, node: Any) -> BadInput:
    known = [str(name) for name in node] if isinstance(node, dict) else []
    leaf = at.rpartition(".")[2]
    return Unknown(key, f"no such key{nearest(leaf, known)}; known there: {', '.join(known) or 'none'}")


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
