"""A search over experiments (`conf/sweep/`), and the entry point that begins one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from deepracer_exp.errors import BadInput

from .bounds import Count, Natural, Seconds, UpTo100, UpTo1000
from .compose import Composition, check_choice, check_option, compose_entry, typed
from .dimension import Choices, as_override, dimension, plain_expression, value_of
from .experiment import SafeName
from .options import groups
from .overrides import PLAIN_TEXT, key_of, parse_sweep

Objective = Literal["race_score", "lap_time", "completion"]
Pruner = Literal["entropy", "median", "percentile", "hyperband", "wilcoxon"]
Sampler = Literal["tpe", "gp", "cmaes", "qmc", "random", "grid", "nsga2"]

_ENTRY = "sweep"
_OF_THE_SWEEP = ("study", "parent", "debug", "sweep", "sweep/executor")
_NOT_SEARCHED = {
    "seed": "sweep.seeds=3 trains every trial with three seeds",
    "runs_dir": "all runs of a study are in one folder",
    "tracking": "all runs of a study are recorded in one place",
}


@dataclass(frozen=True, kw_only=True)
class LocalExecutor:
    """Worker processes on this machine."""

    kind: Literal["local"]


@dataclass(frozen=True, kw_only=True)
class RayExecutor:
    """Worker processes on the nodes of a Ray cluster."""

    kind: Literal["ray"]
    address: Annotated[str, Field(min_length=1)]
    """HOST:PORT of its head; auto: the cluster that this machine is a node of."""
    cpus_per_worker: Count
    """Cores that a worker takes, and uses for physics."""
    gpus_per_worker: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """GPUs that a worker takes, or the share of one."""


ExecutorConfig = Annotated[LocalExecutor | RayExecutor, Field(discriminator="kind")]


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """What is searched, by what, and how far."""

    trials: Annotated[int, Field(ge=1, le=100_000)]
    """In total, over all starts of the study."""
    workers: UpTo1000 | None
    """Processes; null: one a core, on a cluster as many as it has room for."""
    seeds: UpTo100
    """With how many seeds a trial is trained; its value is their mean."""
    protocol: str
    """Option of `evaluation` by which trials are judged."""
    objectives: Annotated[tuple[Objective, ...], Field(min_length=1)]
    """Several give a Pareto front instead of one best trial."""
    rerank: Annotated[int, Field(ge=0, le=1000)]
    """How many of the best are put to the test anew at the end."""
    rerank_laps: Annotated[int, Field(ge=1, le=4096)]
    """Trials of that test."""
    sampler: Sampler
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    """Of the sampler."""
    startup_trials: Natural
    """Trials before the sampler learns and pruners compare."""
    pruners: tuple[Pruner, ...]
    percentile: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
    """Of the best trials, which the pruner of this name keeps."""
    warmup_evaluations: Natural
    """Evaluations of a trial before it is compared."""
    patience: Natural | None
    """Evaluations without growth before it is compared; null: no matter whether it grows."""
    lease_s: Seconds
    """Seconds without a sign of life after which a worker's trial is anyone's."""
    patience_s: Seconds
    """Seconds for which a database that does not answer is waited for."""
    storage: Annotated[str, Field(min_length=1)] | None
    """Address of the database; null: a file in `runs_dir`."""
    executor: ExecutorConfig
    train: tuple[str, ...]
    """Overrides of every trial."""
    space: dict[str, str]
    """What is searched: expressions of Hydra's grammar by key."""

    def __post_init__(self) -> None:
        """Refuse names that stand there twice."""
        for name in ("objectives", "pruners"):
            values = getattr(self, name)
            if len(set(values)) < len(values):
                raise ValueError(f"{name}: {', '.join(values)}: one stands there twice")


@dataclass(frozen=True, kw_only=True)
class SweepEntry:
    """What `deepracer-exp sweep` is asked for."""

    study: SafeName | None
    """Name of the study and of its runs' experiment."""
    parent: Annotated[str, Field(min_length=1)] | None
    """A run whose clones the trials are."""
    debug: bool
    """Show a traceback for errors."""
    sweep: SweepConfig


@dataclass(frozen=True)
class SweepRequest:
    """A sweep as it was asked for, before its space is checked."""

    entry: SweepEntry
    composition: Composition
    """Of the sweep, without what is of the training."""
    base: tuple[str, ...]
    """Overrides of every trial."""
    space: Mapping[str, str]
    """What is searched: expressions by key, `glob()` replaced by what it stands for."""
    optional: frozenset[str]
    """Keys of the space that `sweep=NAME` has for a group which the command line chooses otherwise: left out where the
    chosen options do not have them."""

    @property
    def study(self) -> str:
        """Return the study's name: the given one, or that of the ready-made sweep."""
        option = self.composition.choices[_ENTRY]
        return self.entry.study or (_ENTRY if option == "own" else option)


def compose_sweep(overrides: Sequence[str]) -> SweepRequest:
    """Tell apart what is of the sweep, of every trial's training, and what is searched.

    An override of the training takes the place of what `sweep=NAME` has for the same key, whether it fixes or searches
    it; ``~KEY`` leaves a key out of the search.

    Args:
        overrides: ``study=``, ``parent=``, ``debug=``, ``sweep=``, ``sweep.*=`` and ``sweep/executor=`` are of the
            sweep, all others of the training.

    Raises:
        BadInput: an override cannot be parsed, or one of the sweep names something unknown or gives a value that is not
            accepted. Keys of the training are not looked up.
    """
    own = [override for override in overrides if _is_of_the_sweep(override)]
    for override in own:
        _check_own(override)
    composition = compose_entry(_ENTRY, own)
    entry = typed(composition.mapping, SweepEntry)
    check_option("evaluation", entry.sweep.protocol, "sweep.protocol")
    plan = _Plan()
    for override in entry.sweep.train:
        if parse_sweep(override).is_sweep_override():
            raise BadInput(f"sweep.train: {override}: several values; what is searched is of sweep.space")
        plan.take(override)
    for key, expression in entry.sweep.space.items():
        dimension(key, expression)
        plan.take(f"{key}={expression}")
    typed_keys = [plan.take(override) for override in overrides if override not in own]
    chosen = set(typed_keys) & set(groups())
    ready = set(entry.sweep.space) - set(typed_keys)
    optional = frozenset(key for key in ready if key.partition(".")[0] in chosen)
    return SweepRequest(entry, composition, tuple(plan.base), plan.space, optional)


class _Plan:
    """Overrides of the training in their order; the last of a key counts."""

    def __init__(self) -> None:
        self.base: list[str] = []
        self.space: dict[str, str] = {}

    def take(self, override: str) -> str:
        """Take an override that fixes or searches a key, and return the key."""
        parsed = parse_sweep(override)
        key = parsed.key_or_group
        if key == "name":
            raise BadInput(f"{override}: runs are named after their study; write study=NAME")
        searched = key in self.space
        self._forget(key)
        if parsed.is_sweep_override():
            _check_searched(key, override)
            self.space[key] = plain_expression(parsed, override.partition("=")[2])
            found = dimension(key, self.space[key])
            if key in groups() and isinstance(found, Choices):
                for value in found.values:
                    check_choice(key, value_of(as_override(key, value)))
        elif not (parsed.is_delete() and searched):
            self.base.append(override)
        return key

    def _forget(self, key: str) -> None:
        self.space.pop(key, None)
        self.base = [line for line in self.base if parse_sweep(line).key_or_group != key]


def _is_of_the_sweep(override: str) -> bool:
    key = key_of(override)
    return key in _OF_THE_SWEEP or key.startswith("sweep.")


def _check_own(override: str) -> None:
    if key_of(override) in PLAIN_TEXT:
        return  # commas are its own
    parsed = parse_sweep(override)
    if parsed.is_sweep_override():
        key, _, value = override.partition("=")
        raise BadInput(f"{override}: one value is accepted; a list is written {key}=[{value}]")
    if parsed.key_or_group.startswith("sweep.space"):
        raise BadInput(
            f"{override}: write the key itself, as in algorithm.lr='tag(log,interval(1e-5,1e-3))'; "
            "~KEY leaves one out"
        )


def _check_searched(key: str, override: str) -> None:
    for refused, why in _NOT_SEARCHED.items():
        if key == refused or key.startswith(f"{refused}."):
            raise BadInput(f"{override}: cannot be searched: {why}")
