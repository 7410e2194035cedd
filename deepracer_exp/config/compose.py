"""Override expressions to a validated experiment; the only place that speaks Hydra."""

import difflib
import itertools
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from omegaconf import OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter, ValidationError

from deepracer_exp.errors import BadInput, nearest

from .experiment import Experiment
from .overrides import line_for_hydra, parse_single, parse_sweep


def conf_dir() -> Path:
    """Return the folder of option files: beside the code in an installed wheel, else the repository's."""
    packaged = Path(__file__).parents[1] / "conf"
    return packaged if packaged.is_dir() else Path(__file__).parents[2] / "conf"


def options(group: str) -> list[str]:
    """Return the names of a group's options, sorted."""
    return sorted(path.stem for path in (conf_dir() / group).glob("*.yaml"))


def options_of(group: str) -> list[str]:
    """Return the names of a group's options, sorted.

    Raises:
        BadInput: there is no such group.
    """
    if group not in groups():
        raise BadInput(f"{group}: no such group{nearest(group, groups())}; groups: {', '.join(groups())}")
    return options(group)


def groups() -> list[str]:
    """Return the names of the groups, sorted."""
    return sorted(path.name for path in conf_dir().iterdir() if path.is_dir())


@dataclass(frozen=True)
class Composition:
    """An experiment as composed, before its values are checked."""

    overrides: tuple[str, ...]
    choices: dict[str, str]
    """The option chosen in each group."""
    mapping: dict[str, Any]
    """All values, as plain Python."""

    def yaml(self) -> str:
        """Return the values as YAML, in the order of the entry point's groups."""
        return yaml.safe_dump(
            self.mapping, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
        )


def compose_experiment(overrides: Sequence[str]) -> tuple[Experiment, Composition]:
    """Compose `conf/train.yaml` with the overrides and validate the result.

    Args:
        overrides: Hydra override expressions without sweeps, e.g. ``track=Oval_track``; paths and addresses need
            no quotes.

    Raises:
        BadInput: an override cannot be parsed, names something unknown or gives a value that is not accepted.
    """
    composition = compose_entry("train", overrides)
    return validate(composition.mapping), composition


def compose_entry(entry: str, overrides: Sequence[str]) -> Composition:
    """Compose an entry point's YAML with the overrides into plain Python values.

    Raises:
        BadInput: an override cannot be parsed or names something unknown.
    """
    parsed = [parse_single(override) for override in overrides]
    for override in parsed:
        _check_key(override)
    try:
        with initialize_config_dir(str(conf_dir().resolve()), version_base="1.3"):
            config = compose(entry, overrides=[line_for_hydra(o) for o in parsed], return_hydra_config=True)
        choices = {
            str(group): str(option).removesuffix(".yaml")
            for group, option in config.hydra.runtime.choices.items()
            if option is not None
        }
        with open_dict(config):
            del config["hydra"]
        mapping = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise BadInput(_explain(entry, parsed, error)) from error
    assert isinstance(mapping, dict)
    return Composition(
        overrides=tuple(overrides),
        choices={group: option for group, option in choices.items() if group in groups()},
        mapping={str(key): value for key, value in mapping.items()},
    )


def validate(mapping: dict[str, Any]) -> Experiment:
    """Turn plain values into a frozen experiment; types are strict (no text for numbers, no bool for int).

    Raises:
        BadInput: a key is unknown, missing, of another type or out of its range, or two keys contradict.
    """
    try:
        # JSON is the strict mode that still takes a YAML list for a tuple and 1 for 1.0.
        experiment = TypeAdapter(Experiment).validate_json(json.dumps(mapping), strict=True, extra="forbid")
    except ValidationError as error:
        raise BadInput(_first_finding(mapping, error)) from error
    _check_together(experiment)
    return experiment


def expand_grid(overrides: Sequence[str]) -> list[list[str]]:
    """Return one list of overrides per combination of the sweeps in them (``seed=0,1``, ``range(1,4)``).

    Raises:
        BadInput: an override cannot be parsed or asks for a sweep that is no plain grid.
    """
    axes: list[list[str]] = []
    for override in map(parse_sweep, overrides):
        if not override.is_sweep_override():
            axes.append([override.input_line or ""])
        elif override.is_discrete_sweep() and not isinstance(override.value(), Glob):
            key = override.get_key_element()
            axes.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        else:
            raise BadInput(
                f"{override.input_line}: no plain grid; -m takes lists and ranges (seed=0,1,2 or seed=range(3))"
            )
    return [list(combination) for combination in itertools.product(*axes)]


def _check_key(override: Override) -> None:
    """Refuse what Hydra would take without a word, or with a traceback."""
    key, value = override.key_or_group, override.value()
    if re.match(r"hydra\b", key):
        raise BadInput(
            f"{key}: Hydra's own settings have no effect here; runs_dir says where runs are written"
        )
    if override.package is not None:
        raise BadInput(f"{key}@{override.package}: an option's place is its group's; write {key}=OPTION")
    if key in groups() and not override.is_delete() and not isinstance(value, str | list | None):
        raise BadInput(f"{override.input_line}: no such {key}; options: {', '.join(options(key))}")


def _dotted(node: Any, prefix: str = "") -> Iterable[str]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield f"{prefix}{key}"
            yield from _dotted(value, f"{prefix}{key}.")


def _explain(entry: str, parsed: Sequence[Override], error: Exception) -> str:
    """Return one line for what Hydra tells in several."""
    text = str(error)
    missing = re.search(r"Could not find '([\w-]+)/([^']*)'", text)
    if missing:
        group, option = missing.groups()
        known = options(group)
        return f"{group}={option}: no such {group}{nearest(option, known)}; options: {', '.join(known)}"
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        chosen = [o.input_line or "" for o in parsed if o.key_or_group in groups()]
        return _unknown_key(unknown.group(1), compose_entry(entry, chosen))
    loaded = re.search(r"in the defaults list", text)
    if loaded:
        key = next((o.key_or_group for o in parsed if o.key_or_group in text), parsed[0].key_or_group)
        return f"{key}: no such group{nearest(key, groups())}; groups: {', '.join(groups())}"
    return f"{entry}: " + " ".join(text.split())


def _unknown_key(key: str, chosen: Composition) -> str:
    """Tell which keys there are where `key` was looked for; `chosen` is the experiment without other overrides."""
    parent, _, leaf = key.rpartition(".")
    keys = list(_dotted(chosen.mapping))
    siblings = [k.rpartition(".")[2] for k in keys if parent and k.rpartition(".")[0] == parent]
    if siblings:
        option = f" with {parent}={chosen.choices[parent]}" if parent in chosen.choices else ""
        return f"{key}: no such key{option}{nearest(leaf, siblings)}; known: {', '.join(siblings)}"
    close = nearest(key, keys)
    if not close:
        # Perhaps the right key without its group, or in another one.
        leaves = {k.rpartition(".")[2]: k for k in reversed(keys)}
        match = difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.8)
        close = f" (did you mean {leaves[match[0]]}?)" if match else ""
    return f"{key}: no such key{close}; `deepracer-exp train --cfg` prints all of them"


def _first_finding(mapping: dict[str, Any], error: ValidationError) -> str:
    finding = error.errors(include_url=False)[0]
    path = [str(part) for part in finding["loc"]]
    key = _key_of(mapping, path)
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if finding["type"] == "missing":
        return f"{key}: missing{more}"
    if finding["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        parent = _lookup(mapping, key.split(".")[:-1])
        siblings = [k for k in parent if k != path[-1]] if isinstance(parent, dict) else []
        return f"{key}: no such key{nearest(path[-1], siblings)}; known: {', '.join(siblings)}{more}"
    value = finding.get("input")
    if finding["type"] == "value_error":
        # A dataclass whose values contradict each other names them itself.
        at = key if isinstance(value, dict) else f"{key}={_short(value)}"
        return f"{at}: {finding['ctx']['error']}{more}"
    return f"{key}={_short(value)}: {finding['msg'][0].lower()}{finding['msg'][1:]}{more}"


def _key_of(mapping: dict[str, Any], path: list[str]) -> str:
    """Return the dotted key of a finding, without the tags of unions that pydantic puts into its path."""
    key: list[str] = []
    node: Any = mapping
    for index, part in enumerate(path):
        if isinstance(node, dict) and part in node:
            node = node[part]
        elif isinstance(node, list) and part.isdigit() and int(part) < len(node):
            node = node[int(part)]
        elif index + 1 < len(path) or not isinstance(node, dict):
            continue  # a union's tag
        key.append(part)
    return ".".join(key)


def _lookup(mapping: Any, path: list[str]) -> Any:
    for part in path:
        mapping = mapping[int(part)] if isinstance(mapping, list) else mapping[part]
    return mapping


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _check_together(experiment: Experiment) -> None:
    """Refuse values that are each accepted but contradict one another."""
    algorithm, collector = experiment.algorithm, experiment.collector
    if (algorithm.frames_per_iteration is None) == (algorithm.episodes_per_iteration is None):
        raise BadInput(
            f"algorithm.frames_per_iteration={algorithm.frames_per_iteration} and "
            f"algorithm.episodes_per_iteration={algorithm.episodes_per_iteration}: set exactly one, the other null"
        )
    frames = algorithm.frames_per_iteration
    if frames is not None and algorithm.batch_size > frames:
        raise BadInput(
            f"algorithm.batch_size={algorithm.batch_size} is larger than "
            f"algorithm.frames_per_iteration={frames}: a minibatch cannot hold more steps than an iteration"
        )
    if frames is not None and frames < collector.cars:
        raise BadInput(
            f"algorithm.frames_per_iteration={frames} is smaller than collector.cars={collector.cars}: "
            "each car takes at least one step an iteration"
        )
    if collector.mode == "in_process" and collector.processes not in (None, 1):
        raise BadInput(
            f"collector.processes={collector.processes} with collector.mode=in_process: "
            "choose collector=sync or collector=async for several processes"
        )
    limit_s, hang_s = experiment.reward.time_limit_s, collector.hang_timeout_s
    if collector.mode != "in_process" and limit_s >= hang_s:
        raise BadInput(
            f"reward.time_limit_s={limit_s:g} is not below collector.hang_timeout_s={hang_s:g}: a worker waiting for "
            "its reward function would be taken for one that hangs"
        )
    budget = experiment.budget
    if budget.env_steps is None and budget.iterations is None and budget.wall_clock_s is None:
        raise BadInput(
            "budget: env_steps, iterations and wall_clock_s are all null; at least one must end the run"
        )
    track = experiment.track
    if not isinstance(track.width_m, float) and len(track.width_m) != len(track.knots):
        raise BadInput(
            f"track.width_m has {len(track.width_m)} values and track.knots {len(track.knots)}: "
            "give one width, or one per knot"
        )
