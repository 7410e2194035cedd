# PYTHON_ARGCOMPLETE_OK
"""The command line; each command imports what it needs when it runs, so that `--help` and completion are fast."""

import argparse
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from typing import NoReturn

from deepracer_exp import __version__
from deepracer_exp.addresses import redact, without_passwords
from deepracer_exp.errors import BadInput, RunFailed, nearest
from deepracer_exp.streams import exit_code, standard_streams

_INTERRUPTED = 130
_EPILOG = """\
`deepracer-exp COMMAND --help` explains a command. Results are written to runs/ in the current folder.
Completion in bash or zsh: eval "$(register-python-argcomplete deepracer-exp)"
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit with its code: 0 done, 2 bad input, 3 the run failed, 130 interrupted.

    A reward function runs in the command's process: if it ends or crashes that (`os._exit`), the command ends.

    Args:
        arguments: of the command line, for a calling program; None: those of this process.
    """
    # Read when the library of torch's threads is loaded. By default a thread that has nothing to do keeps its core busy
    # for milliseconds: beside other work an update from pictures takes twice as long, or twenty times.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    words = without_passwords(list(sys.argv[1:] if arguments is None else arguments))
    with standard_streams() as output:
        code = _run(words, is_own_process=arguments is None)
        if arguments is None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command is done, and its exit code stands
        sys.exit(exit_code(output, code))


def _run(words: Sequence[str], is_own_process: bool) -> int:
    """Run a command line and return its exit code."""
    args = argparse.Namespace()
    try:
        if is_own_process:
            _prepare_process(words)
        args = parse(words)
        return int(args.command(args))
    except (BadInput, RunFailed) as error:
        if getattr(args, "debug", False) or "debug=true" in getattr(args, "overrides", ()):
            print(redact("".join(traceback.format_exception(error))), end="", file=sys.stderr)
        print(f"deepracer-exp: {redact(str(error))}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("deepracer-exp: interrupted", file=sys.stderr)
        return _INTERRUPTED
    except SystemExit as end:
        return int(end.code or 0)


def _prepare_process(words: Sequence[str]) -> None:
    from deepracer_exp.lifeline import guard_imports
    from deepracer_exp.scratch import own_scratch

    guard_imports()
    own_scratch()
    sys.argv[1:] = words  # the run's folder keeps them


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of a command line without running it.

    Raises:
        BadInput: the command or an argument is unknown.
        SystemExit: help or the version was printed.
    """
    from deepracer_exp.commands import runs

    parser = build_parser()
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    if not arguments:
        parser.print_help()
        raise SystemExit(0)
    args, rest = parser.parse_known_args(runs.with_default_action(list(arguments)))
    if any(argument.startswith("-") for argument in rest) or (rest and "overrides" not in args):
        raise BadInput(f"unrecognized arguments: {' '.join(rest)}; see `{args.prog} --help`")
    if rest:  # argparse accepts no positional arguments after an option between them
        args.overrides += rest
    return args


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands, in the order of `--help`."""
    from deepracer_exp.commands import actions, analyze, compare, evaluate, exchange, runs, tracks, train

    parser: argparse.ArgumentParser = _Parser(
        prog="deepracer-exp",
        description="Hundreds of DeepRacer-style racing experiments a day, on one machine.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"deepracer-exp {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for family in (train, runs, evaluate, analyze, compare, exchange, tracks, actions):
        family.add_commands(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    """Argparse with one-line errors, and without abbreviations of options."""

    def __init__(self, *args: object, **kwargs: object):
        super().__init__(*args, **{**kwargs, "allow_abbrev": False})  # type: ignore[arg-type]

    def error(self, message: str) -> NoReturn:
        raise BadInput(f"{message}; see `{self.prog} --help`")

    def _check_value(self, action: argparse.Action, value: str) -> None:
        # Newer versions of argparse suggest the nearest word themselves.
        choices = list(action.choices or ())
        if choices and value not in choices:
            name = action.option_strings[0] if action.option_strings else str(action.metavar).lower()
            raise BadInput(
                f"{value}: no such {name}{nearest(value, choices)}; accepted: {', '.join(choices)}"
            )


if __name__ == "__main__":
    main()
