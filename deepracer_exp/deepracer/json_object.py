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
            kind: what it should be, e.g. ``a model_metadata.json``.
            accepted: what its JSON should hold, e.g. ``a JSON object with action_space``.
            raw: the file's content if known, as of a member of an archive or a part of a log.

        Raises:
            BadInput: it cannot be read, is not a regular file, too large, not JSON, or not an object.
        """
        self.path = Path(path)
        data = read_json(path, kind, raw)
        if not isinstance(data, dict):
            raise BadInput(f"{self.path}: holds a {type(data).__name__}; accepted: {accepted}")
        self.data: Mapping[str, Any] = data

    def bad(self, key: str, value: object, accepted: str) -> BadInput:
        """Return the error for one value; None stands for a missing one."""
        shown = "missing" if value is None else json.dumps(value, ensure_ascii=False, default=repr)
        shown = shown if len(shown) <= 80 else shown[:79] + "…"
        return BadInput(f"{self.path}: {key}: {shown}; accepted: {accepted}")

    def choice(self, key: str, value: object, known: Sequence[str], lower: bool = True) -> str:
        """Return `value` stripped and by default lower-cased, as the service reads it.

        Raises:
            BadInput: it is not one of `known`.
        """
        accepted = ", ".join(known)
        if not isinstance(value, str):
            raise self.bad(key, value, accepted)
        word = value.strip().lower() if lower else value.strip()
        if word not in known:
            raise self.bad(key, value, accepted + nearest(word, known))
        return word

    def number(self, key: str, value: object, low: float, high: float, unit: str = "") -> float:
        """Return a number, which may be written as a string.

        Raises:
            BadInput: it is not a number from `low` to `high`.
        """
        accepted = f"a number from {low:g} to {high:g}{unit}"
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise self.bad(key, value, accepted)
        try:
            number = float(value)
        except (ValueError, OverflowError) as error:
            raise self.bad(key, value, accepted) from error
        if not math.isfinite(number) or not low <= number <= high:
            raise self.bad(key, value, accepted)
        return number

    def whole(self, key: str, value: object, low: int, high: int) -> int:
        """Return a whole number, which may be written as a string.

        Raises:
            BadInput: it is not a whole number from `low` to `high`.
        """
        number = self.number(key, value, low, high)
        if number != int(number):
            raise self.bad(key, value, f"a whole number from {low} to {high}")
        return int(number)
