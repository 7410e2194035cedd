"""`deepracer-exp resume`: continue a run that was killed, interrupted or failed."""

import argparse
from pathlib import Path

from deepracer_exp.runs.files import read_config

from .arguments import add_run, run_and_overrides, split_stores
from .output import print_result, print_start, warnings_on_stderr
from .startup import check_changes, has_workers, start_workers_early

_EPILOG = """\
  deepracer-exp resume RUN                                  RUN: a run's folder, its name or the beginning of it, or
                                                            MLflow's id
  deepracer-exp resume RUN budget.env_steps=5000000         values that do not affect learning may be changed:
                                                            budget, stopping, tracking, checkpoints.keep and time
                                                            limits
  deepracer-exp resume RUN stopping=none                    a run that was ended by its stopping rule uses up its
                                                            budget

The run continues from its last checkpoint, in its own folder and in the same MLflow run; whatever it wrote after that
checkpoint is overwritten. With collector=sync and collector=in_process the result equals that of an uninterrupted
run, bit for bit. With collector=async, or a budget in minutes or money, it cannot. A reward function that keeps
state between calls starts without it.

If a finished run was recorded while MLflow did not answer, resume delivers the missing points.
"""


def add_resume(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "resume",
        help="continue a run that was killed, interrupted or failed",
        description="Continue a run from its last checkpoint.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run(parser)
    parser.set_defaults(command=_resume, runs_rewards=True)


def _resume(args: argparse.Namespace) -> int:
    from deepracer_exp.runs.resolve import resolve

    name, given = run_and_overrides(args)
    stores, changes = split_stores(given)
    run_dir = resolve(name, stores.runs_dir, stores.uri).path
    # The folder says where the run is, but MLflow may have moved.
    overrides = [*changes, *(one for one in given if one.startswith("tracking.uri="))]
    check_changes(run_dir, overrides)
    print_start()
    start_workers_early(has_workers(run_dir))

    from rich.console import Console

    from deepracer_exp.training.run import RunEnded, resume

    try:
        with warnings_on_stderr():
            outcome = resume(run_dir, overrides, Console(stderr=True))
    except RunEnded as error:
        return _deliver(run_dir, stores.uri, error)
    print_result(outcome, str(stores.runs_dir))
    return outcome.exit_code


def _deliver(run_dir: Path, uri: str | None, ended: Exception) -> int:
    """Deliver the points of an ended run that MLflow lacks; if there are none, raise that the run has ended."""
    from deepracer_exp.runs.files import TRACKING
    from deepracer_exp.tracking.delivery import deliver

    if not (run_dir / TRACKING).exists():
        raise ended
    points = deliver(run_dir, uri or read_config(run_dir)["tracking"].get("uri"), run_dir.parent.parent)
    if not points:
        raise ended
    print(f"{ended}\n  delivered {points:,} points that MLflow lacked")
    return 0
