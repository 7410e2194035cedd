"""The two generated pages of the site: the command line, from its parser, and the configuration, from conf/.

MkDocs calls `on_files` of this module as a hook (mkdocs.yml); nothing is written to disk.
"""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from deepracer_exp.config.options import conf_dir, options_of

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

COMMANDS_HEAD = """\
# Command line

    deepracer-exp COMMAND [RUN] [OVERRIDES] [--FLAGS]

Overrides (`GROUP=OPTION`, `KEY=VALUE`) set the configuration, in [Hydra's
grammar](https://hydra.cc/docs/advanced/override_grammar/basic/). Flags set what belongs to the command itself: what it
prints and writes and where, and choices such as `--strict` and `--apply`. Two overrides mean the same in every command:
`runs_dir=DIR` is where runs are (default `runs`), `tracking.uri=URI` is the MLflow store (default: `mlflow.db` in
`runs_dir`).

`RUN` is a run's folder, its name or the beginning of its name, its MLflow id, `best:EXPERIMENT`, or the alias of a
promoted model ([the ways to name a run](lineage.md#how-to-name-a-run)).

`eval "$(register-python-argcomplete deepracer-exp)"` in your shell's start-up file completes commands, groups, options
and names of runs.

| exit code | meaning |
|---|---|
| 0 | done |
| 2 | bad input; one line names the file, the key and the value, and says what would be accepted |
| 3 | the run failed |
| 130, 143 | interrupted by Ctrl-C, ended by SIGTERM |
"""

CONFIGURATION_HEAD = """\
# Configuration

An experiment is one option of each group below, plus a value for any key you want to change:

    deepracer-exp train track=Oval_track reward=racing_line algorithm.lr=3e-4

`deepracer-exp train --options GROUP` lists the options of a group, and `deepracer-exp train ... --cfg` prints the whole
experiment without running it. YAML files of your own in `./conf/GROUP/` are options, too.

In the tables the default option is in bold. The listings under a table are the options that explain the group's keys.
"""


def parsers(parser: argparse.ArgumentParser, name: str) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield each command that takes arguments of its own, as (full name, parser), in the order of `--help`."""
    nested = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not nested or any(not action.required for action in nested):
        yield name, parser
    for action in nested:
        for word, below in dict(action.choices).items():
            yield from parsers(below, f"{name} {word}".strip())


def commands_page() -> str:
    """Return the page of all commands, from the parser's own help texts."""
    from deepracer_exp.cli import build_parser

    text = COMMANDS_HEAD
    for name, parser in parsers(build_parser(), ""):
        parser.formatter_class = _WideHelp
        description, parser.description = parser.description or "", None
        text += f"\n## {name}\n\n{description}\n\n```text\n{parser.format_help().strip()}\n```\n"
    return text


class _WideHelp(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30, width=110)


def configuration_page() -> str:
    """Return the page of all groups, with their options and keys, from the files of conf/."""
    text = CONFIGURATION_HEAD
    for group, default, purpose in train_groups():
        text += f"\n## {group}\n\n{purpose}\n\n| option | |\n|---|---|\n"
        described = options_of(group)
        for option, sentence in described.items():
            if sentence:
                name = f"**`{option}`**" if option == default else f"`{option}`"
                text += f"| {name} | {sentence} |\n"
        others = [f"`{option}`" for option, sentence in described.items() if not sentence]
        if others:
            text += f"\nFurther options: {', '.join(others)}.\n"
        text += "".join(map(_listing, _explaining(group, default)))
    text += "\n## Keys of the experiment itself\n" + _listing(conf_dir() / "train.yaml")
    text += "\n## sweep\n\nA sweep has keys of its own; `deepracer-exp sweep sweep=NAME` chooses a ready-made one.\n"
    text += _listing(conf_dir() / "sweep.yaml") + _listing(conf_dir() / "sweep" / "own.yaml")
    return text + "\n## Keys of `deepracer-exp evaluate`\n" + _listing(conf_dir() / "evaluate.yaml")


def train_groups() -> list[tuple[str, str | None, str]]:
    """Return (group, default option, purpose) in the order of conf/train.yaml; the purpose is the line's comment."""
    rows = re.findall(r"^  - (\w+): (\w+) *# (.+)$", (conf_dir() / "train.yaml").read_text(), re.MULTILINE)
    return [(group, None if option == "null" else option, purpose) for group, option, purpose in rows]


def _explaining(group: str, default: str | None) -> list[Path]:
    """Return the files of a group that together explain all of its keys: the default option's, then whole ones."""
    if default is None:
        return []
    keys_of = {path: yaml.safe_load(path.read_text()).keys() for path in (conf_dir() / group).glob("*.yaml")}
    files = sorted(keys_of, key=lambda path: (path.stem != default, "defaults" in keys_of[path], path.stem))
    chosen, known = [], {"defaults"}
    for path in files:
        keys = keys_of[path]
        if keys - known:
            chosen.append(path)
            known |= keys
    return chosen


def _listing(path: Path) -> str:
    return f'\n```yaml title="conf/{path.relative_to(conf_dir())}"\n{path.read_text().strip()}\n```\n'


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Add the generated pages to the site."""
    from mkdocs.structure.files import File

    for name, content in (("commands.md", commands_page()), ("configuration.md", configuration_page())):
        files.append(File.generated(config, name, content=content))
    return files
