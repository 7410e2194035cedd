"""A nested configuration as flat MLflow parameters."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

Scalar = str | int | float | bool | None

LONGEST_PARAM = 250
"""Characters of a parameter's value. MLflow 3 takes 6000, servers before 2.10 took 500 and before 1.28 250;
and the comparison page shows every character."""


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Scalar]:
    """Return `config` with dotted keys; lists become compact JSON, an empty mapping becomes `{}`."""
    flat: dict[str, Scalar] = {}
    for name, value in config.items():
        key = f"{prefix}{name}"
        if isinstance(value, Mapping) and value:
            flat.update(flatten(value, f"{key}."))
        elif isinstance(value, list | tuple | Mapping):
            flat[key] = json.dumps(value, separators=(",", ":"), ensure_ascii=False)
        else:
            flat[key] = value
    return flat


def param_text(value: Scalar) -> str:
    """Return `value` as YAML writes it, shortened to `LONGEST_PARAM` characters.

    A shortened value ends in a hash of the whole, so that two that differ behind the cut look different.
    """
    text = json.dumps(value) if value is None or isinstance(value, bool) else str(value)
    if len(text) <= LONGEST_PARAM:
        return text
    mark = f"… sha256:{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    return text[: LONGEST_PARAM - len(mark)] + mark
