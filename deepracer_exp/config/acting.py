"""Acting values: those that run code or a program, or decide where data is sent.

From a stored run, study or trial, a command accepts an acting value only if its user names it now (on the command line,
in an option file or in a script), or if a run or study of this account has used it before. Code is identified by its
contents, everything else by its text. The user's view: docs/security.md.
"""

import contextlib
import hashlib
import importlib.machinery
import os
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepracer_exp.errors import BadInput
from deepracer_exp.files import read_bytes

REWARD = "reward.file"
_PLAIN_TRACKING = {"kind": "mlflow", "uri": None}
"""Replaces a stored tracking that is not the user's own."""
_named: dict[str, str] = {}
"""Values that this command's user has named: the text of each value, and its mark in the record of this account."""


@dataclass(frozen=True)
class Acting:
    """A value that acts."""

    key: str
    text: str
    """Text that names it."""
    contents: tuple[Path, ...] = ()
    """The files of its code."""

    @property
    def mark(self) -> str:
        """Name in the record of this account: a hash of the text; for code, of the contents."""
        digest = hashlib.sha256(f"{self.key}\0{'' if self.key == REWARD else self.text}\0".encode())
        for file in self.contents:
            try:
                digest.update(read_bytes(file, "a Python file"))
            except BadInput:  # where it is needed, it is refused
                digest.update(os.fsencode(file))
        return digest.hexdigest()

    @property
    def is_own(self) -> bool:
        """Whether the user has named it, now or before."""
        if f"{self.key}={self.text}" in _named:
            return True
        record = _record()
        if record is None or not (record / self.mark).exists():
            return False
        name([self])  # for the processes that work for this one, perhaps on other machines
        return True


def acting(config: Mapping[str, Any]) -> Iterator[Acting]:
    """Return the values that act among those of an experiment or a sweep, except classes."""
    file = _part(config, "reward").get("file")
    if isinstance(file, str):
        yield reward_file(file)
    budget = _part(config, "budget")
    if isinstance(budget.get("alert_command"), str):
        yield Acting("budget.alert_command", budget["alert_command"])
    tracking = _part(config, "tracking")
    if tracking.get("uri") is not None:
        yield Acting("tracking.uri", str(tracking["uri"]))
    if tracking.get("kind") == "wandb":
        yield Acting("tracking.project", f"{tracking.get('entity')}/{tracking.get('project')}")
    sweep = _part(config, "sweep")
    if sweep.get("storage") is not None:
        yield Acting("sweep.storage", str(sweep["storage"]))
    executor = _part(sweep, "executor")
    if executor.get("kind", "local") != "local":
        yield Acting("sweep.executor.address", str(executor.get("address")))


def class_of(target: str) -> Acting:
    """Return the class `package.module:Class` as a value that acts; nothing is imported."""
    return Acting("target", target, tuple(_files_of(target.partition(":")[0])))


def reward_file(file: str) -> Acting:
    """Return a file with a reward function as a value that acts."""
    path = Path(file).absolute()
    return Acting(REWARD, str(path), (path,))


def name(values: Sequence[Acting]) -> None:
    """Record that the user names these values now."""
    for value in values:
        _named[f"{value.key}={value.text}"] = value.mark


def named() -> dict[str, str]:
    """Return the values named in this process, for `take_over_named` in a worker."""
    return dict(_named)


def take_over_named(values: Mapping[str, str]) -> None:
    """Take over the values named in the parent process."""
    _named.update(values)


def remember() -> None:
    """Record the named values for this account, once a run or a study has begun with them."""
    record = _record()
    if record is None or not _named:
        return
    # Without a home that can be written, the values are named again each time.
    with contextlib.suppress(OSError):
        record.mkdir(mode=0o700, parents=True, exist_ok=True)
        for mark in _named.values():
            (record / mark).touch(mode=0o600)


def leave_out_foreign(config: dict[str, Any], where: str) -> list[str]:
    """Remove foreign acting values from a stored configuration; return a line for each of them.

    The configuration is changed in place; `where` names its place in the lines.

    Code stays as text: `refuse_reward` and `load_class` decide about it before it is run.
    """
    left_out = []
    for value in list(acting(config)):
        if value.is_own or value.key == REWARD:
            continue
        group, key, *_ = value.key.split(".")
        advice = "repeat it to use it"
        if group == "tracking":
            if (
                config[group].get("kind") == "wandb"
            ):  # whose keys the tracker taken in its place does not have
                advice = f"to use it, give {_wandb_words(config[group])}"
            config[group] = dict(_PLAIN_TRACKING)
        else:
            config[group] = {**config[group], key: {"kind": "local"} if key == "executor" else None}
        left_out.append(
            f"{value.key}={value.text}: not taken over from {where}, because you have not used it "
            f"before; {advice}"
        )
    return left_out


def _wandb_words(tracking: Mapping[str, Any]) -> str:
    """Return the overrides that choose a project in Weights & Biases, for a shell."""
    keys = [key for key in ("project", "entity") if tracking.get(key) is not None]
    return shlex.join(["tracking=wandb", *(f"tracking.{key}={tracking[key]}" for key in keys)])


def refuse_reward(file: str | None, where: str, copy: Path | None = None) -> None:
    """Refuse to run a file as reward function that only a stored configuration names.

    `where` names the place of the configuration. The message names `copy` if the file is not on this machine.

    Raises:
        BadInput: the message says how the user names it.
    """
    if file is not None and not reward_file(file).is_own:
        readable = file if copy is None or Path(file).exists() else copy
        raise BadInput(
            f"{REWARD}={file}: named by {where}, and not a reward function that you have trained with, or changed "
            f"since; read it, and if you trust it, give {REWARD}={readable}"
        )


def _part(config: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    part = config.get(key)
    return part if isinstance(part, Mapping) else {}


def _record() -> Path | None:
    """Return the folder of this account's record: an empty file for each value; None: it has no home."""
    with contextlib.suppress(RuntimeError):
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
        return Path(base) / "deepracer_exp" / "named"
    return None


def _files_of(module: str) -> Iterator[Path]:
    """Return the files that the import of a module runs first: those of its packages and its own."""
    path: Sequence[str] | None = [*sys.path, str(Path.cwd())]
    parts = module.split(".")
    for depth in range(len(parts)):
        spec = importlib.machinery.PathFinder.find_spec(".".join(parts[: depth + 1]), path)
        if spec is None:
            return
        if spec.has_location and spec.origin is not None:
            yield Path(spec.origin)
        path = list(spec.submodule_search_locations or ())
