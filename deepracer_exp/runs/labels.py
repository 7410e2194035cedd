"""Labels that people give a run: a name, a note and tags, in its folder and, as tags, in MLflow."""

import json
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from pydantic import TypeAdapter

from deepracer_exp.errors import BadInput
from deepracer_exp.files import atomic_write, read_json_as

from .run_files import LABELS

_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,59}")
_LONGEST = 2000
USER_TAG = "tag."
"""Beginning of the names of people's own tags, as columns of lists and as tags in MLflow."""


@dataclass(frozen=True)
class Labels:
    """labels.json of a run folder."""

    name: str | None = None
    """Name by which lists show the run and commands find it, beside its folder's name."""
    note: str | None = None
    tags: dict[str, str] = field(default_factory=dict)

    @property
    def named_tags(self) -> dict[str, str]:
        """Return the tags with `USER_TAG` before their keys."""
        return {f"{USER_TAG}{key}": value for key, value in self.tags.items()}


_LABELS = TypeAdapter(Labels)


def read_labels(run_dir: Path) -> Labels:
    """Return the labels of a run; none if it was given none.

    Raises:
        BadInput: the file cannot be read or holds something else.
    """
    return read_json_as(run_dir / LABELS, _LABELS, "`runs rename`, `note` and `tag`") or Labels()


def write_labels(run_dir: Path, labels: Labels) -> None:
    """Write the labels of a run, atomically."""
    atomic_write(run_dir / LABELS, json.dumps(asdict(labels), indent=1, ensure_ascii=False) + "\n")


def check_label(what: str, text: str) -> str:
    """Return a name, note or value of a tag; `what` begins the message.

    Raises:
        BadInput: it is longer than MLflow and a table can take, or has control characters.
    """
    if len(text) > _LONGEST or not all(letter.isprintable() for letter in text):
        raise BadInput(what, "", f"one line of at most {_LONGEST:,} characters")
    return text


def check_tag(word: str) -> tuple[str, str]:
    """Return key and value of `KEY=VALUE`; without a value the tag is removed.

    Raises:
        BadInput: it is none.
    """
    key, equals, value = word.partition("=")
    if not equals or not _KEY.fullmatch(key):
        raise BadInput(word, "", "KEY=VALUE, where KEY has letters, digits, '_', '.' and '-'")
    return key, check_label(word[:60], value)


def named_folders(folders: Iterable[Path], name: str) -> list[Path]:
    """Return the runs that `runs rename` has given a name; one whose labels cannot be read has none."""
    matches = []
    for folder in folders:
        with suppress(BadInput):
            if read_labels(folder).name == name:
                matches.append(folder)
    return matches
