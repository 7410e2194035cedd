"""The search space of a sweep: keys, their values, and the options of a group in which a key exists."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import BaseTrial, FixedTrial
from pydantic import ValidationError

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.dimension import Choice, Choices, Range, as_override, dimension, override_value
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.options import groups
from deepracer_exp.config.overrides import OPEN_MAPPINGS
from deepracer_exp.config.own_class import allow
from deepracer_exp.config.parse import parse_experiment, take_over_files
from deepracer_exp.config.sweep import SweepRequest
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.real_car import require_car
from deepracer_exp.errors import BadInput, Unknown
from deepracer_exp.rewards.source import load_reward_source

Check = Callable[[list[str]], Mapping[str, Any]]
"""Raises BadInput for overrides that no run accepts, and returns all values of the run they make."""

_CONSTANTS = "reward.constants"


@dataclass(frozen=True)
class Dimension:
    """One searched key."""

    key: str
    expression: str
    distribution: BaseDistribution
    group: str | None
    """The key's group, if it is searched as well."""
    options: tuple[Choice, ...] | None
    """Options of that group that have the key; None: all."""

    def matching(self, value: Any) -> list[Choice]:
        """Return the value of this dimension that equals a plain value; an empty list if none does."""
        what = dimension(self.key, self.expression)
        if isinstance(what, Choices):
            plain = [(choice, override_value(as_override(self.key, choice))) for choice in what.values]
            is_truth = isinstance(value, bool)  # 1 == True
            return [choice for choice, its in plain if its == value and isinstance(its, bool) == is_truth]
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not what.low <= value <= what.high
        ):
            return []
        steps = 0.0 if what.step is None else (value - what.low) / what.step
        if abs(steps - round(steps)) > 1e-9:
            return []
        return [int(value) if isinstance(self.distribution, IntDistribution) else float(value)]


@dataclass(frozen=True)
class SearchSpace:
    """All searched keys, and the overrides that all trials share."""

    base: tuple[str, ...]
    """Overrides of every trial."""
    dimensions: tuple[Dimension, ...]
    """Groups first, because other keys may depend on them."""

    @classmethod
    def from_request(cls, request: SweepRequest, check: Check | None = None) -> "SearchSpace":
        """Build the space of a request; every choice and both ends of every range are checked, each alone.

        Without `check` overrides are checked as by a training from scratch.

        Raises:
            BadInput: there is nothing to search, a key does not exist, or no run accepts one of its values.
        """
        request.refuse_empty()
        ranges = {key: dimension(key, text) for key, text in request.space.items()}
        trials = _Trials(request, check, ranges)
        dimensions = [
            Dimension(key, request.space[key], _distribution(what), *trials.condition(key))
            for key, what in sorted(ranges.items(), key=lambda item: item[0] not in groups())
            if key not in request.optional or trials.is_known(key)
        ]
        for axis in dimensions:
            trials.check(axis)
        return cls(request.base, tuple(dimensions))

    def suggest(self, trial: BaseTrial) -> list[str]:
        """Return the overrides of a trial; equal values give equal overrides, to the last digit."""
        chosen: dict[str, Choice] = {}
        for axis in self.dimensions:
            if axis.options is None or (axis.group and chosen[axis.group] in axis.options):
                chosen[axis.key] = _suggested(trial, axis)
        return [*self.base, *(as_override(key, value) for key, value in chosen.items())]

    def example(self) -> list[str]:
        """Return the overrides of a trial with the first choices and the lower ends."""
        values = {axis.key: _first(axis.distribution) for axis in self.dimensions}
        return self.suggest(FixedTrial(values))

    def as_text(self) -> dict[str, str]:
        """Return the search expressions by key."""
        return {axis.key: axis.expression for axis in self.dimensions}

    def difference(self, other: Mapping[str, str]) -> list[str]:
        """Return a line for each key that another space, from its `as_text`, searches differently."""
        here, lines = self.as_text(), []
        for key in dict.fromkeys([*other, *here]):
            before, now = other.get(key), here.get(key)
            if before is None or now is None:
                lines.append(f"{key}: {before or 'not searched'} -> {now or 'not searched'}")
            elif before != now and dimension(key, before) != dimension(key, now):
                lines.append(f"{key}: {before} -> {now}")
        return lines

    def is_wider_than(self, other: Mapping[str, str]) -> bool:
        """Return whether this space has all values of another one, from its `as_text`."""
        here = self.as_text()
        return all(
            key in here and _contains(dimension(key, here[key]), dimension(key, expression))
            for key, expression in other.items()
        )

    def grid(self) -> dict[str, list[Choice]]:
        """Return all values by key.

        Raises:
            BadInput: a key has infinitely many values, or counts for some options only.
        """
        grid: dict[str, list[Choice]] = {}
        for axis in self.dimensions:
            if axis.options is not None:
                raise BadInput(
                    f"sweep.sampler=grid: {axis.key} counts only for {axis.group}={','.join(map(str, axis.options))}, "
                    "and a grid has no conditions; accepted: another sampler, or one option"
                )
            what = dimension(axis.key, axis.expression)
            values = list(what.values) if isinstance(what, Choices) else what.values()
            if values is None:
                raise BadInput(
                    f"sweep.sampler=grid: {axis.key}={axis.expression} has infinitely many values; accepted: A,B, "
                    "range(FROM,BELOW,STEP), int(interval(LOW,HIGH)), or another sampler"
                )
            grid[axis.key] = list(values)
        return grid


class _Trials:
    """Composed experiments, to check values with."""

    def __init__(self, request: SweepRequest, check: Check | None, ranges: Mapping[str, Choices | Range]):
        self._base, self._ranges = list(request.base), ranges
        self._stored = request.stored
        self._on_the_car = request.protocol.real_car is not None
        self._from_scratch = check is None
        self._check = check or self._compose
        self._composed: dict[tuple[str, ...], Mapping[str, Any]] = {}
        self._context: dict[str, str] = {}
        try:
            self._values({})
        except BadInput:
            # The base may be complete only with the searched keys, such as where one of two keys is null.
            self._context = {
                key: _lines(key, what)[0] for key, what in ranges.items() if not self._group(key)
            }
            self._values({})

    def condition(self, key: str) -> tuple[str | None, tuple[Choice, ...] | None]:
        """Return the key's group if that is searched, and the options of it that have the key; None: all."""
        group = self._group(key)
        if group is None:
            return None, None
        every = self._options(group)
        having = tuple(option for option in every if self._has(self._with(group, option), key))
        return group, having if having and len(having) < len(every) else None

    def is_known(self, key: str) -> bool:
        """Return whether any searched or chosen option has the key."""
        group = self._group(key)
        if group is None:
            return self._has(self._values({}), key)
        return any(self._has(self._with(group, option), key) for option in self._options(group))

    def check(self, axis: Dimension) -> None:
        """Refuse a key that does not exist and values that no run accepts."""
        what = self._ranges[axis.key]
        options: Sequence[Choice | None] = [None]
        if axis.group is not None:
            options = axis.options or self._options(axis.group)
        for option in options:
            context = {} if axis.group is None else {axis.group: as_override(axis.group, option)}
            for line in _lines(axis.key, what):
                self._check_line(context, axis, line)

    def _check_line(self, context: Mapping[str, str], axis: Dimension, line: str) -> None:
        try:
            values = self._values(context)
            changed = copy.deepcopy(dict(values))
            holder = _holder(changed, axis.key)
            if self._from_scratch and axis.key not in groups() and holder is not None:
                # Composing takes a hundred times as long as setting a value.
                holder[axis.key.rpartition(".")[2]] = override_value(line)
                if not self._stored:
                    allow(changed)
                take_over_files(changed)
                self._read(parse_experiment(changed))
            else:
                self._values({**context, axis.key: line})
        except Unknown:
            raise
        except BadInput as error:
            accepts_whole = isinstance(self._ranges[axis.key], Range) and _is_of_whole_numbers(error)
            hint = f"; of whole numbers: {axis.key}='int({axis.expression})'" if accepts_whole else ""
            raise BadInput(f"{axis.key}={axis.expression}", f"{error}{hint}") from None

    def _values(self, lines: Mapping[str, str]) -> Mapping[str, Any]:
        """Return all values of the base with these overrides by key; refuse what no run accepts."""
        overrides = (*self._base, *{**self._context, **lines}.values())
        if overrides not in self._composed:
            self._composed[overrides] = self._check(list(overrides))
        return self._composed[overrides]

    def _compose(self, overrides: list[str]) -> Mapping[str, Any]:
        experiment, composition = compose_experiment(overrides, stored=self._stored)
        self._read(experiment)
        return composition.mapping

    def _read(self, experiment: Experiment) -> None:
        """Refuse values that a run would refuse at its start or in its evaluation."""
        load_reward_source(experiment.reward)
        build_action_space(experiment.action_space)
        if self._on_the_car:
            require_car(experiment)
        if experiment.randomization.real_car is not None:
            require_car(experiment, "randomization.real_car")

    def _with(self, group: str, option: Choice) -> Mapping[str, Any]:
        return self._values({group: as_override(group, option)})

    def _options(self, group: str) -> tuple[Choice, ...]:
        what = self._ranges[group]
        return what.values if isinstance(what, Choices) else tuple(what.values() or ())

    def _group(self, key: str) -> str | None:
        group, dot, _ = key.partition(".")
        return group if dot and group in self._ranges and group in groups() else None

    def _has(self, values: Mapping[str, Any], key: str) -> bool:
        if key.startswith(f"{_CONSTANTS}."):
            reward = parse_experiment(dict(values)).reward
            return key.removeprefix(f"{_CONSTANTS}.") in load_reward_source(reward).constants
        return _holder(values, key) is not None


def _contains(wider: Choices | Range, narrower: Choices | Range) -> bool:
    """Return whether a dimension has all values of another, on the same scale."""
    if isinstance(wider, Choices) and isinstance(narrower, Choices):
        typed = [(type(value), value) for value in wider.values]
        return all((type(value), value) in typed for value in narrower.values)
    if not isinstance(wider, Range) or not isinstance(narrower, Range) or wider.log != narrower.log:
        return False
    if not (wider.low <= narrower.low and narrower.high <= wider.high):
        return False
    if wider.step is None or wider.step == narrower.step:
        steps = 0.0 if wider.step is None else (narrower.low - wider.low) / wider.step
        return abs(steps - round(steps)) < 1e-9
    return False


def value_at(values: Mapping[str, Any], key: str) -> list[Any]:
    """Return the value of a key in all values of an experiment; an empty list if it does not exist.

    Constants of a reward function that the experiment does not set are those of its file.

    Raises:
        BadInput: the reward function cannot be read.
    """
    holder = _holder(values, key)
    group, _, leaf = key.rpartition(".")
    if group == _CONSTANTS and holder is not None and leaf not in holder:
        holder = dict(load_reward_source(parse_experiment(dict(values)).reward).constants)
    return [holder[leaf]] if holder is not None and leaf in holder else []


def _holder(values: Mapping[str, Any], key: str) -> dict[str, Any] | None:
    """Return the mapping that holds a key; None if the key does not exist."""
    parent, _, leaf = key.rpartition(".")
    node: Any = values
    for part in parent.split(".") if parent else ():
        node = node.get(part) if isinstance(node, dict) else None
    return node if isinstance(node, dict) and (leaf in node or parent in OPEN_MAPPINGS) else None


def _is_of_whole_numbers(error: BadInput) -> bool:
    """Return whether a value was refused because its key accepts whole numbers only."""
    cause = error.__cause__
    return isinstance(cause, ValidationError) and cause.errors()[0]["type"].startswith("int_")


def _lines(key: str, what: Choices | Range) -> list[str]:
    """Return overrides for all choices, or for both ends."""
    values = what.values if isinstance(what, Choices) else (what.low, what.high)
    return [as_override(key, value) for value in values]


def _distribution(what: Choices | Range) -> BaseDistribution:
    if isinstance(what, Choices):
        return CategoricalDistribution(what.values)
    if isinstance(what.low, int) and isinstance(what.high, int):
        return IntDistribution(what.low, what.high, log=what.log, step=int(what.step or 1))
    return FloatDistribution(what.low, what.high, log=what.log, step=what.step)


def _first(what: BaseDistribution) -> Choice:
    if isinstance(what, CategoricalDistribution):
        return what.choices[0]
    assert isinstance(what, FloatDistribution | IntDistribution)
    return what.low


def _suggested(trial: BaseTrial, axis: Dimension) -> Choice:
    what = axis.distribution
    if isinstance(what, IntDistribution):
        return trial.suggest_int(axis.key, what.low, what.high, step=what.step, log=what.log)
    if isinstance(what, FloatDistribution):
        return trial.suggest_float(axis.key, what.low, what.high, step=what.step, log=what.log)
    assert isinstance(what, CategoricalDistribution)
    value: Choice = trial.suggest_categorical(axis.key, what.choices)
    return value
