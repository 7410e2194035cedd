"""`deepracer-exp lineage`: a run's family tree."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.text import Text

    from deepracer_exp.analysis.family import Member

_MOST_CHANGES = 6
_EPILOG = """\
  deepracer-exp lineage RUN                                 RUN: a run's folder, its name or the beginning of it,
                                                            MLflow's id, best:EXPERIMENT, MODEL@ALIAS or ALIAS
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    lineage = commands.add_parser(
        "lineage",
        help="show a run's family tree",
        description="Show what a run was cloned from and what was cloned from it, what each clone changed and what "
        "came of it, and the best of each generation. Reads the runs' folders alone.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    lineage.add_argument("run", metavar="RUN", help="any run of the family")
    lineage.add_argument("--runs-dir", default="runs", help="where the family is (default: runs)")
    lineage.add_argument(
        "--tracking-uri", help="MLflow store of ids and aliases (default: the one in --runs-dir)"
    )
    lineage.set_defaults(command=_lineage)


def _lineage(args: argparse.Namespace) -> int:
    import sys

    from rich.console import Console
    from rich.table import Table
    from rich.tree import Tree

    from deepracer_exp.analysis.family import best_members, family, generations
    from deepracer_exp.evaluation.references import resolve

    runs_dir = Path(args.runs_dir)
    run = resolve(args.run, runs_dir, args.tracking_uri).path
    root = family(run, runs_dir)
    best = best_members(root)

    def grow(member: "Member", tree: Tree) -> Tree:
        for child in member.children:
            grow(child, tree.add(_label(child, run, best)))
        return tree

    # A pipe has no width of its own.
    console = Console(width=None if sys.stdout.isatty() else 200, highlight=False, markup=False)
    table = Table(box=None, show_header=False, pad_edge=False)
    fastest = generations(root)
    courses = len({member.course for _, member, _ in fastest}) > 1
    for generation, member, result in fastest:
        course = [member.course] if courses else []
        table.add_row(f"generation {generation}", *course, result.words(), member.name)
    with console.capture() as drawn:
        console.print(grow(root, Tree(_label(root, run, best))))
        if fastest:
            table.columns[-1].overflow = "fold"
            console.print("", table, sep="\n")
    # Rich fills lines up to the width.
    print("\n".join(line.rstrip() for line in drawn.get().splitlines()))
    return 0


def _label(member: "Member", run: Path, best: dict[int, str]) -> "Text":
    """Return two lines: what it is and came to, and what it changed."""
    from rich.text import Text

    asked_for = member.path == run.resolve()
    label = Text(member.name, style="bold reverse" if asked_for else "bold" if member.record else "dim")
    if asked_for:
        label.append("  <- this run", style="not reverse bold")
    if id(member) in best:
        label.append(f"  * {best[id(member)]}", style="not reverse bold green")
    facts = [f"generation {member.generation}"]
    if member.lineage is not None:
        facts.append(f"from {member.lineage.checkpoint}")
    if member.lineage is not None and member.lineage.registered is not None:
        facts.append(member.lineage.registered)
    facts += _came_to(member)
    label.append("\n" + ", ".join(facts), style="not reverse not bold")
    changes = [f"{key} {_value(old)} -> {_value(new)}" for key, (old, new) in member.changes.items()]
    if len(changes) > _MOST_CHANGES:
        changes[_MOST_CHANGES:] = [f"and {len(changes) - _MOST_CHANGES} more"]
    if changes:
        label.append("\n" + ", ".join(changes), style="not reverse not bold dim")
    return label


def _came_to(member: "Member") -> list[str]:
    if member.record is None:
        return ["missing: its folder is gone"]
    status = member.record.summary.get("status", "running, or was killed")
    facts = [] if status == "finished" else [str(status)]
    if member.result is not None:
        facts.append(member.result.words())
    return facts


def _value(value: object) -> str:
    from deepracer_exp.analysis.comparison import value_text

    return f"{value:g}" if isinstance(value, float) else value_text(value, 32)
