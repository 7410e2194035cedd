"""The stored configuration of a run: changed by overrides, compared with others."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from deepracer_exp.addresses import without_passwords
from deepracer_exp.errors import BadInput, Unknown, nearest

from . import acting
from .compose import Composition, check_names, compose_entry, compose_evaluation
from .custom_files import model_files
from .evaluation import EvaluateConfig, EvaluationConfig
from .options import groups
from .overrides import OPEN_MAPPINGS, group_of, key_of, parse_single
from .own_class import allow, allow_given
from .parse import parse_config, take_over_files

_WHOLE = ("experiment", model_files.KEY)
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
        stored: whether the overrides come from a stored study, not from the user.

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
    chosen = [
        override for override in parsed if override.key_or_group in groups() and not override.is_delete()
    ]
    for change in parsed:
        if change.key_or_group in _WHOLE:
            raise BadInput(
                change.input_line,
                "would replace the whole experiment; give the groups and values to change, such as track=Oval_track",
            )
    new: dict[str, str] = {}
    if chosen:
        composed = compose_entry("train", [override.input_line or "" for override in chosen])
        for change in chosen:
            values[change.key_or_group] = composed.mapping[change.key_or_group]
            new[change.key_or_group] = composed.choices[change.key_or_group]
        if not stored:
            allow(composed.mapping)
    for change in parsed:
        if change not in chosen:
            if change.is_delete() or change.package is not None:
                raise BadInput(change.input_line, "accepted here: GROUP=OPTION or KEY=VALUE")
            _set(values, change.key_or_group, change.value())
    keys = [override.key_or_group for override in parsed]
    if stored:
        left_out += acting.leave_out_foreign(values, "the study")
    else:
        for change in parsed:
            allow({change.key_or_group.rpartition(".")[2]: change.value()})
        acting.name([value for value in acting.acting(values) if _touches(keys, value.key)])
    names = take_over_files(values)
    return Composition(
        overrides=tuple(overrides),
        choices={**choices, **new, **names},
        mapping=values,
        notes=tuple(line for line in left_out if not _touches(keys, line.partition("=")[0])),
    )


@dataclass(frozen=True)
class EvaluationRequest:
    """The requested evaluation of a stored run."""

    config: EvaluateConfig
    """All values; the protocol is the run's unless one is named."""
    composition: Composition
    changes: tuple[str, ...] | None
    """Overrides of the run's protocol, such as ``evaluation.trials=20``; None: another protocol is named."""

    def of_run(self, protocol: EvaluationConfig) -> EvaluateConfig:
        """Return the request for a run that its training evaluates by a protocol.

        Raises:
            BadInput: a change names something unknown or gives a value that is not accepted.
        """
        if self.changes is None:
            return self.config
        changed = with_overrides({"evaluation": asdict(protocol)}, {}, self.changes)
        config = parse_config(self.composition.mapping | changed.mapping, EvaluateConfig)
        check_names(config.evaluation)
        return config


def request_evaluation(overrides: Sequence[str]) -> EvaluationRequest:
    """Compose the overrides of a command that evaluates a stored run; raises as `compose_evaluation`."""
    is_named = any(key_of(override) == "evaluation" for override in overrides)
    changes = [] if is_named else [override for override in overrides if group_of(override) == "evaluation"]
    config, composition = compose_evaluation([override for override in overrides if override not in changes])
    return EvaluationRequest(config, composition, None if is_named else tuple(changes))


def config_differences(configs: Sequence[Mapping[str, Any]], prefix: str = "") -> dict[str, list[Any]]:
    """Return the values that differ between configurations, by dotted key; ABSENT for a missing key."""
    differences: dict[str, list[Any]] = {}
    for key in dict.fromkeys(key for config in configs for key in config):
        values = [config.get(key, ABSENT) for config in configs]
        if all(isinstance(value, Mapping) for value in values):
            differences |= config_differences(values, f"{prefix}{key}.")
        elif any(value != values[0] for value in values):
            differences[f"{prefix}{key}"] = values
    return differences


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
    return any(f"{key}.".startswith(f"{prefix}.") or prefix.startswith(f"{key}.") for prefix in overridden)


def _unknown(key: str, where: str, node: Any) -> BadInput:
    names = [str(name) for name in node] if isinstance(node, dict) else []
    leaf = where.rpartition(".")[2]
    return Unknown(key, f"no such key{nearest(leaf, names)}; known there: {', '.join(names) or 'none'}")


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
