"""Classes of your own in the configuration, by `package.module:Class`.

Code is imported only if the user names its class or has trained with it before (`acting`). A stored run names its
classes only as text: a copied or downloaded run loads nothing by itself.
"""

import importlib
import inspect
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Discriminator, Field

from deepracer_exp.errors import BadInput, reading

from . import acting

GROUPS = ("network", "algorithm", "lr_schedule", "observation", "stopping", "tracking")
"""Groups whose option may be a class of your own."""
OF_POLICY = ("network", "observation")
"""Groups that a stored policy needs in an evaluation or an export."""
REFERENCE = r"[A-Za-z_][\w.]*:[A-Za-z_]\w*"
Reference = Annotated[str, Field(pattern=rf"^{REFERENCE}$")]
_GIVEN = re.compile(rf"(?:{'|'.join(GROUPS)})\.target=({REFERENCE})")

Base = TypeVar("Base")


@dataclass(frozen=True, kw_only=True)
class OwnClass:
    """A class of your own in place of one of ours."""

    target: Reference
    """`package.module:Class`, installed or in the working folder."""
    kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of its constructor."""

    @property
    def kind(self) -> str:
        """The kind of a group whose other options have a key `kind`."""
        return "own"


OURS_OR_OWN = Discriminator(lambda value: "own" if isinstance(value, dict) and "target" in value else "ours")
"""Chooses `OwnClass` where a group has a `target`; tags `ours` and `own`."""


def own_option(group: str, name: str) -> dict[str, Any] | None:
    """Return the values of the option `GROUP=package.module:Class`; None if it is none."""
    if group not in GROUPS or not re.fullmatch(REFERENCE, name):
        return None
    option = {"target": name, "kwargs": {}}
    if group == "algorithm":
        return {"defaults": ["ppo", "_self_"], **option}
    if group == "observation":
        return {"defaults": ["features", "_self_"], "parts": [option]}
    return option


def allow(values: Any) -> None:
    """Record the acting values, classes included, that the user's command or option files name."""
    acting.name([*map(acting.class_of, _references(values)), *acting.acting(values)])


def allow_given(overrides: Sequence[str]) -> list[str]:
    """Allow the classes of overrides `GROUP.target=package.module:Class` and return the other overrides."""
    targets = {line: match[1] for line in overrides if (match := _GIVEN.fullmatch(line))}
    acting.name([acting.class_of(target) for target in targets.values()])
    return [line for line in overrides if line not in targets]


def own_classes(config: Mapping[str, Any], groups: Sequence[str] = GROUPS) -> Iterator[tuple[str, str]]:
    """Return the classes of the user's own among the values of an experiment, each with its group."""
    for group in groups:
        values = config.get(group)
        parts = values.get("parts") if isinstance(values, dict) else None
        for part in (values, *(parts if isinstance(parts, list | tuple) else ())):
            if isinstance(part, dict) and isinstance(part.get("target"), str):
                yield group, part["target"]


def named_again(config: Mapping[str, Any], groups: Sequence[str] = GROUPS) -> list[str]:
    """Return the overrides that let a command import the classes of a stored run."""
    return [f"{group}.target={target}" for group, target in own_classes(config, groups)]


def load_class(target: str, key: str) -> type:
    """Import a class.

    `target` is `package.module:Class`, `key` the configuration's key for messages.

    Raises:
        BadInput: only a stored run or study names it, or it cannot be imported.
    """
    if not acting.class_of(target).is_own:
        raise BadInput(
            f"{key}={target}: named by a stored run, which imports no code by itself, and not a class that you have "
            f"trained with, or changed since; if you trust it, repeat {key}={target} on the command line"
        )
    # At the end: a file of the working folder never replaces an installed module.
    if (folder := str(Path.cwd())) not in sys.path:
        sys.path.append(folder)
    module, _, name = target.partition(":")
    with reading(f"{key}={target}", "package.module:Class, installed or in the working folder"):
        loaded = getattr(importlib.import_module(module), name)
    if not isinstance(loaded, type):
        raise BadInput(f"{key}={target}", f"is a {type(loaded).__name__}", "a class")
    return loaded


def build_own(chosen: OwnClass, key: str, base: type[Base], *arguments: Any) -> Base:
    """Build an object of a class of the user's own.

    It must derive from `base`; `arguments` precede its keyword arguments, and `key` is for messages.

    Raises:
        BadInput: it cannot be imported, has another base or signature, or its constructor fails.
    """
    kind = load_class(chosen.target, key)
    if not issubclass(kind, base):
        raise BadInput(f"{key}={chosen.target}", "", f"a subclass of {base.__module__}.{base.__qualname__}")
    signature = inspect.signature(kind)
    try:
        signature.bind(*arguments, **chosen.kwargs)
    except TypeError as error:
        raise BadInput(
            f"{key}={chosen.target}: {error}; {kind.__name__}{signature} is called with {len(arguments)} arguments and "
            f"kwargs {', '.join(chosen.kwargs) or 'none'}"
        ) from error
    with reading(f"{key}={chosen.target}"):
        return kind(*arguments, **chosen.kwargs)


def _references(values: Any) -> Iterator[str]:
    if isinstance(values, dict):
        for target in (values.get("target"), values.get("sampler")):
            if isinstance(target, str) and re.fullmatch(REFERENCE, target):
                yield target
        values = list(values.values())
    if isinstance(values, list):
        for value in values:
            yield from _references(value)
