"""Hydra composes the same choices of the project's own options once for all tests: it was a quarter of their time.

What a user's folder adds is composed anew each time, since tests write such options; so is all that concerns sweeps,
whose studies may lie in the working folder.
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
def _once(entry: str | None, lines: tuple[str, ...]) -> tuple[DictConfig, dict[str, str]]:
    return _hydra(entry, lines)


def _is_ours(line: str) -> bool:
    """Return whether a line chooses an option that is a file of the project, or a world."""
    group, _, option = line.removeprefix("+").replace("'", "").partition("=")
    is_file = (conf_dir() / group / f"{option}.yaml").is_file()
    return not group.startswith(SWEEP) and (is_file or (group == "track" and option in worlds()))


def _composed(entry: str | None, lines: Sequence[str]) -> tuple[DictConfig, dict[str, str]]:
    if entry == "sweep" or conf_dirs() != [conf_dir().resolve()] or not all(map(_is_ours, lines)):
        return _hydra(entry, lines)
    return copy.deepcopy(_once(entry, tuple(lines)))


def compose_once() -> None:
    """Let all tests of this process share compositions."""
    option_files.composed = compose.composed = _composed
