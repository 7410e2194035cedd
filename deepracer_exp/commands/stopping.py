"""`deepracer-exp stopping replay`: where a stopping rule would have ended finished runs."""

import argparse

from deepracer_exp.errors import BadInput

from .arguments import add_run, runs_and_overrides, split_stores
from .output import table_console

_EPILOG = """\
  deepracer-exp stopping replay RUN                           the rule `entropy` with its default values
  deepracer-exp stopping replay RUN RUN stopping=plateau      another rule
  deepracer-exp stopping replay RUN stopping.converged.patience=40,80
                                                              other values, one after the other
"""


def add_stopping(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "stopping",
        help="try a stopping rule on finished runs",
        description="Try stopping rules on finished runs.",
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    replay = actions.add_parser(
        "replay",
        help="show where a rule would have ended runs, what it saves and what it loses",
        description="Apply a stopping rule to the metrics of runs: where would it have ended them, what would that "
        "have saved, and how much better did they still become?",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run(replay, "stopping=NAME | stopping.KEY=VALUE", many=True)
    replay.set_defaults(command=_replay)


def _replay(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_experiment, expand_grid
    from deepracer_exp.runs.files import read_run
    from deepracer_exp.runs.resolve import resolve

    runs, given = runs_and_overrides(args)
    stores, overrides = split_stores(given)
    for override in overrides:
        if not override.startswith(("stopping=", "stopping.")):
            raise BadInput(f"{override}: accepted: stopping=NAME and stopping.KEY=VALUE")
    if not runs:
        raise BadInput("RUN: missing; accepted: a run's folder, or its name in runs/EXPERIMENT/")
    if not any(override.startswith("stopping=") for override in overrides):
        overrides.insert(0, "stopping=entropy")
    records = [read_run(resolve(run, stores.runs_dir, stores.uri).path) for run in runs]

    from deepracer_exp.training.stopping_replay import replay, table

    rules = [(_shown(lines), compose_experiment(lines)[0].stopping) for lines in expand_grid(overrides)]
    replays = [replay(record, config, rule) for record in records for rule, config in rules]
    table_console().print(table(replays))
    return 0


def _shown(overrides: list[str]) -> str:
    return " ".join(override.removeprefix("stopping").lstrip(".=") for override in overrides)
