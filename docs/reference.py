"""Write the two generated pages: the command line, from its parser, and the configuration, from conf/.

`python docs/reference.py` writes docs/commands.md and docs/configuration.md.
"""

import argparse
import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from textwrap import dedent, fill

import yaml

from deepracer_exp.cli import build_parser
from deepracer_exp.config.options import conf_dir, options_of
from deepracer_exp.runs.run_files import RUN

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

`deepracer-exp COMMAND --help` prints the same in the terminal.

| command | |
|---|---|
"""

CONFIGURATION_HEAD = """\
# Configuration

An experiment is one option of each group below, plus a value for any key you want to change:

    deepracer-exp train track=Oval_track reward=racing_line algorithm.lr=3e-4

`deepracer-exp train --options GROUP` lists the options of a group, `deepracer-exp tracks` the [tracks](tracks.md) with
their lengths, and `deepracer-exp train ... --cfg` prints the whole experiment without running it. YAML files of your
own in `./conf/GROUP/` are options, too.

In the tables the default option is in bold. The files under a table are options that together explain the group's keys.

| group | default | |
|---|---|---|
"""

SWEEP_HEAD = """
## sweep

A sweep has keys of its own; `deepracer-exp sweep sweep=NAME` chooses a [ready-made one](sweeps.md#what-is-searched).
"""


def commands_page() -> str:
    """Return the page of all commands: an index, and a section for each from its parser."""
    commands = list(_commands(build_parser()))
    index = "".join(
        f"| [`{name}`](#{name.replace(' ', '-')}) | {summary} |\n" for name, summary, _ in commands
    )
    return COMMANDS_HEAD + index + "".join(_section(name, parser) for name, _, parser in commands)


def _commands(
    parser: argparse.ArgumentParser, family: str = ""
) -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """Yield each command as (full name, summary, parser), in the order of `--help`."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for choice in action._choices_actions:
                name = f"{family} {choice.dest}".strip()
                yield name, choice.help or "", action.choices[choice.dest]
                yield from _commands(action.choices[choice.dest], name)


def _section(name: str, parser: argparse.ArgumentParser) -> str:
    """Return the section of a command, not in argparse's layout, which differs between versions of Python."""
    parts = [f"## {name}", f"`{_usage(parser)}`", _wrapped(parser.description or "")]
    arguments = [
        _wrapped(f"- {_argument(action)}: {action.help}", indent="  ")
        for action in parser._actions
        # The head of the page explains RUN and --help.
        if action.help not in (None, RUN) and not isinstance(action, argparse._HelpAction)
    ]
    parts.append("\n".join(arguments))
    epilog = re.sub(r"\n\n(?=  )", "\n", parser.epilog or "")
    for is_indented, group in groupby(epilog.splitlines(), lambda line: line.startswith("  ")):
        lines = list(group)
        parts.append(_examples(lines) if is_indented else "\n".join(lines).strip())
    return "\n" + "\n\n".join(filter(None, parts)) + "\n"


def _examples(lines: list[str]) -> str:
    """Return the indented lines of a help text: a list, or examples, each below its explanation as a comment."""
    if lines[0].startswith("  - "):
        return dedent("\n".join(lines))
    examples: list[tuple[str, list[str]]] = []
    for line in lines:
        is_explained = re.match(r".{58}  \S", line)  # in column 60; a long example's is on the next line
        example, explanation = (line[:60].strip(), line[60:]) if is_explained else (line.strip(), "")
        if example:
            examples.append((example, []))
        examples[-1][1].extend(explanation.split())
    text = ""
    for example, words in examples:
        text += fill(" ".join(["#", *words]), 100, subsequent_indent="# ") + "\n" if words else ""
        text += f"{example}\n"
    return f"```bash\n{text}```"


def _usage(parser: argparse.ArgumentParser) -> str:
    """Return the command with its arguments and required flags; the list under it has the other flags."""
    parser.formatter_class = lambda prog: argparse.HelpFormatter(prog, width=1000)
    parser.color = False  # since Python 3.14
    usage = " ".join(parser.format_usage().split()).removeprefix("usage: ")
    # A run and overrides come in any order, so that argparse does not know that the run is required.
    return re.sub(r"\[(-|OPTION)[^]]*\] ", "", usage).replace("[RUN]", "RUN")


def _argument(action: argparse.Action) -> str:
    """Return the names of an argument and its value, as code."""
    names = list(action.option_strings)
    value = action.metavar or "|".join(action.choices or [action.dest.upper()])
    if action.nargs != 0:
        names[-1:] = [" ".join([*names[-1:], str(value)])]
    return ", ".join(f"`{name}`" for name in names)


def _wrapped(text: str, indent: str = "") -> str:
    return fill(text, 120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def configuration_page() -> str:
    """Return the page of all groups, with their options and keys, from the files of conf/."""
    groups = train_groups()
    text = CONFIGURATION_HEAD
    for group, default, purpose in groups:
        text += f"| [`{group}`](#{group}) | {f'`{default}`' if default else 'none'} | {purpose} |\n"
    for group, default, purpose in groups:
        text += f"\n## {group}\n\n{purpose}\n\n| option | |\n|---|---|\n"
        described = options_of(group)
        for option, sentence in described.items():
            if sentence:
                name = f"**`{option}`**" if option == default else f"`{option}`"
                text += f"| {name} | {sentence} |\n"
        others = [f"`{option}`" for option, sentence in described.items() if not sentence]
        if others:
            text += "\n" + _wrapped(f"Further options: {', '.join(others)}.") + "\n"
        text += "".join(map(_listing, _explaining(group, default)))
    text += "\n## Keys of the experiment itself\n" + _listing(conf_dir() / "train.yaml")
    text += SWEEP_HEAD
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
    listing = path.read_text(encoding="utf-8").strip()
    return f"\n`conf/{path.relative_to(conf_dir()).as_posix()}`:\n\n```yaml\n{listing}\n```\n"


PAGES = {"commands.md": commands_page, "configuration.md": configuration_page}

if __name__ == "__main__":
    for file, page in PAGES.items():
        Path(__file__).with_name(file).write_text(page(), encoding="utf-8")
