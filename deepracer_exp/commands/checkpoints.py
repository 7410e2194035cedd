"""`deepracer-exp checkpoints`: which checkpoint of a run to race with."""

import argparse
from pathlib import Path

from deepracer_exp.errors import BadInput

from .arguments import add_run, run_and_overrides
from .output import table_console, warnings_on_stderr
from .startup import check_run

_EPILOG = """\
  deepracer-exp checkpoints RUN                             the trials by which the training chose its best one
  deepracer-exp checkpoints RUN evaluation=summit evaluation.trials=40
  deepracer-exp checkpoints RUN evaluation.tracks=[Oval_track,Bowtie_track]
  deepracer-exp checkpoints RUN -o checkpoints.html         also draw speed against stability

Every checkpoint drives the same trials, on the conditions of its training and on conditions it was not trained on.
"""


def add_checkpoints(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "checkpoints",
        help="compare a run's checkpoints and recommend one",
        description="Race every kept checkpoint of a run, show how fast it is and how often it completes a lap, and "
        "recommend one.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run(parser, "evaluation=NAME | KEY=VALUE")
    parser.add_argument("-o", "--output", metavar="FILE", help="page with the figure to write (.html)")
    parser.add_argument("--json", metavar="FILE", help="write the figures to a JSON file")
    parser.set_defaults(command=_checkpoints, entry="evaluate")


def _checkpoints(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_evaluation
    from deepracer_exp.config.overrides import group_of, override_line

    run, overrides = run_and_overrides(args)
    chosen = [given for given in overrides if given.startswith("checkpoint=")]
    if chosen:
        raise BadInput(f"{chosen[0]}: all kept checkpoints are raced; `deepracer-exp evaluate` races one")
    for option, file in (("--output", args.output), ("--json", args.json)):
        if file is not None and not Path(file).absolute().parent.is_dir():
            raise BadInput(f"{option} {file}: its folder does not exist")
    if args.output is not None and Path(args.output).suffix != ".html":
        raise BadInput(f"--output {args.output}: accepted: the name of a page (.html)")
    config, _ = compose_evaluation([*overrides, override_line("run", run)])
    own_trials = not any(group_of(given) == "evaluation" for given in overrides)
    args.debug = config.debug
    check_run(config.run, config.runs_dir, config.tracking.uri, None)

    from rich.console import Console

    from deepracer_exp.evaluation.checkpoint_comparison import show_checkpoints

    progress = Console(stderr=True, highlight=False, markup=False)
    with warnings_on_stderr():
        show_checkpoints(config, own_trials, args.output, args.json, table_console(160), progress)
    return 0
