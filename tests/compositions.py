"""Hydra composes the same choices once for all tests of a process: it was a quarter of their time.

Options of a user's `./conf` count with their contents, since tests write such files. What concerns sweeps, whose
studies may lie in the working folder, is composed again each time.
"""

import copy
import functools
from collections.abc import Sequence

from omegaconf import DictConfig

from deepracer_exp.aws.worlds.catalogue import worlds
from deepracer_exp.config import compose, option_files
from deepracer_exp.config.options import SWEEP, conf_dir, conf_dirs

_hydra = option_files.composed


@functools.cache
def _once(
    entry: str | None, lines: tuple[str, ...], own: tuple[tuple[str, bytes], ...]
) -> tuple[DictConfig, dict[str, str]]:
    return _hydra(entry, lines)


def _is_file(line: str) -> bool:
    """Return whether a line chooses an option that is a file, or a world."""
    group, _, option = line.removeprefix("+").replace("'", "").partition("=")
    is_file = any((folder / group / f"{option}.yaml").is_file() for folder in conf_dirs())
    return not group.startswith(SWEEP) and (is_file or (group == "track" and option in worlds()))


def _own_options() -> tuple[tuple[str, bytes], ...]:
    """Return the files of the user's options with their contents."""
    folders = [folder for folder in conf_dirs() if folder != conf_dir().resolve()]
    files = (path for folder in folders for path in sorted(folder.rglob("*.yaml")))
    return tuple((str(path), path.read_bytes()) for path in files)


def _composed(entry: str | None, lines: Sequence[str]) -> tuple[DictConfig, dict[str, str]]:
    if entry == "sweep" or not all(map(_is_file, lines)):
        return _hydra(entry, lines)
    return copy.deepcopy(_once(entry, tuple(lines), _own_options()))


def compose_once() -> None:
    """Let all tests of this process share compositions."""
    option_files.composed = compose.composed = _composed
