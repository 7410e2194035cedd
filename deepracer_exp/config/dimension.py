"""One dimension of a search space, from a sweep expression: a list of choices, or a range of numbers."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from hydra.core.override_parser.types import (
    ChoiceSweep,
    Glob,
    IntervalSweep,
    Override,
    QuotedString,
    RangeSweep,
    Sweep,
    Transformer,
)

from deepracer_exp.errors import BadInput, nearest

from .options import groups, options
from .overrides import override_line, parse_single, parse_sweep

_MOST_VALUES = 100_000
Number = int | float
Choice = str | int | float | bool | None
"""A number, a truth value or null; anything else as an override expression, quotes included."""


@dataclass(frozen=True)
class Choices:
    """One of several values."""

    values: tuple[Choice, ...]


@dataclass(frozen=True)
class Range:
    """A number from `low` to `high`, both included; whole numbers are `int`."""

    low: Number
    high: Number
    step: Number | None
    """Distance between neighbours, counted from `low`; None: continuous."""
    log: bool
    """Whether to search on a logarithmic scale."""

    def values(self) -> list[Number] | None:
        """Return all values in ascending order; None for a continuous range.

        Raises:
            BadInput: there are too many.
        """
        if self.step is None:
            return None
        last = round((_exact(self.high) - _exact(self.low)) / _exact(self.step))
        if last >= _MOST_VALUES:
            raise BadInput(
                f"from {self.low} to {self.high}", f"more than {_MOST_VALUES:,} values to try one by one"
            )
        return [_value_at(self.low, self.step, index) for index in range(last + 1)]


def dimension(key: str, expression: str) -> Choices | Range:
    """Return the dimension of `KEY=EXPRESSION`, in Hydra's grammar.

    Args:
        key: a key or a group.
        expression: ``a,b``, ``choice()``, ``range()``, ``interval()``, ``tag(log, interval())`` or ``glob()``.

    Raises:
        BadInput: it cannot be parsed, has one value only, or nothing that could be searched.
    """
    override = parse_sweep(f"{key}={expression}")
    if not override.is_sweep_override():
        raise BadInput(
            f"{key}={expression}: nothing to search in a single value; accepted: A,B, choice(A,B), "
            "range(FROM,BELOW,STEP), interval(LOW,HIGH), tag(log,interval(LOW,HIGH)) and glob(PATTERN)"
        )
    value = override.value()
    line = override.input_line or ""
    if isinstance(value, Glob):
        return Choices(tuple(_options(override, value)))
    assert isinstance(value, Sweep)
    tags = value.tags - {"log"}
    if tags or (value.tags and isinstance(value, ChoiceSweep)):
        raise BadInput(line, f"tag {', '.join(sorted(value.tags))}", "log, with a range or an interval")
    if isinstance(value, ChoiceSweep):
        return _choices(line, value.list)
    if isinstance(value, IntervalSweep):
        assert value.start is not None
        assert value.end is not None
        return _interval(line, value.start, value.end, "log" in value.tags)
    assert isinstance(value, RangeSweep)
    return _range(line, value, "log" in value.tags)


def plain_expression(override: Override, expression: str) -> str:
    """Return a sweep's expression with a `glob` replaced by today's options, so that the search space is fixed.

    Raises:
        BadInput: there is no such group, or no option matches.
    """
    glob = override.value()
    if not isinstance(glob, Glob):
        return expression
    return f"choice({','.join(_options(override, glob))})"


def as_override(key: str, value: Choice) -> str:
    """Return the override that sets `key` to a value of its dimension; floats are written with all digits."""
    if isinstance(value, bool):
        return f"{key}={str(value).lower()}"
    return f"{key}={value}" if isinstance(value, str) else override_line(key, value)


def override_value(line: str) -> Any:
    """Return the plain value of an override."""
    return parse_single(line).value()


def _options(override: Override, glob: Glob) -> list[str]:
    key, line = override.key_or_group, override.input_line
    if key not in groups():
        raise BadInput(
            f"{line}: glob() chooses options of a group, and {key} is not a group{nearest(key, groups())}; "
            f"groups: {', '.join(groups())}"
        )
    names = options(key)
    fitting = glob.filter(names)
    if not fitting:
        raise BadInput(line, f"matches no {key}; options: {', '.join(names)}")
    return [name if re.fullmatch(r"[\w-]+", name) else override_line("", name)[1:] for name in fitting]


def _choices(line: str, elements: Sequence[Any]) -> Choices:
    values: list[Choice] = []
    for element in elements:
        value: Choice = element
        if isinstance(element, str | QuotedString | list | dict):
            value = _expression(element)
        if any(type(value) is type(other) and value == other for other in values):  # 1 == True
            raise BadInput(line, f"{as_override('', value)[1:]} is listed twice")
        values.append(value)
    return Choices(tuple(values))


def _expression(element: str | QuotedString | list[Any] | dict[Any, Any]) -> str:
    """Return an element as the value of an override; choice() has removed the quotes of its texts."""
    words: str = Transformer.str(element)
    if isinstance(element, str) and override_value(f"key={words}") != element:
        return override_line("", element)[1:]
    return words


def _interval(line: str, low: Number, high: Number, log: bool) -> Range:
    _check_finite(line, low, high)
    if low >= high:
        raise BadInput(line, "", "interval(LOW,HIGH), LOW < HIGH")
    _check_log(line, low, log)
    return Range(low, high, 1 if isinstance(low, int) and isinstance(high, int) else None, log)


def range_length(sweep: RangeSweep, line: str) -> int:
    """Return the number of values of a `range()`.

    `line` is the override, for messages.

    Raises:
        BadInput: it has none, or an end is not finite.
    """
    assert sweep.start is not None
    assert sweep.stop is not None
    _check_finite(line, sweep.start, sweep.stop, sweep.step)
    count = 0
    if sweep.step != 0:
        count = math.ceil((_exact(sweep.stop) - _exact(sweep.start)) / _exact(sweep.step))
    if count < 1:
        raise BadInput(line, "has no values", "range(FROM,BELOW,STEP)")
    return count


def _range(line: str, sweep: RangeSweep, log: bool) -> Range:
    count = range_length(sweep, line)
    start, step = sweep.start, sweep.step
    assert start is not None
    first, last = _value_at(start, step, 0), _value_at(start, step, count - 1)
    low, high = min(first, last), max(first, last)
    _check_log(line, low, log)
    if log and (isinstance(low, float) or abs(step) != 1):
        raise BadInput(line, "a logarithmic scale has no steps", "tag(log,interval(LOW,HIGH))")
    return Range(low, high, abs(step), log)


def _value_at(start: Number, step: Number, steps: int) -> Number:
    """Return `start` plus so many steps, computed in decimals: three steps of 0.1 from 0 are 0.3."""
    if isinstance(start, int) and isinstance(step, int):
        return start + steps * step
    return float(_exact(start) + steps * _exact(step))


def _exact(number: Number) -> Decimal:
    return Decimal(repr(number))


def _check_finite(line: str, *numbers: Number) -> None:
    for number in numbers:
        if not math.isfinite(number):
            raise BadInput(line, f"{number} cannot be an end of a range", "finite numbers")


def _check_log(line: str, low: Number, log: bool) -> None:
    if log and low <= 0:
        raise BadInput(line, f"{low} is not above 0; accepted with tag(log, ...): ends above 0")
