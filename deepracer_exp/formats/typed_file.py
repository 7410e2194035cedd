"""JSON files whose keys and types are those of a dataclass."""

from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from deepracer_exp.errors import BadInput

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
    try:
        return adapter.validate_json(file.read_bytes(), strict=True)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise BadInput(f"{file}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        finding = error.errors(include_url=False)[0]
        where = "".join(f" {part}:" for part in finding["loc"])
        raise BadInput(f"{file}:{where} {finding['msg']}; wanted is what {writer} writes there") from error
