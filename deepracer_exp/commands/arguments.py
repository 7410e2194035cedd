"""Arguments of a command line: RUN, overrides, where runs are, and shell completion."""

import argparse
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.runs.run_files import BEST, RUN, run_folders, shortest_names

if TYPE_CHECKING:
    from deepracer_exp.runs.stored_run import StoredRun

STORES = ("runs_dir", "tracking.uri")
"""The folder of runs, and the MLflow store in which ids and aliases are looked up."""
STORES_METAVAR = "runs_dir=DIR | tracking.uri=URI"
"""The words of a command's help for overrides of the two."""

_OVERRIDE = re.compile(r"[+~]*[A-Za-z_][\w./@-]*=.*", re.DOTALL)


def add_command(
    commands: "argparse._SubParsersAction[argparse.ArgumentParser]",
    name: str,
    call: Callable[[argparse.Namespace], int],
    *,
    help: str,
    description: str,
    epilog: str | None = None,
    **defaults: object,
) -> argparse.ArgumentParser:
    """Add a command and return its parser; `call` runs it, and `defaults` are attributes of its arguments."""
    parser = commands.add_parser(
        name,
        help=help,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter if epilog else argparse.HelpFormatter,
    )
    parser.set_defaults(command=call, prog=parser.prog, **defaults)
    return parser


def add_run(
    parser: argparse.ArgumentParser,
    overrides: str = "KEY=VALUE",
    *,
    many: bool = False,
    metavar: str = "RUN",
    help: str = RUN,
    completer: Callable[..., list[str]] | None = None,
) -> None:
    """Give a command the arguments `RUN [overrides]`, which `run_and_overrides` returns."""
    run = parser.add_argument("runs", nargs="*" if many else "?", metavar=metavar, help=help)
    run.completer = completer or complete_runs  # type: ignore[attr-defined]
    add_overrides(parser, overrides, complete_runs)


def add_overrides(
    parser: argparse.ArgumentParser,
    metavar: str = "KEY=VALUE",
    completer: Callable[..., list[str]] | None = None,
) -> None:
    """Give a command overrides in Hydra's grammar."""
    action = parser.add_argument("overrides", nargs="*", metavar=metavar)
    action.completer = completer or complete_overrides  # type: ignore[attr-defined]


def port(text: str) -> int:
    """Return the value of `--port`.

    Raises:
        ArgumentTypeError: it is no port.
    """
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text}: accepted: 1 to 65535")
    return int(text)


def runs_and_overrides(args: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Return the runs of a command line and its overrides, in whatever order they were given.

    Raises:
        BadInput: a run is given as `run=RUN`.
    """
    words = _words(args)
    for word in words:
        if word.startswith("run="):
            raise BadInput(f"{word}: write {args.prog} {shlex.quote(word.removeprefix('run='))}")
    return [word for word in words if not is_override(word)], [word for word in words if is_override(word)]


def _words(args: argparse.Namespace) -> list[str]:
    """Return runs and overrides as they were given."""
    runs = getattr(args, "runs", None) or []
    return [*([runs] if isinstance(runs, str) else runs), *(getattr(args, "overrides", None) or [])]


def run_and_overrides(args: argparse.Namespace) -> tuple[str, list[str]]:
    """Return the one run of a command line and its overrides.

    Raises:
        BadInput: no run is given, or several, or one as `run=RUN`.
    """
    runs, overrides = runs_and_overrides(args)
    if not runs:
        raise BadInput(f"RUN: missing; write {args.prog} RUN: {RUN}")
    if len(runs) > 1:
        raise BadInput(f"{' '.join(runs)}: {len(runs)} runs given; accepted: one")
    return runs[0], overrides


def is_override(word: str) -> bool:
    """Return whether a word is an override, `KEY=VALUE`; the name of a run has no equals sign."""
    return _OVERRIDE.fullmatch(word) is not None


@dataclass(frozen=True)
class Stores:
    """The place to look up runs."""

    runs_dir: Path
    uri: str | None
    """MLflow store; None: the one in `runs_dir`."""
    values: dict[str, str]
    """Values of the other keys that the command takes."""

    def find(self, run: str) -> "StoredRun":
        """Find a run; arguments and errors as for `tracking.resolve.resolve`."""
        from deepracer_exp.tracking.resolve import resolve

        return resolve(run, self.runs_dir, self.uri)


def read_stores(overrides: Iterable[str], keys: Sequence[str] = ()) -> Stores:
    """Read the overrides of a command that composes no configuration.

    The last of several with the same key counts; `keys` are accepted besides `STORES`.

    Raises:
        BadInput: another key, or a word that is no override.
    """
    accepted = [*keys, *STORES]
    values: dict[str, str] = {}
    for word in overrides:
        key, equals, value = word.partition("=")
        if not equals or key not in accepted:
            raise BadInput(f"{word}: no such key{nearest(key, accepted)}; accepted: {', '.join(accepted)}")
        quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "'\""
        values[key] = value[1:-1] if quoted else value
    chosen = {key: value for key, value in values.items() if value not in ("", "null")}
    text = chosen.pop("runs_dir", "runs")
    with reading(f"runs_dir={text}"):
        runs_dir = Path(text).expanduser()
    return Stores(runs_dir, chosen.pop("tracking.uri", None), chosen)


def split_stores(overrides: Iterable[str]) -> tuple[Stores, list[str]]:
    """Read the place of runs and return the other overrides unchanged."""
    words = list(overrides)
    stores = [word for word in words if word.partition("=")[0] in STORES]
    return read_stores(stores), [word for word in words if word not in stores]


def complete_runs(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """Return the names of all runs, and of the best run of each experiment."""
    words = [word for word in _words(parsed_args) if is_override(word)]
    folders = run_folders(split_stores(words)[0].runs_dir)
    best = sorted({f"{BEST}{folder.parent.name}" for folder in folders})
    return shortest_names(folders) + best + complete_overrides(prefix, parsed_args)


def complete_overrides(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """Return the groups of a command, or the options of the group that was typed."""
    from deepracer_exp.config.options import groups, options

    entry = getattr(parsed_args, "entry", "train")
    names = [] if entry is None else groups(entry)
    group, equals, _value = prefix.partition("=")
    if equals:
        return [f"{group}={name}" for name in options(group)] if group in names else []
    return [f"{name}=" for name in names]


def complete_groups(**_: Any) -> list[str]:
    """Return the names of the groups."""
    from deepracer_exp.config.options import groups

    return groups()
