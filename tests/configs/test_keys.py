"""Every key is explained in conf/, once for all options, and is a field of a dataclass; every field is such a key."""

import dataclasses
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import pytest
import yaml

from deepracer_exp.config.evaluation import EvaluateConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.options import conf_dir, groups
from deepracer_exp.config.own_class import OwnClass
from deepracer_exp.config.sweep import SweepEntry

OPEN = ("constants", "kwargs", "space")
"""Mappings whose keys are the user's own."""
FILES = sorted(path for path in conf_dir().rglob("*.yaml") if path.parent.name != "experiment")


def fields(kind: Any, prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of a dataclass, or of those that a type is made of."""
    if get_origin(kind) in (Union, types.UnionType, tuple, dict, list):
        for part in get_args(kind):
            yield from fields(part, prefix)
    if not dataclasses.is_dataclass(kind) or kind is OwnClass:
        return
    for name, part in get_type_hints(kind).items():
        yield f"{prefix}{name}"
        yield from fields(part, f"{prefix}{name}.")


def keys(
    node: yaml.Node, lines: list[str], prefix: str, explained: bool = False
) -> Iterator[tuple[str, bool]]:
    """Yield the dotted keys of a file, and whether each has a comment above it; that of a list explains its items."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            yield from keys(item, lines, prefix, explained=True)
    elif isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if key.value == "defaults":
                continue
            above = lines[key.start_mark.line - 1].strip() if key.start_mark.line else ""
            has_comment = explained or above.startswith("#")
            yield f"{prefix}{key.value}", has_comment
            if key.value not in OPEN:
                # One comment explains the keys of {a: 1, b: 2}.
                inline = has_comment and getattr(value, "flow_style", False)
                yield from keys(value, lines, f"{prefix}{key.value}.", inline)


def keys_of(path: Path) -> dict[str, bool]:
    """Return the keys of an option file or an entry point, and whether each is explained."""
    text, folder = path.read_text(encoding="utf-8"), path.parent.relative_to(conf_dir()).as_posix()
    prefix = "" if folder == "." else f"{folder.replace('/', '.')}."
    return dict(keys(yaml.compose(text), text.splitlines(), prefix))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(conf_dir()).as_posix())
def test_every_key_of_a_file_has_a_comment_above_it(path):
    assert [key for key, has_comment in keys_of(path).items() if not has_comment] == []


def test_the_keys_that_are_explained_are_the_fields_of_the_dataclasses():
    entries = (Experiment, EvaluateConfig, SweepEntry)
    chosen = {group.replace("/", ".") for entry in conf_dir().glob("*.yaml") for group in groups(entry.stem)}
    named = {key for kind in entries for key in fields(kind)} - chosen
    explained = {key for path in FILES for key in keys_of(path)} - {"tracking"}
    assert explained == named - {"tracking"}
