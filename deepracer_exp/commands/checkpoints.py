"""`deepracer-exp checkpoints`: which checkpoint of a run to race with."""

import argparse
import sys
from pathlib import Path

from .stderr_warnings import warnings_on_stderr

_PICTURES = (".png", ".svg", ".pdf")
_EPILOG = """\
  deepracer-exp checkpoints RUN                             the trials by which the training chose its best one
  deepracer-exp checkpoints RUN evaluation=summit evaluation.trials=40
  deepracer-exp checkpoints RUN evaluation.tracks=[Oval_track,Bowtie_track]
  deepracer-exp checkpoints RUN -o checkpoints.png          also draw speed against stability

RUN is a run's folder, its name or the beginning of it, or MLflow's id. Every checkpoint drives the same trials, on
the usual conditions and on such it was not trained on.
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    checkpoints = commands.add_parser(
        "checkpoints",
        help="find out which checkpoint of a run to race with",
        description="Let every kept checkpoint of a run race, show how fast it is and how often it arrives, and "
        "recommend one.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    checkpoints.add_argument("overrides", nargs="+", metavar="RUN | evaluation=NAME | KEY=VALUE")
    checkpoints.add_argument("-o", "--output", metavar="FILE", help="picture to write (.png, .svg, .pdf)")
    checkpoints.add_argument("--json", metavar="FILE", help="write the figures to a file")
    checkpoints.set_defaults(command=_checkpoints)


def _checkpoints(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_evaluation
    from deepracer_exp.config.overrides import group_of, override_line
    from deepracer_exp.errors import BadInput

    from .checking import check_run

    runs = [given for given in args.overrides if "=" not in given]
    overrides = [given for given in args.overrides if given not in runs]
    if len(runs) > 1:
        raise BadInput(f"{len(runs)} runs given: {', '.join(runs)}; accepted: one")
    chosen = [given for given in overrides if given.startswith("checkpoint=")]
    if chosen:
        raise BadInput(f"{chosen[0]}: all that were kept are driven; `deepracer-exp evaluate` drives one")
    for option, file in (("--output", args.output), ("--json", args.json)):
        if file is not None and not Path(file).absolute().parent.is_dir():
            raise BadInput(f"{option} {file}: its folder is not there")
    if args.output is not None and Path(args.output).suffix not in _PICTURES:
        raise BadInput(f"--output {args.output}: accepted: {', '.join(_PICTURES)}")
    own = [override_line("run", run) for run in runs]
    config, _ = compose_evaluation([*overrides, *own])
    own_trials = not any(group_of(given) == "evaluation" for given in overrides)
    args.debug = config.debug
    check_run(config.run, config.runs_dir, config.tracking_uri, None)

    from rich.console import Console

    from deepracer_exp.evaluation.checkpoints import show_checkpoints

    # A pipe has no width of its own.
    out = Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False)
    with warnings_on_stderr():
        show_checkpoints(
            config,
            own_trials,
            args.output,
            args.json,
            out,
            Console(stderr=True, highlight=False, markup=False),
        )
    return 0
