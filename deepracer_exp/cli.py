# PYTHON_ARGCOMPLETE_OK
"""The command line; each command imports what it needs when it runs, so that `--help` and completion are fast."""

from deepracer_exp.ctrl_c import ending_at_once, interrupt, set_handler

with ending_at_once():
    import argparse
    import atexit
    import contextlib
    import os
    import select
    import signal
    import sys
    import threading
    import time
    import traceback
    from collections.abc import Callable, Sequence
    from types import FrameType
    from typing import NoReturn

    from deepracer_exp import __version__
    from deepracer_exp.addresses import redact, without_passwords
    from deepracer_exp.commands import actions, analyze, compare, evaluate, files, runs, tracks, train
    from deepracer_exp.errors import BadInput, RunFailed, nearest
    from deepracer_exp.lifeline import die_with_parent, guard_imports
    from deepracer_exp.scratch import own_scratch
    from deepracer_exp.streams import Output, exit_code, standard_streams

_COMMANDS = (train, runs, evaluate, analyze, compare, files, tracks, actions)
"""In the order of `--help`."""
_EPILOG = """\
`deepracer-exp COMMAND --help` explains a command. Results are written to runs/ in the current folder.
Completion in bash or zsh: eval "$(register-python-argcomplete deepracer-exp)"
"""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_ARRIVES_S = 0.1
"""By then a signal to the whole process group has reached the child or is pending, and another one changes nothing."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit with its code: 0 done, 2 bad input, 3 the run failed, 130/143 interrupted.

    Args:
        arguments: of the command line, to run in this process; None: those of this process, and a command that runs
            reward functions does so in a child process.
    """
    # Read when the library of torch's threads is loaded. By default a thread that has nothing to do keeps its core busy
    # for milliseconds: beside other work an update from pictures takes twice as long, or twenty times.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    words = without_passwords(list(sys.argv[1:] if arguments is None else arguments))
    with standard_streams() as output:
        if arguments is not None:
            sys.exit(_call(_parsed(words, output), output))
        with ending_at_once():
            guard_imports()
            sys.argv[1:] = words  # the run's folder keeps them
            args = _parsed(words, output, has_own_process=True)
            own_scratch()
            is_supervised = getattr(args, "runs_rewards", False)
            code = supervised(lambda: _call(args, output)) if is_supervised else _call(args, output)
        with ending_at_once():
            end_process(code)


def _parsed(words: Sequence[str], output: Output, *, has_own_process: bool = False) -> argparse.Namespace:
    """Return the parsed arguments; exit if they cannot be used, or if help or the version was printed."""
    try:
        args = parse(words)
    except BadInput as error:
        sys.exit(_fail(error, BadInput.exit_code, argparse.Namespace()))
    except SystemExit as end:
        sys.exit(exit_code(output, int(end.code or 0)))
    args.has_own_process = has_own_process
    return args


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of a command line without running it.

    Raises:
        BadInput: the command or an argument is unknown.
        SystemExit: help or the version was printed.
    """
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
    """Return the parser of all commands."""
    parser: argparse.ArgumentParser = _Parser(
        prog="deepracer-exp",
        description="Hundreds of DeepRacer-style racing experiments a day, on one machine.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"deepracer-exp {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for family in _COMMANDS:
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


def _call(args: argparse.Namespace, output: Output) -> int:
    """Run the parsed command and return its exit code."""
    try:
        if args.has_own_process:
            set_handler(interrupt)
        return exit_code(output, int(args.command(args)))
    except BadInput as error:
        return _fail(error, BadInput.exit_code, args)
    except RunFailed as error:
        return _fail(error, RunFailed.exit_code, args)
    except KeyboardInterrupt:
        return 130


def end_process(code: int) -> NoReturn:
    """Exit with a code once threads and exit functions are done, without taking the modules apart.

    After a training that would take up to a second, for memory that the system has back anyway.
    """
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):  # closed, or its reader has ended: Python has an answer to that
        sys.exit(code)
    os._exit(code)


def _fail(error: Exception, code: int, args: argparse.Namespace) -> int:
    if getattr(args, "debug", False) or "debug=true" in getattr(args, "overrides", ()):
        print(redact("".join(traceback.format_exception(error))), end="", file=sys.stderr)
    print(f"deepracer-exp: {redact(str(error))}", file=sys.stderr)
    return code


def supervised(call: Callable[[], int]) -> int:
    """Call a function in a child process and return its result, an exit code.

    Reward functions run within a command's process. They can exit it (`os._exit(0)`), crash it or damage the
    interpreter. Hence an exit code counts only if it comes through a pipe, after the call has returned. A process that
    ends in another way has failed; one line says so, from a process in which no reward has run. After a signal it was
    interrupted, however it ended: some libraries abort the process if Ctrl-C comes while they are loaded.

    Args:
        call: returns 0 to 255; an exception ends the child with a traceback.
    """
    results, result = os.pipe()
    signal_read_fd, signal_write_fd = os.pipe()
    supervisor = os.getpid()
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    child = os.fork()
    if child == 0:
        os.close(results)
        os.close(signal_read_fd)
        die_with_parent()
        if os.getppid() != supervisor:
            os._exit(RunFailed.exit_code)
        # Python writes the number of each signal it receives into this pipe.
        os.set_blocking(signal_write_fd, False)
        signal.set_wakeup_fd(signal_write_fd, warn_on_full_buffer=False)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        code = call()
        os.write(result, bytes([code]))
        return code
    os.close(result)
    os.close(signal_write_fd)

    interruptions: list[int] = []

    def pass_on(signum: int, _: FrameType | None) -> None:
        """Give the child a signal that was sent to this process alone; Ctrl-C in a terminal reaches both."""
        interruptions.append(signum)
        if not _has_received(signal_read_fd, signum):
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(child, signum)

    for signum in _SIGNALS:
        signal.signal(signum, pass_on)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    # Without blocking: a process that the child has forked may still hold the pipe open.
    os.set_blocking(results, False)
    with contextlib.suppress(BlockingIOError):
        received = os.read(results, 1)
        if received:
            return received[0]
    if -ended in _SIGNALS:
        return 128 - ended
    how = f"left it with exit code {ended}" if ended >= 0 else f"was ended by {signal.Signals(-ended).name}"
    if interruptions and ended == 128 + interruptions[0]:
        return ended
    if interruptions:
        print(f"deepracer-exp: interrupted; the process {how} before the command was done", file=sys.stderr)
        return 128 + interruptions[0]
    print(
        f"deepracer-exp: the process {how} before the command was done; a reward function can do that",
        file=sys.stderr,
    )
    return RunFailed.exit_code


def _has_received(signal_read_fd: int, signum: int) -> bool:
    give_up_at = time.monotonic() + _ARRIVES_S
    while select.select([signal_read_fd], [], [], max(give_up_at - time.monotonic(), 0.0))[0]:
        received = os.read(signal_read_fd, 65536)
        if signum in received:
            return True
        if not received:  # the child is gone
            break
    return False


if __name__ == "__main__":
    main()
