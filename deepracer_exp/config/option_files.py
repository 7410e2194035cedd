"""Composes option files: the only module that runs Hydra, through its public plugins and `hydra.compose`.

Hydra's public API cannot compose with a custom reader alone: `initialize_config_dir` requires a folder that Hydra reads
itself. It gets the folder of this module, which holds no options, and our plugin adds the real ones.
"""

import copy
import functools
import os
import re
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from deepracer_exp.errors import BadInput, Unknown, nearest
from deepracer_exp.files import read_yaml

from .options import (
    DEEPEST,
    SWEEP,
    FileState,
    conf_dir,
    conf_dirs,
    find,
    groups,
    option_files,
    options,
    sweep_files,
)
from .overrides import may_be_new, override_line
from .track_options import BASE, world_values
from .track_options import GROUP as TRACK

_OPTION = "an option file with lines KEY: VALUE"
_EMPTY = str(Path(__file__).parent)
# Hydra's settings of its logs, folders and launchers, which have no effect here, were a fifth of the work.
_NOT_HYDRAS_OWN = [
    f"~hydra/{group}"
    for group in (
        "env",
        "help",
        "hydra_help",
        "hydra_logging",
        "job_logging",
        "launcher",
        "output",
        "sweeper",
    )
]
_PACKAGE = re.compile(r"(?:\s*#.*\n)*?\s*#\s*@package\s+(\S+)")

# Lets option files refer to files beside them, whatever the working directory: ${conf:'reward/mine.py'}.
OmegaConf.register_new_resolver("conf", find, replace=True)


@functools.lru_cache(maxsize=512)
def _parsed(text: str) -> DictConfig:
    """Parse an option; most are composed again and again, and parsing was a third of the work."""
    config = OmegaConf.load(StringIO(text))
    if not isinstance(config, DictConfig):
        raise ValueError("has no keys")
    return config


class OptionFiles(ConfigSource):
    """Reads a folder of option files for Hydra: only files below it, with the checks of every user file.

    It serves the worlds, too: Hydra copies its whole `ConfigStore` at each composition, and 120 worlds there took a
    fifth of the time.
    """

    @staticmethod
    def scheme() -> str:
        """Return the prefix of a folder in Hydra's search path."""
        return "options"

    def load_config(self, config_path: str) -> ConfigResult:
        """Read an option.

        Raises:
            BadInput: the file cannot be read, or is not YAML with keys and values.
        """
        group, option = _place(config_path)
        if (world := _world(group, option)) is not None:
            return ConfigResult(
                self.provider, self.full_path(), track_values(option, world), {"package": None}
            )

        def load(text: str) -> ConfigResult:
            config, package = copy.deepcopy(_parsed(text)), _PACKAGE.match(text)
            if group == "experiment" and package is None:
                raise ValueError("lacks its first line, # @package _global_")
            if group == TRACK and "defaults" not in config:
                config = track_values(option, config)
            return ConfigResult(self.provider, self.full_path(), config, {"package": package and package[1]})

        return read_yaml(self._file(config_path), _OPTION, load)

    def is_config(self, config_path: str) -> bool:
        """Return whether there is such an option; a pipe or a broken link is refused when it is read."""
        path = self._file(config_path)
        is_file = self._is_below(config_path) and os.path.lexists(path) and not path.is_dir()
        return is_file or _world(*_place(config_path)) is not None

    def is_group(self, config_path: str) -> bool:
        """Return whether there is such a folder."""
        return self._is_below(config_path) and Path(self.path, config_path).is_dir()

    def available(self) -> bool:
        """Return whether the folder is there."""
        return Path(self.path).is_dir()

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Return no names: Hydra asks for them for messages that are not shown."""
        return []

    def _file(self, config_path: str) -> Path:
        group, name = _place(config_path)
        study = sweep_files().get(name) if group == SWEEP else None
        return study or Path(self.path, group, f"{name}.yaml")

    @staticmethod
    def _is_below(config_path: str) -> bool:
        # Names in `defaults:` of an option file must not lead out of the folder either, nor deeper than `option_files`.
        parts = Path(config_path).parts
        return not Path(config_path).is_absolute() and ".." not in parts and len(parts) <= DEEPEST


def _place(config_path: str) -> tuple[str, str]:
    """Return group and name of an option."""
    group, _, option = config_path.removesuffix(".yaml").rpartition("/")
    return group, option


def _world(group: str, option: str) -> DictConfig | None:
    values = world_values(option) if group == TRACK else None
    return None if values is None else OmegaConf.create(values)


def track_values(option: str, values: DictConfig) -> DictConfig:
    """Return a track's values, with those of `BASE` for missing keys and the option's name for a missing name."""
    base = _parsed((conf_dir() / TRACK / f"{BASE}.yaml").read_text(encoding="utf-8"))
    merged = OmegaConf.merge(base, {"name": option, "title": values.get("name", option)}, values)
    assert isinstance(merged, DictConfig)
    return merged


class OptionFolders(SearchPathPlugin):
    """Lets Hydra search our folders of options, in compositions of ours only."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add the folders."""
        if any(element.path == _EMPTY for element in search_path.get_path()):
            for folder in conf_dirs():
                search_path.append("deepracer_exp", f"{OptionFiles.scheme()}://{folder}")


def composed(entry: str | None, lines: Sequence[str]) -> tuple[DictConfig, dict[str, str]]:
    """Let Hydra compose a file of `conf/`, or options alone; return the values, and the option chosen in each group.

    `entry` is the name of a file, or None; the lines choose an option of a group each, in Hydra's grammar.

    Raises:
        BadInput: an option that another one names is not there, or a file cannot be used.
    """
    config, choices = _composed(entry, tuple(lines), option_files())
    return copy.deepcopy(config), dict(choices)


@functools.lru_cache(maxsize=64)
def _composed(
    entry: str | None, lines: tuple[str, ...], files: tuple[FileState, ...]
) -> tuple[DictConfig, dict[str, str]]:
    """Compose as `composed` from these files.

    The trials of a sweep choose the same options again and again, and every evaluation has the same two conditions: a
    copy costs a tenth. A variable of the environment that a list of defaults names is read the first time.
    """
    for plugin in (OptionFiles, OptionFolders):
        Plugins.instance().register(plugin)
    try:
        with initialize_config_dir(_EMPTY, version_base="1.3"):
            config = compose(entry, overrides=[*lines, *_NOT_HYDRAS_OWN], return_hydra_config=True)
    except MissingConfigException as error:
        group, _, option = (error.missing_cfg_file or "").rpartition("/")
        hint = nearest(option, options(group)) if group in groups(entry or "train") else ""
        raise Unknown(f"{group}={option}", f"no such {group or 'option'}{hint}") from error
    except (HydraException, OmegaConfBaseException) as error:
        raise BadInput(entry or lines, first_line(error)) from error
    chosen = config.hydra.runtime.choices.items()
    choices = {str(key): str(option).removesuffix(".yaml") for key, option in chosen if option is not None}
    with open_dict(config):
        del config["hydra"]
    return config, choices


def composed_option(group: str, option: str) -> DictConfig:
    """Return the values of an option by itself; raises as `composed`."""
    if (world := _world(group, option)) is not None:
        return track_values(option, world)
    values = composed(None, [f"+{override_line(group, option)}"])[0][group]
    assert isinstance(values, DictConfig)
    return values


def change(config: DictConfig, override: Override) -> bool:
    """Set or remove the value that an override names; return False if there is no such key."""
    key = override.key_or_group
    try:
        if not override.is_delete():
            merge = key != "sweep.clone"  # overrides, which another mapping of them replaces
            OmegaConf.update(config, key, override.value(), merge=merge, force_add=may_be_new(override))
            return True
        above, _, leaf = key.rpartition(".")
        with open_dict(config):
            del (OmegaConf.select(config, above) if above else config)[leaf]
    except (AttributeError, KeyError, TypeError):  # OmegaConf's mappings and lists are such, too
        return False
    return True


def plain(value: Any) -> Any:
    """Return values as plain Python; keys, and values without a JSON type, become text.

    Raises:
        OmegaConfBaseException: an interpolation leads nowhere, or a value is missing.
    """
    if isinstance(value, DictConfig):
        value = OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain(item) for item in value]
    return value if value is None or isinstance(value, str | int | float) else str(value)


def first_line(error: Exception) -> str:
    """Return the first line of an error of Hydra or OmegaConf; an empty one of Hydra's has it in its cause."""
    text = str(error) or str(error.__cause__ or type(error).__name__)
    return text.splitlines()[0]
