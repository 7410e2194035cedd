"""`deepracer-exp clone`: a new run that begins with another run's policy."""

import argparse
import sys
from pathlib import Path

from deepracer_exp.errors import BadInput

_EPILOG = """\
  deepracer-exp clone run=RUN                               RUN: a run's folder, its name or the beginning of it,
                                                            MLflow's id, best:EXPERIMENT, or a registered model's
                                                            alias (MODEL@ALIAS)
  deepracer-exp clone run=RUN checkpoint=last               from another checkpoint than the best
  deepracer-exp clone run=RUN algorithm.lr=1e-5             another rate than a tenth of the parent's
  deepracer-exp clone run=RUN reward=racing_line track=Oval_track
                                                            another reward function, another track

The clone has the parent's configuration, its networks and a fresh optimizer. Action space, observation and network
are the parent's. `deepracer-exp lineage RUN` draws the family tree.
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    clone = commands.add_parser(
        "clone",
        help="begin a new run with the policy of another one",
        description="Train on from another run's checkpoint, at a tenth of its learning rate unless another is given.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    clone.add_argument("overrides", nargs="*", metavar="run=RUN | checkpoint=NAME | GROUP=OPTION | KEY=VALUE")
    clone.add_argument("--runs-dir", default="runs", help="where the parent is (default: runs)")
    clone.add_argument(
        "--tracking-uri", help="MLflow store in which ids and aliases are looked up (default: in runs-dir)"
    )
    clone.set_defaults(command=_clone, runs_rewards=True)


def _clone(args: argparse.Namespace) -> int:
    from .checking import check_changes, check_files, check_run
    from .starting import has_workers, start_workers_early

    run = next((given.partition("=")[2] for given in args.overrides if given.startswith("run=")), "")
    if not run:
        raise BadInput("run: missing; write run=RUN: a run's folder, its name or the beginning of it")
    checkpoint = next(
        (one.partition("=")[2] for one in args.overrides if one.startswith("checkpoint=")), None
    )
    parent = check_run(run, args.runs_dir, args.tracking_uri, checkpoint).path
    changes = [one for one in args.overrides if not one.startswith(("run=", "checkpoint="))]
    check_files(check_changes(parent, changes))
    print("starting", file=sys.stderr, flush=True)
    start_workers_early(has_workers(parent))

    from rich.console import Console

    from deepracer_exp.training.clone import prepare_clone
    from deepracer_exp.training.run import train

    from .ending import tell
    from .stderr_warnings import warnings_on_stderr

    with warnings_on_stderr():
        clone = prepare_clone(args.overrides, Path(args.runs_dir), args.tracking_uri)
    args.debug = clone.experiment.debug
    for line in clone.told:
        print(line, file=sys.stderr)
    outcome = train(clone.experiment, clone.composition, Console(stderr=True), clone.start)
    tell(outcome, None if clone.experiment.tracking.kind == "off" else clone.experiment.runs_dir)
    return outcome.exit_code
