"""`deepracer-exp clone`: train on from another run's policy."""

import argparse
import sys

from .arguments import RUN, add_run, run_and_overrides, split_stores
from .output import print_result, print_start, warnings_on_stderr
from .startup import check_changes, check_files, check_run, has_workers, start_workers_early

_EPILOG = f"""\
  deepracer-exp clone RUN                                   RUN: {RUN[: RUN.index("MLflow")].strip()}
                                                            {RUN[RUN.index("MLflow") :]}
  deepracer-exp clone RUN checkpoint=last                   from a checkpoint other than the best
  deepracer-exp clone RUN algorithm.lr=1e-5                 a learning rate other than a tenth of the parent's
  deepracer-exp clone RUN reward=racing_line track=Oval_track
                                                            another reward function, another track

The clone has the parent's configuration, its networks and a fresh optimizer. Action space, observation and network
cannot be changed. `deepracer-exp runs lineage RUN` draws the family tree.
"""


def add_clone(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "clone",
        help="start a new run from another run's policy",
        description="Train on from another run's checkpoint, at a tenth of its learning rate unless another is given.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run(parser, "checkpoint=NAME | GROUP=OPTION | KEY=VALUE")
    parser.set_defaults(command=_clone, runs_rewards=True)


def _clone(args: argparse.Namespace) -> int:
    run, given = run_and_overrides(args)
    checkpoints = [one.partition("=")[2] for one in given if one.startswith("checkpoint=")]
    changes = [one for one in given if not one.startswith("checkpoint=")]
    stores, _ = split_stores(given)
    parent = check_run(run, str(stores.runs_dir), stores.uri, checkpoints[-1] if checkpoints else None).path
    check_files(check_changes(parent, changes))
    print_start()
    start_workers_early(has_workers(parent))

    from rich.console import Console

    from deepracer_exp.training.clone import prepare_clone
    from deepracer_exp.training.run import train

    with warnings_on_stderr():
        clone = prepare_clone([f"run={run}", *given], stores.runs_dir, stores.uri)
    args.debug = clone.experiment.debug
    for line in clone.told:
        print(line, file=sys.stderr)
    outcome = train(clone.experiment, clone.composition, Console(stderr=True), clone.start)
    print_result(outcome, clone.experiment.runs_dir if clone.experiment.tracking.kind == "mlflow" else None)
    return outcome.exit_code
