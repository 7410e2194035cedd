"""Override expressions to a validated experiment; the only place that speaks Hydra."""

import difflib
import itertools
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.types import Glob, Override, RangeSweep
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter, ValidationError

from deepracer_exp.addresses import without_passwords
from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.formats.worlds import find_world

from . import (
    custom_files,
    option_files,  # noqa: F401 - how Hydra reads them
)
from .contradictions import check_together
from .custom_files import Beneath, beneath, read_custom_files
from .dimension import length
from .evaluation import EvaluateConfig, EvaluationConfig
from .experiment import Experiment
from .export import ExportConfig
from .options import conf_dirs, find, groups, listed, options
from .overrides import PLAIN_TEXT, line_for_hydra, override_line, parse_single, parse_sweep
from .track_options import ALL, by_world_name, complete, in_own_words, register_worlds, several_tracks
from .track_options import GROUP as TRACK

Config = TypeVar("Config")

MOST_RUNS = 1000
"""Of one `-m`; one after the other they take a day."""

_FILES = (".json", ".npy", ".py", ".yaml", ".yml")
_NO_EXPERIMENT = ("experiment", None)

_adapters: dict[type, TypeAdapter[Any]] = {}

# Option files name the files beside them by it, whatever the working folder: ${conf:'reward/mine.py'}.
OmegaConf.register_new_resolver("conf", find, replace=True)


@dataclass(frozen=True)
class Composition:
    """An experiment as composed, before its values are checked."""

    overrides: tuple[str, ...]
    choices: dict[str, str]
    """The option chosen in each group."""
    mapping: dict[str, Any]
    """All values, as plain Python."""
    names: Mapping[str, str]
    """What a racer calls the choices that come from `custom_files`, by group."""
    notes: tuple[str, ...]
    """What was taken from `custom_files` and what was not, a line each."""

    def yaml(self) -> str:
        """Return the values as YAML, in the order of the entry point's groups."""
        return yaml.safe_dump(
            self.mapping, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
        )


def compose_experiment(overrides: Sequence[str]) -> tuple[Experiment, Composition]:
    """Compose `conf/train.yaml` with the overrides and validate the result.

    Args:
        overrides: Hydra override expressions without sweeps, e.g. ``track=Oval_track``; paths and addresses need
            no quotes. ``custom_files=DIR`` stands for the values of DeepRacer's files in a folder; they win over
            defaults and experiments, and all other overrides over them.

    Raises:
        BadInput: an override cannot be parsed, names something unknown or gives a value that is not accepted.
    """
    composition = compose_entry("train", overrides)
    experiment = validate(composition.mapping)
    _check_names(experiment.evaluation)
    return experiment, composition


def compose_evaluation(overrides: Sequence[str]) -> tuple[EvaluateConfig, Composition]:
    """Compose `conf/evaluate.yaml` with the overrides and validate the result.

    Raises:
        BadInput: as for `compose_experiment`, or no run is given.
    """
    composition = compose_entry("evaluate", overrides)
    _require_run(composition)
    config = typed(composition.mapping, EvaluateConfig)
    _check_names(config.evaluation)
    return config, composition


def compose_export(overrides: Sequence[str]) -> tuple[ExportConfig, Composition]:
    """Compose `conf/export.yaml` with the overrides and validate the result.

    Raises:
        BadInput: as for `compose_experiment`, or no run or format is given.
    """
    composition = compose_entry("export", overrides)
    _require_run(composition)
    if composition.mapping["format"] is None:
        raise BadInput("format: missing; write format=onnx, format=aws or format=aws-logs")
    return typed(composition.mapping, ExportConfig), composition


def _require_run(composition: Composition) -> None:
    if composition.mapping["run"] is None:
        raise BadInput(
            "run: missing; write run=RUN: a run's folder, its name or the beginning of it, MLflow's id, "
            "best:EXPERIMENT, MODEL@ALIAS or ALIAS"
        )


def compose_entry(entry: str, overrides: Sequence[str]) -> Composition:
    """Compose an entry point's YAML with the overrides into plain Python values.

    Raises:
        BadInput: an override cannot be parsed or names something unknown, or a file cannot be used.
    """
    overrides = without_passwords(list(overrides))
    given = [parse_single(override) for override in overrides]
    own = [by_world_name(override) for override in given if override.key_or_group != custom_files.KEY]
    for override in own:
        _check_key(entry, override)
    files = _files(given, {one.key_or_group: text for one, text in zip(given, overrides, strict=True)})
    has_tracks = TRACK in groups(entry)
    several = several_tracks(own) if has_tracks else None
    if several is not None:
        rest = [override for override in own if override.key_or_group.partition(".")[0] != TRACK]
        own = [*map(parse_single, several.choosing), *rest, *several.changing]
    parsed = [*map(parse_single, files.lines), *own]
    with reading(" ".join(overrides) or entry):
        try:
            config = _composed(entry, [line_for_hydra(override) for override in parsed])
            choices = {
                str(group): str(option).removesuffix(".yaml")
                for group, option in config.hydra.runtime.choices.items()
                if option is not None
            }
            with open_dict(config):
                del config["hydra"]
            mapping = _plain(config)
        except (HydraException, OmegaConfBaseException) as error:
            raise BadInput(_explain(entry, parsed, error)) from error
    if has_tracks and TRACK in mapping and TRACK not in choices:
        raise BadInput("track: a list of tracks in a file; several are chosen as an override: track=[A,B]")
    if several is None and has_tracks and isinstance(mapping.get(TRACK), dict):
        mapping[TRACK] = complete(choices[TRACK], mapping[TRACK])
    elif several is not None:
        several.put_in_place(mapping)
        choices[TRACK] = f"[{','.join(several.names)}]"
    return Composition(
        overrides=tuple(overrides),
        choices={group: option for group, option in choices.items() if group in groups(entry)},
        # An option file of the user may hold an address, too.
        mapping=without_passwords(mapping),
        names=files.names,
        notes=files.notes,
    )


def _composed(name: str | None, lines: list[str]) -> DictConfig:
    """Let Hydra put together a file of `conf/`, or what the overrides alone choose, with Hydra's own settings."""
    project, *more = conf_dirs()
    register_worlds()
    if more:
        lines = [*lines, override_line("hydra.searchpath", [f"file://{folder}" for folder in more])]
    with initialize_config_dir(str(project), version_base="1.3"):
        return compose(name, overrides=lines, return_hydra_config=True)


def compose_option(group: str, option: str, kind: type[Config]) -> Config:
    """Compose one option by itself, a quarter of the work of an experiment, and validate it.

    Raises:
        BadInput: there is no such option, or its values are not accepted or refer to other groups.
    """
    check_option(group, option)
    with reading(f"{group}={option}"):
        mapping = _plain(_composed(None, [f"+{override_line(group, option)}"])[group])
    try:
        return typed(mapping, kind)
    except BadInput as error:
        raise BadInput(f"{group}={option}: {error}") from error


def check_option(group: str, name: object, key: str | None = None) -> None:
    """Refuse what is no name of a group's options: a name never becomes a path.

    Args:
        group: of the options.
        name: as it was given.
        key: where, if not as an override of the group.

    Raises:
        BadInput: there is no such option.
    """
    known, key = options(group), key or group
    if not isinstance(name, str):
        raise BadInput(f"{override_line(key, name)}: no such {group}; options: {listed(group, known)}")
    if name.removesuffix(".yaml") in known or (group == TRACK and find_world(name)):
        return
    hint = nearest(name, known)
    if key == group and f"{group}.file" in PLAIN_TEXT and Path(name).suffix in _FILES:
        hint = f" (did you mean {group}.file={name}?)"
    raise BadInput(f"{key}={name}: no such {group}{hint}; options: {listed(group, known)}")


def check_choice(group: str, value: object) -> None:
    """Refuse an override of a whole group that names no options of it.

    Raises:
        BadInput: there is no such option.
    """
    # Of all groups `experiment` alone may be left out; `several_tracks` looks at lists of tracks.
    if (group, value) in (_NO_EXPERIMENT, (TRACK, ALL)) or (group == TRACK and isinstance(value, list)):
        return
    for name in value if isinstance(value, list) else [value]:
        check_option(group, name)


def _check_names(evaluation: EvaluationConfig) -> None:
    """Refuse names of options that an evaluation would not find."""
    tracks = [evaluation.tracks] if isinstance(evaluation.tracks, str) else evaluation.tracks or ()
    for name in tracks:
        if name != ALL:
            check_option(TRACK, name, "evaluation.tracks")
    for key in ("usual", "held_out"):
        if (name := getattr(evaluation, key)) is not None:
            check_option("randomization", name, f"evaluation.{key}")


def _plain(config: DictConfig) -> dict[str, Any]:
    """Return composed values as plain Python: all keys text, and text for what JSON does not know."""
    values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    plain: dict[str, Any] = json.loads(json.dumps(values, default=str))
    return plain


def validate(mapping: dict[str, Any]) -> Experiment:
    """Turn plain values into a frozen experiment; types are strict (no text for numbers, no bool for int).

    Raises:
        BadInput: a key is unknown, missing, of another type or out of its range, or two keys contradict.
    """
    experiment = typed(mapping, Experiment)
    check_together(experiment)
    return experiment


def typed(mapping: dict[str, Any], kind: type[Config]) -> Config:
    """Turn plain values into a frozen dataclass; types are strict.

    Raises:
        BadInput: a key is unknown, missing, of another type or out of its range, or two keys contradict.
    """
    try:
        # JSON is the strict mode that still takes a YAML list for a tuple and 1 for 1.0.
        return _adapter(kind).validate_json(json.dumps(mapping), strict=True, extra="forbid")
    except ValidationError as error:
        raise BadInput(_first_finding(mapping, error)) from error


def _adapter(kind: type[Config]) -> TypeAdapter[Config]:
    # Building one takes longer than ten validations.
    if kind not in _adapters:
        _adapters[kind] = TypeAdapter(kind)
    return _adapters[kind]


def expand_grid(overrides: Sequence[str]) -> list[list[str]]:
    """Return one list of overrides per combination of the sweeps in them (``seed=0,1``, ``range(1,4)``).

    Raises:
        BadInput: an override cannot be parsed or asks for a sweep that is no plain grid.
    """
    axes: list[list[str]] = []
    for override in map(parse_sweep, overrides):
        line, value = override.input_line or "", override.value()
        if not override.is_sweep_override():
            axes.append([line])
            continue
        if not override.is_discrete_sweep() or isinstance(value, Glob):
            raise BadInput(f"{line}: no plain grid; -m takes lists and ranges (seed=0,1,2 or seed=range(3))")
        count = length(value, line) if isinstance(value, RangeSweep) else 1
        if math.prod(map(len, axes)) * count > MOST_RUNS:
            raise BadInput(f"{line}: more than {MOST_RUNS:,} runs; accepted with -m: up to {MOST_RUNS:,}")
        key = override.get_key_element()
        axes.append([f"{key}={one}" for one in override.sweep_string_iterator()])
    if math.prod(map(len, axes)) > MOST_RUNS:
        raise BadInput(
            f"{' '.join(overrides)}: {math.prod(map(len, axes)):,} runs; accepted with -m: up to {MOST_RUNS:,}"
        )
    return [list(combination) for combination in itertools.product(*axes)]


def _files(given: Sequence[Override], typed: Mapping[str, str]) -> Beneath:
    """Return what the last `custom_files` stands for, nothing without one; `typed` is every override by its key."""
    folders = [override.value() for override in given if override.key_or_group == custom_files.KEY]
    if not folders or folders[-1] is None:
        return Beneath((), {}, ())
    return beneath(read_custom_files(str(folders[-1])), typed)


def _check_key(entry: str, override: Override) -> None:
    """Refuse what Hydra would take without a word, or with a traceback."""
    key, value = override.key_or_group, override.value()
    if re.match(r"hydra\b", key):
        raise BadInput(
            f"{key}: Hydra's own settings have no effect here; runs_dir says where runs are written"
        )
    if override.package is not None:
        raise BadInput(f"{key}@{override.package}: an option's place is its group's; write {key}=OPTION")
    if key in groups(entry) and not override.is_delete():
        check_choice(key, value)


def _dotted(node: Any, prefix: str = "") -> Iterable[str]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield f"{prefix}{key}"
            yield from _dotted(value, f"{prefix}{key}.")


def _explain(entry: str, parsed: Sequence[Override], error: Exception) -> str:
    """Return one line for what Hydra tells in several."""
    text = in_own_words(str(error))
    missing = re.search(r"Could not find '([^']*)'", text)
    groups_within = [group for group in groups(entry) if missing and missing[1].startswith(f"{group}/")]
    if missing and groups_within:
        group = max(groups_within, key=len)  # sweep/executor rather than sweep
        option = missing[1].removeprefix(f"{group}/")
        return f"{group}={option}: no such {group}{nearest(option, options(group))}"
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        known = groups(entry)
        chosen = [
            o.input_line or ""
            for o in parsed
            if o.key_or_group in known and o.package is None and o.key_or_group != unknown[1]
        ]
        return _unknown_key(entry, unknown.group(1), compose_entry(entry, chosen))
    loaded = re.search(r"in the defaults list", text)
    if loaded:
        key = next((o.key_or_group for o in parsed if o.key_or_group in text), parsed[0].key_or_group)
        return f"{key}: no such group{nearest(key, groups(entry))}; groups: {', '.join(groups(entry))}"
    return f"{getattr(error, 'full_key', None) or entry}: {text.partition('full_key:')[0]}"


def _unknown_key(entry: str, key: str, chosen: Composition) -> str:
    """Tell which keys there are where `key` was looked for; `chosen` is the entry point without other overrides."""
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
    return f"{key}: no such key{close}; `deepracer-exp {entry} --cfg` prints all of them"


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
    if finding["type"] == "union_tag_invalid":
        context = finding["ctx"]
        kind = context["discriminator"].strip("'")
        return f"{key}.{kind}={context['tag']}: no such {kind}; accepted: {context['expected_tags']}{more}"
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
