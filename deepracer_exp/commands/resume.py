"""`deepracer-exp resume`: go on with a run that was killed, interrupted or failed."""

import argparse
from pathlib import Path

from deepracer_exp.formats.run_files import read_config

_EPILOG = """\
  deepracer-exp resume RUN                                  RUN: a run's folder, its name or the beginning of it, or
                                                            MLflow's id
  deepracer-exp resume RUN budget.env_steps=5000000         what changes nothing of what is learned may be changed:
                                                            budget, stopping, tracking, checkpoints.keep and time
                                                            limits
  deepracer-exp resume RUN stopping=none                    a run that ended by its stopping rule uses its budget up

The run goes on from its last checkpoint, in its own folder and in the same run of MLflow; what it wrote after that
checkpoint is written anew. With collector=sync and collector=in_process the result is that of an uninterrupted run,
bit for bit. With collector=async, or a budget in minutes or money, it cannot be. A reward function that keeps
something between two calls begins with nothing.

A run that has come to its end, and was recorded while MLflow did not answer, gets its missing points delivered.
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    resume = commands.add_parser(
        "resume",
        help="go on with a run that was killed, interrupted or failed",
        description="Go on with a run from its last checkpoint.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    resume.add_argument("run", metavar="RUN")
    resume.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    resume.add_argument("--runs-dir", default="runs", help="where runs given by name are (default: runs)")
    resume.add_argument(
        "--tracking-uri", help="MLflow store in which an id is looked up (default: the one in runs-dir)"
    )
    resume.set_defaults(command=_resume, runs_rewards=True)


def _resume(args: argparse.Namespace) -> int:
    import sys

    from deepracer_exp.evaluation.references import resolve

    from .checking import check_changes
    from .starting import has_workers, start_workers_early

    run_dir = resolve(args.run, Path(args.runs_dir), args.tracking_uri).path
    check_changes(run_dir, args.overrides)
    print("starting", file=sys.stderr, flush=True)
    start_workers_early(has_workers(run_dir))

    from rich.console import Console

    from deepracer_exp.training.run import RunEnded, resume

    from .ending import tell
    from .stderr_warnings import warnings_on_stderr

    try:
        with warnings_on_stderr():
            outcome = resume(run_dir, args.overrides, Console(stderr=True))
    except RunEnded as error:
        return _deliver(run_dir, args.overrides, error)
    tell(outcome, args.runs_dir)
    return outcome.exit_code


def _deliver(run_dir: Path, overrides: list[str], ended: Exception) -> int:
    """Give MLflow what it lacks of a run that has ended; where that is nothing, the end is what there is to say."""
    from deepracer_exp.tracking.delivery import deliver
    from deepracer_exp.tracking.tracking_file import NAME

    if not (run_dir / NAME).exists():
        raise ended
    given = [
        override.removeprefix("tracking.uri=")
        for override in overrides
        if override.startswith("tracking.uri=")
    ]
    config = read_config(run_dir)
    uri = given[-1] if given else config["tracking"].get("uri")
    points = deliver(run_dir, uri, run_dir.parent.parent)
    if not points:
        raise ended
    print(f"{ended}\n  {points:,} points that MLflow lacked have been delivered")
    return 0
