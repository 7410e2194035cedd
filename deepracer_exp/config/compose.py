"""Composes override expressions into a validated experiment."""

import difflib
import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override, RangeSweep
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from deepracer_exp.addresses import without_passwords
from deepracer_exp.aws.worlds.catalogue import find_world
from deepracer_exp.config.custom_files.file_overrides import with_custom_files
from deepracer_exp.errors import BadInput, Unknown, nearest, reading

from . import acting
from .dimension import range_length
from .evaluation import EvaluateConfig, EvaluationConfig
from .experiment import Experiment
from .learning import algorithm_kind, keys_of_others
from .option_files import change, composed, composed_option, first_line, plain
from .options import groups, listed, options
from .overrides import PLAIN_TEXT, override_line, parse_single, parse_sweep
from .own_class import allow, allow_given, own_option
from .parse import import_own_classes, parse_config, parse_experiment, take_over_files
from .track_options import ALL, by_world_name, several_tracks
from .track_options import GROUP as TRACK

Config = TypeVar("Config")

MOST_RUNS = 1000
"""Limit of one `-m`: this many runs in sequence take a day."""

_COURSE = ("name", "title", "file", "knots", "width_m", "closed")
"""Keys of a track that say which one it is."""
_FILES = (".json", ".npy", ".py", ".yaml", ".yml")
_NO_EXPERIMENT = ("experiment", None)


@dataclass(frozen=True)
class Composition:
    """An experiment as composed, before its values are checked."""

    overrides: tuple[str, ...]
    choices: dict[str, str]
    """The option chosen in each group."""
    mapping: dict[str, Any]
    """All values, as plain Python."""
    notes: tuple[str, ...] = ()
    """Notes on the use of each file of `custom_files`, a line each."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Display names of the choices that come from files, by group."""

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
        stored: whether they come from a stored study, not from the user.

    Raises:
        BadInput: an override cannot be parsed, names something unknown or gives a value that is not accepted; or code
            is not the user's own (`acting`).
    """
    files = with_custom_files(without_passwords(list(overrides)))
    composition = trusted(compose_entry("train", files.lines), stored=stored)
    names = {**take_over_files(composition.mapping), **files.names}
    experiment = parse_experiment(composition.mapping)
    check_names(experiment.evaluation)
    acting.refuse_reward(experiment.reward.file, "the study")
    import_own_classes(experiment)
    notes = (*files.notes, *composition.notes)
    return experiment, replace(composition, overrides=files.typed, names=names, notes=notes)


def trusted(composition: Composition, *, stored: bool) -> Composition:
    """Allow the acting values that the user has named; leave the foreign ones out of a study's values.

    `stored` is as for `compose_experiment`.
    """
    if not stored:
        allow(composition.mapping)
        return composition
    left_out = acting.leave_out_foreign(composition.mapping, "the study")
    return replace(composition, notes=(*composition.notes, *left_out))


def compose_evaluation(overrides: Sequence[str]) -> tuple[EvaluateConfig, Composition]:
    """Compose `conf/evaluate.yaml` with the overrides and validate the result; raises as `compose_experiment`."""
    # The classes are those of the run that is read.
    composition = trusted(compose_entry("evaluate", allow_given(overrides)), stored=False)
    config = parse_config(composition.mapping, EvaluateConfig)
    check_names(config.evaluation)
    return config, composition


def compose_entry(entry: str, overrides: Sequence[str]) -> Composition:
    """Compose an entry point's YAML with the overrides into plain Python values.

    Raises:
        BadInput: an override cannot be parsed or names something unknown, or an option file cannot be used.
    """
    overrides = without_passwords(list(overrides))
    parsed = [by_world_name(parse_single(override)) for override in overrides]
    for override in parsed:
        _check_key(entry, override)
    chosen = [override for override in parsed if override.key_or_group in groups(entry)]
    changing = [override for override in parsed if override.key_or_group not in groups(entry)]
    names: tuple[str, ...] = ()
    if TRACK in groups(entry):
        names, changing = several_tracks(chosen, changing)
    if names:
        chosen = [override for override in chosen if override.key_or_group != TRACK]
    with reading(" ".join(overrides) or entry):
        config, choices = composed(entry, [_choice(override) for override in chosen])
        unfit = [
            *_leave_out_of_other_algorithm(config, choices),
            *_stays_beside(entry, config, choices, chosen),
        ]
        if names:
            on_each = _changed_by_experiment(entry, config, choices, chosen, TRACK)
            config[TRACK] = {name: composed_option(TRACK, name) for name in names}
            for name, (key, value) in itertools.product(names, on_each.items()):
                if key not in _COURSE:
                    OmegaConf.update(config[TRACK][name], key, value)
            choices[TRACK] = f"[{','.join(names)}]"
        try:
            for override in changing:
                if _is_taken_for_a_group(config, override) or not change(config, override):
                    key = override.key_or_group
                    raise Unknown(key, _unknown_key(entry, key, config, choices))
            mapping = plain(config)
        except OmegaConfBaseException as error:
            raise BadInput(f"{error.full_key or entry}: {first_line(error)}") from error
    if TRACK in mapping and TRACK in groups(entry) and TRACK not in choices:
        raise BadInput(
            "track: an option file cannot choose several tracks; give them as an override: track=[A,B]"
        )
    return Composition(
        overrides=tuple(overrides),
        choices={group: option for group, option in choices.items() if group in groups(entry)},
        mapping=without_passwords(mapping),  # option files of the user may contain addresses, too
        notes=tuple(unfit),
    )


def _leave_out_of_other_algorithm(config: DictConfig, choices: Mapping[str, str]) -> list[str]:
    """Drop a chosen experiment's values for another algorithm than the chosen one; return a line that names them."""
    experiment, algorithm = choices.get("experiment"), config.get("algorithm")
    if experiment is None or algorithm is None:
        return []
    kind = algorithm_kind(composed_option("algorithm", choices["algorithm"]))
    unfit = [key for key in keys_of_others(kind) if key in algorithm]
    with open_dict(algorithm):
        for key in unfit:
            del algorithm[key]
    what = ", ".join(f"algorithm.{key}" for key in unfit)
    return (
        [f"experiment={experiment}: {what}: not used with algorithm={choices['algorithm']}"] if unfit else []
    )


def _stays_beside(
    entry: str, config: DictConfig, choices: Mapping[str, str], chosen: Sequence[Override]
) -> list[str]:
    """Return a line for each chosen option of which a chosen experiment changes values."""
    lines = []
    for group in (override.key_or_group for override in chosen if override.key_or_group in choices):
        changed = _changed_by_experiment(entry, config, choices, chosen, group)
        kept = ", ".join(override_line(f"{group}.{key}", value) for key, value in changed.items())
        if kept:
            lines.append(f"experiment={choices['experiment']}: {kept} stays beside {group}={choices[group]}")
    return lines


def _changed_by_experiment(
    entry: str, config: DictConfig, choices: Mapping[str, str], chosen: Sequence[Override], group: str
) -> dict[str, Any]:
    """Return the values of a group, by key, that a chosen experiment gives in place of those of the chosen option."""
    if choices.get("experiment") is None or group == "experiment":
        return {}
    others = [_choice(override) for override in chosen if override.key_or_group not in ("experiment", group)]
    before, now = composed(entry, [*others, override_line(group, choices[group])])[0], config[group]
    keys = [
        key
        for key in _dotted(OmegaConf.to_container(now))
        if not OmegaConf.is_dict(OmegaConf.select(now, key))
    ]
    values = {key: OmegaConf.select(now, key) for key in keys}
    return {
        key: OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
        for key, value in values.items()
        if value != OmegaConf.select(before[group], key)
    }


def _choice(override: Override) -> str:
    """Return the expression that chooses an option, or none with `~GROUP`."""
    if override.is_delete():
        return override.get_key_element()
    return override_line(override.key_or_group, override.value())


def compose_option(group: str, option: str, kind: type[Config]) -> Config:
    """Compose and validate a single option.

    Raises:
        BadInput: there is no such option, its values are not accepted, or they refer to other groups.
    """
    check_option(group, option)
    with reading(f"{group}={option}"):
        mapping = plain(composed_option(group, option))
    try:
        return parse_config(mapping, kind)
    except BadInput as error:
        raise BadInput(f"{group}={option}: {error}") from error


def check_option(group: str, name: object, key: str | None = None) -> None:
    """Refuse a name that is not an option of the group, so that a name never becomes a path.

    `key` is the key that was set, if that is not the group.

    Raises:
        BadInput: there is no such option.
    """
    names, key = options(group), key or group
    if not isinstance(name, str):
        raise Unknown(override_line(key, name), f"no such {group}; options: {listed(group, names)}")
    if (class_values := own_option(group, name)) is not None:
        ConfigStore.instance().store(group=group, name=name, node=class_values)
        return
    if name.removesuffix(".yaml") in names or (group == TRACK and find_world(name)):
        return
    hint = nearest(name, names)
    if key == group and f"{group}.file" in PLAIN_TEXT and Path(name).suffix in _FILES:
        hint = f" (did you mean {group}.file={name}?)"
    raise Unknown(f"{key}={name}", f"no such {group}{hint}; options: {listed(group, names)}")


def check_choice(group: str, value: object) -> None:
    """Refuse an override of a whole group whose value is not an option.

    Raises:
        BadInput: there is no such option.
    """
    # Only `experiment` may be left out of the groups; `several_tracks` checks lists of tracks.
    if (group, value) in (_NO_EXPERIMENT, (TRACK, ALL)) or (group == TRACK and isinstance(value, list)):
        return
    if isinstance(value, list):
        raise BadInput(
            override_line(group, value), "several options", f"one; -m {group}=A,B makes a run of each"
        )
    check_option(group, value)


def check_names(evaluation: EvaluationConfig) -> None:
    """Refuse names of options that an evaluation could not find."""
    tracks = [evaluation.tracks] if isinstance(evaluation.tracks, str) else evaluation.tracks or ()
    for name in tracks:
        if name != ALL:
            check_option(TRACK, name, "evaluation.tracks")
    for key in ("usual", "held_out"):
        if (name := getattr(evaluation, key)) is not None:
            check_option("randomization", name, f"evaluation.{key}")
    if evaluation.race is not None:
        check_option("race", evaluation.race, "evaluation.race")


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
        axes.append([f"{key}={text}" for text in override.sweep_string_iterator()])
    return [list(combination) for combination in itertools.product(*axes)]


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


def _is_taken_for_a_group(config: DictConfig, override: Override) -> bool:
    """Return whether a single word is assigned to a section of keys that has no options."""
    key = override.key_or_group
    return "." not in key and isinstance(config.get(key), DictConfig) and isinstance(override.value(), str)


def _unknown_key(entry: str, key: str, config: DictConfig, choices: Mapping[str, str]) -> str:
    """Return the message for an unknown key, with the nearest known ones."""
    if "/" in key:
        return f"no such group{nearest(key, groups(entry))}; groups: {', '.join(groups(entry))}"
    parent, _, leaf = key.rpartition(".")
    keys = list(_dotted(OmegaConf.to_container(config)))
    siblings = [k.rpartition(".")[2] for k in keys if parent and k.rpartition(".")[0] == parent]
    if siblings:
        option = f" with {parent}={choices[parent]}" if parent in choices else ""
        return f"no such key{option}{nearest(leaf, siblings)}; known: {', '.join(siblings)}"
    within = [k for k in keys if k.startswith(f"{key}.")]
    if within:
        return f"no such group for {entry}; accepted: {', '.join(within)}"
    close = nearest(key, keys)
    if not close:
        # Perhaps the right key in the wrong group, or without one.
        leaves = {k.rpartition(".")[2]: k for k in reversed(keys)}
        match = difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.8)
        close = f" (did you mean {leaves[match[0]]}?)" if match else ""
    return f"no such key{close}; `deepracer-exp {entry} --cfg` prints all of them"
