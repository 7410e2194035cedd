"""Hydra's way to option files: only below `conf/`, and read as every file of a user is."""

import os
from io import StringIO
from pathlib import Path

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf

from deepracer_exp.formats.user_file import read_yaml


class OptionFiles(FileConfigSource):
    """One folder of option files."""

    def load_config(self, config_path: str) -> ConfigResult:
        """Read an option.

        Raises:
            BadInput: the file is no YAML of keys and values, or none that may be read.
        """

        def load(text: str) -> ConfigResult:
            config = OmegaConf.load(StringIO(text))
            if not isinstance(config, DictConfig):
                raise ValueError("holds no keys")
            header = self._get_header_dict(text[:512])
            return ConfigResult(self.provider, f"{self.scheme()}://{self.path}", config, header)

        return read_yaml(self._file(config_path), "an option: KEY: VALUE, line by line", load)

    def is_config(self, config_path: str) -> bool:
        """Return whether there is such an option; of a pipe or a broken link, reading will say what it is."""
        path = self._file(config_path)
        return self._is_below(config_path) and os.path.lexists(path) and not path.is_dir()

    def is_group(self, config_path: str) -> bool:
        """Return whether there is such a folder."""
        return self._is_below(config_path) and super().is_group(config_path)

    def _file(self, config_path: str) -> Path:
        return Path(self.path, self._normalize_file_name(config_path))

    @staticmethod
    def _is_below(config_path: str) -> bool:
        # `defaults:` of an option file name others, too: a name leads nowhere else.
        return not Path(config_path).is_absolute() and ".." not in Path(config_path).parts


# Hydra has one reader of files, which it does not let others replace; it has registered it now.
Plugins.instance()
SourcesRegistry.instance().types[OptionFiles.scheme()] = OptionFiles
