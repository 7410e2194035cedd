"""A sweep: a search over experiments (`conf/sweep/`), and its entry point."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from deepracer_exp.errors import BadInput

from .bounds import ActionCount, Count, Natural, Seconds, UpTo100, UpTo1000
from .compose import (
    Composition,
    check_choice,
    check_option,
    compose_entry,
    compose_evaluation,
    compose_experiment,
    trusted,
)
from .dimension import Choices, as_override, dimension, override_value, plain_expression
from .evaluation import EvaluationConfig
from .experiment import SafeName
from .options import groups
from .overrides import PLAIN_TEXT, key_of, override_line, parse_single, parse_sweep
from .own_class import REFERENCE
from .parse import parse_config

Objective = Literal["race_score", "lap_time", "completion", "zigzag"]
Pruner = Literal["entropy", "median", "percentile", "hyperband"]
SAMPLERS = ("tpe", "gp", "cmaes", "random", "grid")

_ENTRY = "sweep"
_OF_THE_SWEEP = ("study", "parent", "debug", "sweep", "sweep/executor")
_NOT_SEARCHED = {
    "seed": "sweep.seeds=3 trains every trial with three seeds",
    "runs_dir": "all runs of a study share one folder",
    "tracking": "all runs of a study are recorded in the same store",
}
_NOT_OF_A_CLONE = {"name", "runs_dir"}


def _sampler(name: str) -> str:
    if name in SAMPLERS or re.fullmatch(REFERENCE, name):
        return name
    raise ValueError(f"accepted: {', '.join(SAMPLERS)}, or package.module:Class, one of Optuna's or your own")


@dataclass(frozen=True, kw_only=True)
class LocalExecutor:
    """Worker processes on this machine."""

    kind: Literal["local"]


@dataclass(frozen=True, kw_only=True)
class RayExecutor:
    """Worker processes on the nodes of a Ray cluster."""

    kind: Literal["ray"]
    address: Annotated[str, Field(min_length=1)]
    cpus_per_worker: Count
    gpus_per_worker: Annotated[float, Field(ge=0, allow_inf_nan=False)]


ExecutorConfig = Annotated[LocalExecutor | RayExecutor, Field(discriminator="kind")]


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """The search space, how it is searched, and when the search ends."""

    trials: Annotated[int, Field(ge=1, le=100_000)]
    workers: UpTo1000 | None
    seeds: UpTo100
    protocol: str
    objectives: Annotated[tuple[Objective, ...], Field(min_length=1)]
    rerank: Annotated[int, Field(ge=0, le=1000)]
    rerank_laps: Annotated[int, Field(ge=1, le=4096)]
    clone: dict[str, Any] | None
    sampler: Annotated[str, AfterValidator(_sampler)]
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    startup_trials: Natural
    pruners: tuple[Pruner, ...]
    percentile: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
    warmup_evaluations: Natural
    patience: Natural | None
    lease_s: Seconds
    patience_s: Seconds
    storage: Annotated[str, Field(min_length=1)] | None
    enqueue: tuple[dict[str, Any] | str, ...]
    executor: ExecutorConfig
    lap_actions: tuple[ActionCount, ...]
    train: tuple[str, ...]
    space: dict[str, str]

    def __post_init__(self) -> None:
        """Refuse names that are listed twice."""
        for name in ("objectives", "pruners", "lap_actions"):
            values = getattr(self, name)
            if len(set(values)) < len(values):
                raise ValueError(f"{name}: {', '.join(map(str, values))}: one is listed twice")
        for key in _NOT_OF_A_CLONE & {*(self.clone or ())}:
            raise ValueError(f"clone: {key}: the clone is one of the study's runs")

    @property
    def clone_overrides(self) -> list[str]:
        """Return the overrides of the clone of the best trial; empty without a clone."""
        return [override_line(key, value) for key, value in (self.clone or {}).items()]


@dataclass(frozen=True, kw_only=True)
class SweepEntry:
    """The request of `deepracer-exp sweep`."""

    study: SafeName | None
    parent: Annotated[str, Field(min_length=1)] | None
    debug: bool
    sweep: SweepConfig


@dataclass(frozen=True)
class SweepRequest:
    """A requested sweep, before its search space is checked."""

    entry: SweepEntry
    composition: Composition
    """The values of the sweep, without those of the trainings."""
    base: tuple[str, ...]
    """Overrides of every trial."""
    space: Mapping[str, str]
    """The search space: expressions by key, with `glob()` replaced by the options it matches."""
    optional: frozenset[str]
    """Keys of the space of `sweep=NAME` whose group the command line sets: they are dropped where the chosen options do
    not have them."""
    stored: bool = False
    """Whether the overrides come from a stored study, not from the user."""

    @property
    def study(self) -> str:
        """Return the study's name: the given one, or that of the ready-made sweep."""
        option = self.composition.choices[_ENTRY]
        return self.entry.study or (_ENTRY if option == "own" else option)

    @property
    def tracking_uri(self) -> str | None:
        """Return the store of MLflow that the user has named; None: the one in `runs_dir`."""
        named = [line for line in self.base if key_of(line) == "tracking.uri"]
        value = parse_single(named[-1]).value() if named else None
        return None if value is None else str(value)

    def refuse_empty(self) -> None:
        """Refuse a sweep with nothing to search.

        Raises:
            BadInput: there is nothing to search.
        """
        if not self.space:
            raise BadInput(
                "sweep",
                "nothing to search; write KEY='interval(LOW,HIGH)', KEY=A,B or sweep=NAME, such as sweep=lr_entropy",
            )

    @cached_property
    def protocol(self) -> EvaluationConfig:
        """The protocol by which trials are judged; raises as `compose_evaluation`."""
        return compose_evaluation([f"evaluation={self.entry.sweep.protocol}"])[0].evaluation

    @cached_property
    def runs_dir(self) -> Path:
        """The folder of the trials' runs.

        Raises:
            BadInput: it is not a path.
        """
        lines = [line for line in self.base if key_of(line) == "runs_dir"]
        return Path(compose_experiment(lines[-1:], stored=self.stored)[0].runs_dir)


def compose_sweep(overrides: Sequence[str], *, stored: bool = False) -> SweepRequest:
    """Split overrides into those of the sweep, those of every trial's training, and the search space.

    An override of the training replaces the entry of `sweep=NAME` for the same key, whether it sets or searches the
    key; ``~KEY`` removes a key from the search space.

    Args:
        overrides: ``study=``, ``parent=``, ``debug=``, ``sweep=``, ``sweep.*=`` and ``sweep/executor=`` are for the
            sweep, all others for the training.
        stored: whether a study holds them; the user's own words otherwise.

    Raises:
        BadInput: an override cannot be parsed, or one for the sweep has an unknown key or a value that is not accepted.
            Keys of the training are not checked.
    """
    of_the_sweep = [
        override
        for override in overrides
        if (key := key_of(override)) in _OF_THE_SWEEP or key.startswith("sweep.")
    ]
    for override in of_the_sweep:
        _check_own(override)
    composition = trusted(compose_entry(_ENTRY, of_the_sweep), stored=stored)
    entry = parse_config(composition.mapping, SweepEntry)
    check_option("evaluation", entry.sweep.protocol, "sweep.protocol")
    train = _TrainOverrides()
    for override in entry.sweep.train:
        if parse_sweep(override).is_sweep_override():
            raise BadInput("sweep.train", f"{override}: several values; the search space is sweep.space")
        train.add(override)
    for key, expression in entry.sweep.space.items():
        dimension(key, expression)
        train.add(f"{key}={expression}")
    typed_keys = [train.add(override) for override in overrides if override not in of_the_sweep]
    chosen = set(typed_keys) & set(groups())
    ready = set(entry.sweep.space) - set(typed_keys)
    optional = frozenset(key for key in ready if key.partition(".")[0] in chosen)
    return SweepRequest(entry, composition, tuple(train.base.values()), train.space, optional, stored)


class _TrainOverrides:
    """Overrides of the training in their order; the last one of a key counts."""

    def __init__(self) -> None:
        self.base: dict[str, str] = {}
        self.space: dict[str, str] = {}

    def add(self, override: str) -> str:
        """Add an override that sets or searches a key, and return the key."""
        parsed = parse_sweep(override)
        key = parsed.key_or_group
        if key == "name":
            raise BadInput(override, "the study's name is the experiment of its runs; write study=NAME")
        searched = self.space.pop(key, None) is not None
        self.base.pop(key, None)
        if parsed.is_sweep_override():
            for refused, why in _NOT_SEARCHED.items():
                if key == refused or key.startswith(f"{refused}."):
                    raise BadInput(override, f"cannot be searched: {why}")
            self.space[key] = plain_expression(parsed, override.partition("=")[2])
            searched_values = dimension(key, self.space[key])
            if key in groups() and isinstance(searched_values, Choices):
                for value in searched_values.values:
                    check_choice(key, override_value(as_override(key, value)))
        elif not (parsed.is_delete() and searched):
            self.base[key] = override
        return key


def _check_own(override: str) -> None:
    if key_of(override) in PLAIN_TEXT:
        return  # commas are its own
    parsed = parse_sweep(override)
    if parsed.is_sweep_override():
        key, _, value = override.partition("=")
        raise BadInput(override, "", f"one value; a list is written {key}=[{value}]")
    if parsed.key_or_group.startswith("sweep.space"):
        raise BadInput(
            override,
            "write the key itself, as in algorithm.lr='tag(log,interval(1e-5,1e-3))'; ~KEY removes one",
        )
