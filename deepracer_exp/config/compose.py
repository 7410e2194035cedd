"""Override expressions to a validated experiment; Hydra composes here and nowhere else."""

import copy
import difflib
import functools
import itertools
import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar

import yaml
from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override, RangeSweep
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from deepracer_exp.addresses import without_passwords
from deepracer_exp.aws.worlds.catalogue import find_world
from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.files import read_yaml

from . import acting, custom_files
from .custom_files import FileOverrides, file_overrides, read_custom_files
from .dimension import range_length
from .evaluation import EvaluateConfig, EvaluationConfig, ExportConfig
from .experiment import Experiment
from .options import SWEEP, conf_dirs, find, groups, listed, options, sweep_files
from .overrides import PLAIN_TEXT, line_for_hydra, override_line, parse_single, parse_sweep
from .own_class import allow, allow_given, own_option
from .parse import import_own_classes, parse_config, parse_experiment
from .track_options import ALL, by_world_name, complete, several_tracks, without_placeholders, world_values
from .track_options import GROUP as TRACK

Config = TypeVar("Config")

MOST_RUNS = 1000
"""Limit of one `-m`: so many runs, one after the other, take a day."""

_FILES = (".json", ".npy", ".py", ".yaml", ".yml")
_NO_EXPERIMENT = ("experiment", None)

# Lets option files refer to files beside them, whatever the working directory: ${conf:'reward/mine.py'}.
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
    """Display names of the choices that come from `custom_files`, by group."""
    notes: tuple[str, ...]
    """What was used of `custom_files` and what was not, a line each."""

    def yaml(self) -> str:
        """Return the values as YAML, in the order of the entry point's groups."""
        return yaml.safe_dump(
            self.mapping, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
        )


def compose_experiment(overrides: Sequence[str], *, stored: bool = False) -> tuple[Experiment, Composition]:
    """Compose `conf/train.yaml` with the overrides and validate the result.

    Args:
        overrides: Hydra override expressions without sweeps, e.g. ``track=Oval_track``; paths and addresses need
            no quotes. ``custom_files=DIR`` uses the values of DeepRacer's files in a folder; they override defaults and
            experiments, and every other override has priority over them.
        stored: whether a study holds them; the user's own words otherwise.

    Raises:
        BadInput: an override cannot be parsed, names something unknown or gives a value that is not accepted; or code
            is not the user's own (`acting`).
    """
    composition = compose_entry("train", overrides, stored=stored)
    experiment = parse_experiment(composition.mapping)
    _check_names(experiment.evaluation)
    acting.refuse_reward(experiment.reward.file, "the study")
    import_own_classes(experiment)
    return experiment, composition


def compose_evaluation(overrides: Sequence[str]) -> tuple[EvaluateConfig, Composition]:
    """Compose `conf/evaluate.yaml` with the overrides and validate the result.

    Raises:
        BadInput: as for `compose_experiment`.
    """
    composition = compose_entry("evaluate", overrides)
    config = parse_config(composition.mapping, EvaluateConfig)
    _check_names(config.evaluation)
    return config, composition


def compose_export(overrides: Sequence[str]) -> tuple[ExportConfig, Composition]:
    """Compose `conf/export.yaml` with the overrides and validate the result.

    Raises:
        BadInput: as for `compose_experiment`, or no format is given.
    """
    composition = compose_entry("export", overrides)
    if composition.mapping["format"] is None:
        raise BadInput(
            "format: missing; write format=onnx, format=aws, format=aws-model, format=aws-logs, or, for a policy that "
            "sees with the camera, format=car"
        )
    return parse_config(composition.mapping, ExportConfig), composition


def compose_entry(entry: str, overrides: Sequence[str], *, stored: bool = False) -> Composition:
    """Compose an entry point's YAML with the overrides into plain Python values; `stored` as of `compose_experiment`.

    Raises:
        BadInput: an override cannot be parsed or names something unknown, or a file cannot be used.
    """
    overrides = without_passwords(list(overrides))
    if entry != "train":  # it reads a stored run, whose classes are its own
        overrides = allow_given(overrides)
    given = [parse_single(override) for override in overrides]
    own = [by_world_name(override) for override in given if override.key_or_group != custom_files.KEY]
    for override in own:
        _check_key(entry, override)
    files = _files(given, {one.key_or_group: text for one, text in zip(given, overrides, strict=True)})
    own = [*map(parse_single, files.lines), *own]
    has_tracks = TRACK in groups(entry)
    several = several_tracks(own) if has_tracks else None
    if several is not None:
        rest = [override for override in own if override.key_or_group.partition(".")[0] != TRACK]
        own = [*map(parse_single, several.choosing), *rest, *several.changing]
    with reading(" ".join(overrides) or entry):
        try:
            config = _composed(entry, [line_for_hydra(override) for override in own])
            choices = {
                str(group): str(option).removesuffix(".yaml")
                for group, option in config.hydra.runtime.choices.items()
                if option is not None
            }
            with open_dict(config):
                del config["hydra"]
            mapping = _plain(config)
        except (HydraException, OmegaConfBaseException) as error:
            raise BadInput(_explain(entry, own, error)) from error
    if has_tracks and TRACK in mapping and TRACK not in choices:
        raise BadInput(
            "track: an option file cannot choose several tracks; give them as an override: track=[A,B]"
        )
    if several is None and has_tracks and isinstance(mapping.get(TRACK), dict):
        mapping[TRACK] = complete(choices[TRACK], mapping[TRACK])
    elif several is not None:
        several.move_to_track(mapping)
        choices[TRACK] = f"[{','.join(several.names)}]"
    # Option files of the user may contain addresses, too.
    mapping, left_out = without_passwords(mapping), list[str]()
    if stored:
        left_out = acting.leave_out_foreign(mapping, "the study")
    else:
        allow(mapping)
    return Composition(
        overrides=tuple(overrides),
        choices={group: option for group, option in choices.items() if group in groups(entry)},
        mapping=mapping,
        names=files.names,
        notes=(*files.notes, *left_out),
    )


@functools.lru_cache(maxsize=512)
def _parsed(text: str) -> DictConfig:
    """Parse an option; most are composed again and again, and parsing was a third of the work."""
    config = OmegaConf.load(StringIO(text))
    if not isinstance(config, DictConfig):
        raise ValueError("has no keys")
    return config


class OptionFiles(FileConfigSource):
    """Reads a folder of option files for Hydra: only files below it, with the checks of every user file.

    It has the worlds, too: all that is in Hydra's `ConfigStore` is copied at each composition, and 120 worlds there
    were a fifth of the work.
    """

    def load_config(self, config_path: str) -> ConfigResult:
        """Read an option.

        Raises:
            BadInput: the file cannot be read, or is not YAML with keys and values.
        """
        if (world := self._world(config_path)) is not None:
            return ConfigResult(
                self.provider, f"{self.scheme()}://{self.path}", OmegaConf.create(world), {"package": None}
            )

        def load(text: str) -> ConfigResult:
            config, header = copy.deepcopy(_parsed(text)), self._get_header_dict(text[:512])
            return ConfigResult(self.provider, f"{self.scheme()}://{self.path}", config, header)

        return read_yaml(self._file(config_path), "an option file with lines KEY: VALUE", load)

    def is_config(self, config_path: str) -> bool:
        """Return whether there is such an option; a pipe or a broken link is refused when it is read."""
        path = self._file(config_path)
        is_file = self._is_below(config_path) and os.path.lexists(path) and not path.is_dir()
        return is_file or self._world(config_path) is not None

    def is_group(self, config_path: str) -> bool:
        """Return whether there is such a folder."""
        return self._is_below(config_path) and super().is_group(config_path)

    @staticmethod
    def _world(config_path: str) -> dict[str, Any] | None:
        group, _, option = config_path.rpartition("/")
        return world_values(option.removesuffix(".yaml")) if group == TRACK else None

    def _file(self, config_path: str) -> Path:
        group, _, name = config_path.rpartition("/")
        study = sweep_files().get(name.removesuffix(".yaml")) if group == SWEEP else None
        return study or Path(self.path, self._normalize_file_name(config_path))

    @staticmethod
    def _is_below(config_path: str) -> bool:
        # Names in `defaults:` of an option file must not lead out of the folder either.
        return not Path(config_path).is_absolute() and ".." not in Path(config_path).parts


def register_option_files() -> None:
    """Replace the one reader of files that Hydra has by `OptionFiles`."""
    Plugins.instance()  # registers Hydra's own reader
    SourcesRegistry.instance().types[OptionFiles.scheme()] = OptionFiles


def _composed(name: str | None, lines: list[str]) -> DictConfig:
    """Let Hydra compose a file of `conf/`, or the overrides alone; the result includes Hydra's own settings."""
    project, *more = conf_dirs()
    register_option_files()
    if more:
        lines = [*lines, override_line("hydra.searchpath", [f"file://{folder}" for folder in more])]
    with initialize_config_dir(str(project), version_base="1.3"):
        return compose(name, overrides=lines, return_hydra_config=True)


def compose_option(group: str, option: str, kind: type[Config]) -> Config:
    """Compose and validate a single option, in a quarter of the time of an experiment.

    Raises:
        BadInput: there is no such option, its values are not accepted, or they refer to other groups.
    """
    check_option(group, option)
    with reading(f"{group}={option}"):
        mapping = _plain(_composed(None, [f"+{override_line(group, option)}"])[group])
    try:
        return parse_config(mapping, kind)
    except BadInput as error:
        raise BadInput(f"{group}={option}: {error}") from error


def check_option(group: str, name: object, key: str | None = None) -> None:
    """Refuse a name that is not an option of the group, so that a name never becomes a path.

    Args:
        group: of the options.
        name: the given name.
        key: the key it was given for, if that is not the group.

    Raises:
        BadInput: there is no such option.
    """
    known, key = options(group), key or group
    if not isinstance(name, str):
        raise BadInput(f"{override_line(key, name)}: no such {group}; options: {listed(group, known)}")
    if (own := own_option(group, name)) is not None:
        ConfigStore.instance().store(group=group, name=name, node=own)
        return
    if name.removesuffix(".yaml") in known or (group == TRACK and find_world(name)):
        return
    hint = nearest(name, known)
    if key == group and f"{group}.file" in PLAIN_TEXT and Path(name).suffix in _FILES:
        hint = f" (did you mean {group}.file={name}?)"
    raise BadInput(f"{key}={name}: no such {group}{hint}; options: {listed(group, known)}")


def check_choice(group: str, value: object) -> None:
    """Refuse an override of a whole group whose value is not an option.

    Raises:
        BadInput: there is no such option.
    """
    # Only `experiment` may be left out of the groups; `several_tracks` checks lists of tracks.
    if (group, value) in (_NO_EXPERIMENT, (TRACK, ALL)) or (group == TRACK and isinstance(value, list)):
        return
    for name in value if isinstance(value, list) else [value]:
        check_option(group, name)


def _check_names(evaluation: EvaluationConfig) -> None:
    """Refuse names of options that an evaluation could not find."""
    tracks = [evaluation.tracks] if isinstance(evaluation.tracks, str) else evaluation.tracks or ()
    for name in tracks:
        if name != ALL:
            check_option(TRACK, name, "evaluation.tracks")
    for key in ("usual", "held_out"):
        if (name := getattr(evaluation, key)) is not None:
            check_option("randomization", name, f"evaluation.{key}")


def _plain(config: DictConfig) -> dict[str, Any]:
    """Return composed values as plain Python: text for all keys, and for values that JSON does not have."""
    values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    plain: dict[str, Any] = json.loads(json.dumps(values, default=str))
    return plain


def expand_grid(overrides: Sequence[str]) -> list[list[str]]:
    """Return one list of overrides per combination of the sweeps in them (``seed=0,1``, ``range(1,4)``).

    Raises:
        BadInput: an override cannot be parsed or sweeps something other than lists and ranges.
    """
    axes: list[list[str]] = []
    for override in map(parse_sweep, overrides):
        line, value = override.input_line or "", override.value()
        if not override.is_sweep_override():
            axes.append([line])
            continue
        if not override.is_discrete_sweep() or isinstance(value, Glob):
            raise BadInput(f"{line}: -m takes lists and ranges only (seed=0,1,2 or seed=range(3))")
        assert isinstance(value, RangeSweep | ChoiceSweep)
        count = range_length(value, line) if isinstance(value, RangeSweep) else len(value.list)
        if math.prod(map(len, axes)) * count > MOST_RUNS:
            raise BadInput(f"{line}: more than {MOST_RUNS:,} runs; accepted with -m: up to {MOST_RUNS:,}")
        key = override.get_key_element()
        axes.append([f"{key}={one}" for one in override.sweep_string_iterator()])
    return [list(combination) for combination in itertools.product(*axes)]


def _files(given: Sequence[Override], typed: Mapping[str, str]) -> FileOverrides:
    """Return the overrides of the last `custom_files`, if any; `typed` has every other override by its key."""
    folders = [override.value() for override in given if override.key_or_group == custom_files.KEY]
    if not folders or folders[-1] is None:
        return FileOverrides((), {}, ())
    return file_overrides(read_custom_files(str(folders[-1])), typed)


def _check_key(entry: str, override: Override) -> None:
    """Refuse what Hydra would accept silently, or refuse with a traceback."""
    key, value = override.key_or_group, override.value()
    if re.match(r"hydra\b", key):
        raise BadInput(
            f"{key}: Hydra's own settings have no effect here; runs_dir says where runs are written"
        )
    if override.package is not None:
        raise BadInput(f"{key}@{override.package}: packages are not accepted; write {key}=OPTION")
    if key in groups(entry) and not override.is_delete():
        check_choice(key, value)


def _dotted(node: Any, prefix: str = "") -> Iterable[str]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield f"{prefix}{key}"
            yield from _dotted(value, f"{prefix}{key}.")


def _explain(entry: str, parsed: Sequence[Override], error: Exception) -> str:
    """Return one line for an error message of Hydra, which has several."""
    text = without_placeholders(str(error))
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
    """Return the message for an unknown key; `chosen` is composed without the overrides of single values."""
    parent, _, leaf = key.rpartition(".")
    keys = list(_dotted(chosen.mapping))
    siblings = [k.rpartition(".")[2] for k in keys if parent and k.rpartition(".")[0] == parent]
    if siblings:
        option = f" with {parent}={chosen.choices[parent]}" if parent in chosen.choices else ""
        return f"{key}: no such key{option}{nearest(leaf, siblings)}; known: {', '.join(siblings)}"
    within = [k for k in keys if k.startswith(f"{key}.")]
    if within:
        return f"{key}: no such group for {entry}; accepted: {', '.join(within)}"
    close = nearest(key, keys)
    if not close:
        # Perhaps the right key in the wrong group, or without one.
        leaves = {k.rpartition(".")[2]: k for k in reversed(keys)}
        match = difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.8)
        close = f" (did you mean {leaves[match[0]]}?)" if match else ""
    return f"{key}: no such key{close}; `deepracer-exp {entry} --cfg` prints all of them"
