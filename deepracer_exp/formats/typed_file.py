"""JSON files whose keys and types are those of a dataclass."""

import os
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from deepracer_exp.errors import BadInput

from .user_file import read_bytes

Content = TypeVar("Content")


def read_typed(file: Path, adapter: TypeAdapter[Content], writer: str) -> Content | None:
    """Read a file, None where there is none.

    Args:
        file: to read.
        adapter: of the dataclass.
        writer: who writes such files, for messages: ``a clone``.

    Raises:
        BadInput: the file cannot be read or holds something else.
    """
    if not os.path.lexists(file):
        return None
    raw = read_bytes(file, f"what {writer} writes there")
    try:
        return adapter.validate_json(raw, strict=True)
    except ValidationError as error:
        finding = error.errors(include_url=False)[0]
        where = "".join(f" {part}:" for part in finding["loc"])
        raise BadInput(f"{file}:{where} {finding['msg']}; accepted: what {writer} writes there") from error
