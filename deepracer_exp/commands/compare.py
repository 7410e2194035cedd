"""`deepracer-exp compare`: runs side by side."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from string import ascii_uppercase
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from deepracer_exp.formats.run_files import RunRecord

_EPILOG = """\
  deepracer-exp compare runs/default/*                      all runs of an experiment
  deepracer-exp compare RUN RUN -o better.png               where the picture goes
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    compare = commands.add_parser(
        "compare",
        help="show runs side by side",
        description="Show in what runs differ and what came of them, and draw their learning curves and lap times.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    compare.add_argument("runs", nargs="+", metavar="RUN", help="a run's folder, name or MLflow id")
    compare.add_argument("-o", "--output", default="compare.png", help="picture (default: compare.png)")
    compare.add_argument("--runs-dir", default="runs", help="where runs given by name are (default: runs)")
    compare.set_defaults(command=_compare)


def _compare(args: argparse.Namespace) -> int:
    import sys

    from rich.console import Console

    from deepracer_exp.errors import BadInput
    from deepracer_exp.evaluation.run import find_run
    from deepracer_exp.formats.run_files import read_run

    folders = dict.fromkeys(find_run(run, Path(args.runs_dir), None) for run in args.runs)
    if not 2 <= len(folders) <= len(ascii_uppercase):
        raise BadInput(f"{len(folders)} runs given; accepted: 2 to {len(ascii_uppercase)} different ones")
    records = [read_run(folder) for folder in folders]
    for record in records:
        if not record.rows:
            raise BadInput(f"{record.path / 'metrics.jsonl'}: has no iteration; there is nothing to compare")

    from deepracer_exp.analysis.comparison_figure import comparison_figure

    figure = comparison_figure(dict(zip(ascii_uppercase, records, strict=False)))
    try:
        figure.savefig(args.output)
    except (OSError, ValueError) as error:
        raise BadInput(f"--output {args.output}: cannot be written: {error}") from error
    # A pipe has no width of its own.
    console = Console(width=None if sys.stdout.isatty() else 200, highlight=False, markup=False)
    for letter, record in zip(ascii_uppercase, records, strict=False):
        console.print(f"{letter}  {record.path}", soft_wrap=True)
    for table in _tables(records):
        console.print()
        console.print(table)
    console.print(f"\n{args.output}: learning curves and lap times", soft_wrap=True)
    return 0


def _tables(records: "Sequence[RunRecord]") -> "list[Table]":
    from rich.table import Table
    from rich.text import Text

    from deepracer_exp.analysis.comparison import differences, results, value_text

    letters = ascii_uppercase[: len(records)]
    found = differences(records)
    chosen = Table("configuration" if found else "configuration: no difference", box=None, pad_edge=False)
    achieved = Table("result", box=None, pad_edge=False)
    for letter in letters:
        if found:
            chosen.add_column(letter, overflow="fold")
        achieved.add_column(letter, overflow="fold", justify="right")
    for key, values in found.items():
        chosen.add_row(key, *map(value_text, values))
    for name, texts, best in results(records):
        achieved.add_row(
            name, *(Text(text, style="bold green" if n == best else "") for n, text in enumerate(texts))
        )
    return [chosen, achieved]
