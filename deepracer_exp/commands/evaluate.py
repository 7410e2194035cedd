"""`deepracer-exp evaluate`: how good a trained policy is."""

import argparse
import sys
from pathlib import Path

from .arguments import RUN, add_run, run_and_overrides, runs_and_overrides
from .output import warnings_on_stderr
from .startup import check_run

_EPILOG = f"""\
  deepracer-exp evaluate RUN                                RUN: {RUN[: RUN.index("MLflow")].strip()}
                                                            {RUN[RUN.index("MLflow") :]}
  deepracer-exp evaluate RUN evaluation=summit              three_trials, four_minutes, summit or aws_virtual
  deepracer-exp evaluate RUN checkpoint=last evaluation.trials=20
  deepracer-exp evaluate RUN evaluation.tracks=[Oval_track,Bowtie_track]
  deepracer-exp evaluate RUN evaluation.held_out=null       on the usual conditions only
  deepracer-exp evaluate RUN --video lap.mp4 --view top

The results are also written to evaluations/TIME.json in the run's folder.
"""


def add_evaluate(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "evaluate",
        help="measure how good a trained car is",
        description=(
            "Race a run's best policy: several trials at once, on the conditions of its training and on conditions it "
            "was not trained on, on any tracks."
        ),
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run(parser, "checkpoint=NAME | evaluation=NAME | KEY=VALUE")
    parser.add_argument("--video", metavar="FILE", help="film the fastest lap (.mp4)")
    parser.add_argument("--view", choices=("chase", "top"), default="chase", help="camera of the film")
    parser.add_argument(
        "--cfg", action="store_true", help="print the composed configuration as YAML and stop"
    )
    parser.set_defaults(command=_evaluate, runs_rewards=True, entry="evaluate")


def _evaluate(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_entry, compose_evaluation
    from deepracer_exp.config.overrides import override_line

    if args.cfg:
        runs, overrides = runs_and_overrides(args)
        named = [override_line("run", run) for run in runs]
        print(compose_entry("evaluate", [*overrides, *named]).yaml(), end="")
        return 0
    run, overrides = run_and_overrides(args)
    config, _ = compose_evaluation([*overrides, override_line("run", run)])
    args.debug = config.debug
    if args.video is not None:
        # MuJoCo looks at this once, when it is imported.
        from deepracer_exp.evaluation.graphics import choose_graphics

        choose_graphics()
    check_run(config.run, config.runs_dir, config.tracking.uri, config.checkpoint)

    from rich.console import Console

    from deepracer_exp.evaluation.evaluate import evaluate

    video = None if args.video is None else (Path(args.video), args.view)
    out = Console(width=None if sys.stdout.isatty() else 160)
    with warnings_on_stderr():
        evaluate(config, video, out, Console(stderr=True))
    return 0
