"""Override expressions as users type them: Hydra's grammar, extended for paths and addresses."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import OverrideParseException

from deepracer_exp.errors import BadInput, reading

from .own_class import GROUPS

# An override may add keys to these mappings.
OPEN_MAPPINGS = ("reward.constants", *(f"{group}.kwargs" for group in GROUPS))
# Values of these keys are taken literally: without quotes, Hydra's grammar accepts no umlaut, bracket or second
# equals sign in a value, and a comma makes a sweep.
PLAIN_TEXT = (
    *("track.file", "reward.file", "action_space.file", "custom_files", "runs_dir", "tracking.uri"),
    # Of commands that read runs; the number of an iteration has leading zeros.
    *("checkpoint", "rival", "rival_checkpoint", "race.rivals.policy", "race.rivals.checkpoint"),
    # Of sweeps.
    *("study", "parent", "sweep.storage"),
)
_KEYS = "|".join((*map(re.escape, PLAIN_TEXT), r"track\.[\w-]+\.file"))
_PLAIN = re.compile(rf"(\+{{0,2}}(?:{_KEYS})=)(.+)", re.DOTALL)
_LONGEST = 20_000
"""Most characters of an override; Hydra's parser takes a minute for many more."""
# A track may be called 2022_summit_speedway; Hydra's keys begin with a letter.
_DIGIT = re.compile(r"([+~]*track\.)(?=\d)")


def parse_single(override: str) -> Override:
    """Parse an override that gives one value.

    Raises:
        BadInput: it cannot be parsed, or gives several values.
    """
    plain = _PLAIN.fullmatch(override)
    parsed = _parse(plain[1] + _quoted(plain[2]) if plain else override)
    if parsed.is_sweep_override():
        raise BadInput(
            override, "several values for one run; -m runs each of them, a list is written KEY=[A,B]"
        )
    return parsed


def parse_sweep(override: str) -> Override:
    """Parse an override that may give several values, as in ``seed=0,1`` or ``seed=range(3)``.

    Raises:
        BadInput: it cannot be parsed.
    """
    try:
        return _parse(override)
    except BadInput:
        plain = _PLAIN.fullmatch(override)
        if plain is None:
            raise
        return _parse(plain[1] + ",".join(_quoted(part) for part in plain[2].split(",")))


def may_be_new(override: Override) -> bool:
    """Return whether an override may add a key that the chosen options do not have."""
    inside = any(override.key_or_group.startswith(f"{mapping}.") for mapping in OPEN_MAPPINGS)
    return inside or override.is_add() or override.is_force_add()


def override_line(key: str, value: object) -> str:
    """Return the expression that sets `key` to a plain value: a number, text, list, mapping or null."""
    return f"{key}={_expression(value)}"


def _expression(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_expression(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_expression, value)) + "]"
    return _in_quotes(value) if isinstance(value, str) else repr(value)


def _parse(override: str) -> Override:
    if len(override) > _LONGEST:
        raise BadInput(f"{override[:60]}...", f"{len(override):,} characters", f"up to {_LONGEST:,}")
    with reading(override):
        try:
            parsed: Sequence[Override] = OverridesParser.create().parse_overrides(
                [_DIGIT.sub(r"\1_", override)]
            )
        except OverrideParseException as error:
            reason = str(error).splitlines()[0]
            key, equals, value = override.partition("=")
            quotes = f"; a value with special characters needs quotes: \"{key}='{value}'\"" if equals else ""
            raise BadInput(
                override or repr(""), f"not an override ({reason}); write GROUP=OPTION or KEY=VALUE{quotes}"
            ) from error
    if not parsed[0].key_or_group:
        raise BadInput(override, "no key before the equals sign; write GROUP=OPTION or KEY=VALUE")
    if _DIGIT.match(override):
        parsed[0].key_or_group = parsed[0].key_or_group.replace("track._", "track.", 1)
        parsed[0].input_line = override
    return parsed[0]


def _quoted(value: str) -> str:
    """Return the value as a quoted string of Hydra's grammar, unless it is quoted already or null."""
    if not value or value[0] in "'\"" or value.lower() == "null":
        return value
    if value.startswith("~"):
        # The shell expands it at the beginning of a word only.
        with reading(value):
            value = str(Path(value).expanduser())
    return _in_quotes(value)


def _in_quotes(value: str) -> str:
    # Backslashes are literal, except in front of a quote.
    escaped = re.sub(r"(\\*)('|$)", lambda match: match[1] * 2 + ("\\'" if match[2] else ""), value)
    return f"'{escaped}'"


def key_of(line: str) -> str:
    """Return the key or group of an override without parsing it."""
    return line.partition("=")[0].strip().lstrip("+~")


def group_of(line: str) -> str:
    """Return the first part of an override's key."""
    return key_of(line).partition(".")[0]


def first_given(typed: Mapping[str, str], *keys: str) -> str | None:
    """Return the first of these overrides that the user gave, or None; `typed` has them by key or group."""
    return next((typed[key] for key in keys if key in typed), None)
