"""`deepracer-exp clean`: what the runs' folders could do without."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from deepracer_exp.tracking.cleaning import Removable
    from deepracer_exp.tracking.overview import Overview

_EPILOG = """\
What could go:
  - checkpoints that are neither best nor last
  - the traces of failed runs
  - the folders of runs that were deleted in MLflow

What never goes: checkpoints that are registered (deepracer-exp promote), pinned or cloned from, and runs that have
one; runs that are in progress; what no training made, and whatever links lead to.
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    clean = commands.add_parser(
        "clean",
        help="list what could be removed, or remove it",
        description="List what the runs' folders could do without, with sizes; with --apply, remove it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    clean.add_argument("--apply", action="store_true", help="remove what is listed")
    clean.add_argument("--runs-dir", default="runs", help="where the runs are (default: runs)")
    clean.add_argument(
        "--tracking-uri", help="MLflow store that says what was deleted (default: the one in --runs-dir)"
    )
    clean.set_defaults(command=_clean)


def _clean(args: argparse.Namespace) -> int:
    import sys

    from rich.console import Console

    from deepracer_exp.errors import BadInput
    from deepracer_exp.tracking.cleaning import remove, survey, total

    runs_dir = Path(args.runs_dir)
    if not runs_dir.is_dir():
        raise BadInput(f"--runs-dir {runs_dir}: is no folder; accepted: where trainings write their runs")
    # A pipe has no width of its own.
    console = Console(width=None if sys.stdout.isatty() else 200, highlight=False, markup=False)
    overview, note = _overview(args.tracking_uri, runs_dir)
    if note is not None:
        print(note, file=sys.stderr)
    found = survey(runs_dir, overview)
    _show(found.removable, runs_dir, console)
    for reason in dict.fromkeys(reason for _, reason in found.kept):
        runs = [str(run.relative_to(runs_dir)) for run, given in found.kept if given == reason]
        more = f" and {len(runs) - 1} more" * (len(runs) > 1)
        console.print(f"kept: {runs[0]}{more}: {reason}", soft_wrap=True)
    if not found.removable:
        print("nothing to remove")
    elif args.apply:
        gone = [item for item in found.removable if remove(item)]
        print(f"removed {_bytes(total(gone))}")
        for item in found.removable:
            if item not in gone:
                print(f"kept: {item.run.relative_to(runs_dir)}: a training or a clone has begun meanwhile")
    else:
        print("--apply removes it")
    return 0


def _overview(uri: str | None, runs_dir: Path) -> "tuple[Overview | None, str | None]":
    """Ask MLflow if there is one; return what it knows, or what its silence means."""
    from deepracer_exp.errors import BadInput
    from deepracer_exp.tracking.lookup import has_store
    from deepracer_exp.tracking.overview import look_over
    from deepracer_exp.tracking.store import resolve_store

    if not has_store(uri, runs_dir):
        return None, None
    resolve_store(uri, runs_dir)  # what can never work is no silence
    try:
        return look_over(uri, runs_dir), None
    except BadInput as error:
        return None, f"{error}; runs deleted there, and checkpoints of runs recorded there, are left out"


def _show(items: "Sequence[Removable]", runs_dir: Path, console: "Console") -> None:
    from rich.table import Table

    from deepracer_exp.tracking.cleaning import CHECKPOINTS, DELETED, TRACE, total

    if not items:
        return
    table = Table("size", "what", "run", box=None, pad_edge=False)
    table.columns[0].justify = "right"
    for item in items:
        what = f"{item.what}: {_names(item)}" if item.what == CHECKPOINTS else item.what
        table.add_row(_bytes(item.size), what, str(item.run.relative_to(runs_dir)))
    table.add_row()
    for kind in (CHECKPOINTS, TRACE, DELETED):
        of_kind = [item for item in items if item.what == kind]
        if of_kind:
            table.add_row(
                _bytes(total(of_kind)), kind, f"{len(of_kind)} runs" if len(of_kind) > 1 else "1 run"
            )
    table.add_row(_bytes(total(items)), "in all", "")
    console.print(table)
    console.print()


def _names(item: "Removable") -> str:
    names = [path.name for path in item.paths]
    return ", ".join(names) if len(names) <= 4 else f"{names[0]} to {names[-1]} ({len(names)})"


def _bytes(size: int) -> str:
    from rich.filesize import decimal

    return decimal(size)
