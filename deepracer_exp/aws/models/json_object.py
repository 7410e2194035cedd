"""A small JSON file written by people, with checks whose messages are one line."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.files import read_json


class JsonObject:
    """The object of a JSON file; of a key that appears twice the last one counts, as on the service."""

    def __init__(self, path: str | Path, kind: str, accepted: str, raw: bytes | None = None) -> None:
        """Read the file.

        Args:
            path: the file.
            kind: the kind of file, e.g. ``a model_metadata.json``.
            accepted: the accepted content, e.g. ``a JSON object with action_space``.
            raw: the file's content if known, e.g. of a member of an archive or a part of a log.

        Raises:
            BadInput: it cannot be read, is not a regular file, too large, not JSON, or not an object.
        """
        self.path = Path(path)
        data = read_json(path, kind, raw)
        if not isinstance(data, dict):
            raise BadInput(self.path, f"holds a {type(data).__name__}", accepted)
        self.data: Mapping[str, Any] = data

    def bad(self, key: str, value: object, accepted: str) -> BadInput:
        """Return the error for one value; None stands for a missing one."""
        shown = "missing" if value is None else json.dumps(value, ensure_ascii=False, default=repr)
        shown = shown if len(shown) <= 80 else shown[:79] + "…"
        return BadInput(self.path, f"{key}: {shown}", accepted)

    def choice(self, key: str, value: object, options: Sequence[str], lower: bool = True) -> str:
        """Return one of the known words, stripped and by default lower-cased, as the service reads it."""
        word = value.strip() if isinstance(value, str) else ""
        word = word.lower() if lower else word
        if word not in options:
            raise self.bad(key, value, ", ".join(options) + nearest(word, options))
        return word

    def number(self, key: str, value: object, low: float, high: float, unit: str = "") -> float:
        """Return a number from `low` to `high`, which may be written as a string."""
        try:
            number = math.nan if isinstance(value, bool) else float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not low <= number <= high:
            raise self.bad(key, value, f"a number from {low:g} to {high:g}{unit}")
        return number

    def whole(self, key: str, value: object, low: int, high: int) -> int:
        """Return a whole number from `low` to `high`, which may be written as a string."""
        number = self.number(key, value, low, high)
        if number != int(number):
            raise self.bad(key, value, f"a whole number from {low} to {high}")
        return int(number)
