"""`deepracer-exp stopping replay`: what a stopping rule would have made of finished runs."""

import argparse
from pathlib import Path

_EPILOG = """\
  deepracer-exp stopping replay RUN                           the rule `entropy` as it stands
  deepracer-exp stopping replay RUN RUN stopping=plateau      another rule
  deepracer-exp stopping replay RUN stopping.converged.patience=40,80
                                                              other values, one after the other
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    stopping = commands.add_parser(
        "stopping",
        help="try a stopping rule on finished runs",
        description="Try stopping rules on runs that went on.",
    )
    actions = stopping.add_subparsers(metavar="ACTION", required=True)
    replay = actions.add_parser(
        "replay",
        help="say where a rule would have ended runs, what it saves and what it loses",
        description="Apply a stopping rule to the metrics of runs: where would it have ended them, what would that "
        "have saved, and what was still to come?",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    replay.add_argument("overrides", nargs="+", metavar="RUN | stopping=NAME | stopping.KEY=VALUE")
    replay.add_argument("--runs-dir", default="runs", help="where runs given by name are (default: runs)")
    replay.set_defaults(command=_replay)


def _replay(args: argparse.Namespace) -> int:
    import sys

    from rich.console import Console

    from deepracer_exp.config.compose import compose_experiment, expand_grid
    from deepracer_exp.errors import BadInput
    from deepracer_exp.evaluation.run import find_run
    from deepracer_exp.formats.run_files import read_run
    from deepracer_exp.training.stopping_replay import replay, table

    overrides = [given for given in args.overrides if given.startswith(("stopping=", "stopping."))]
    runs = [given for given in args.overrides if given not in overrides]
    if not runs:
        raise BadInput("no run given; accepted: a run's folder, or its name in runs/EXPERIMENT/")
    if not any(override.startswith("stopping=") for override in overrides):
        overrides.insert(0, "stopping=entropy")
    records = [read_run(find_run(run, Path(args.runs_dir), None)) for run in runs]
    rules = [(_words(lines), compose_experiment(lines)[0].stopping) for lines in expand_grid(overrides)]
    replays = [replay(record, config, rule) for record in records for rule, config in rules]
    # Run folders have long names, and a pipe has no width of its own.
    Console(width=None if sys.stdout.isatty() else 200, highlight=False, markup=False).print(table(replays))
    return 0


def _words(overrides: list[str]) -> str:
    return " ".join(override.removeprefix("stopping").lstrip(".=") for override in overrides)
