"""`deepracer-exp runs lineage`: a run's family tree."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .arguments import read_stores, run_and_overrides
from .output import table_console

if TYPE_CHECKING:
    from rich.text import Text

    from deepracer_exp.runs.lineage import Member

_MOST_CHANGES = 6


def show_lineage(args: argparse.Namespace) -> int:
    """Print the tree of a run's parents and clones, and the best run of each generation."""
    from rich.table import Table
    from rich.tree import Tree

    from deepracer_exp.runs.lineage import best_members, family, generations
    from deepracer_exp.runs.resolve import resolve

    name, overrides = run_and_overrides(args)
    stores = read_stores(overrides)
    run = resolve(name, stores.runs_dir, stores.uri).path
    root = family(run, stores.runs_dir)
    best = best_members(root)

    def grow(member: "Member", tree: Tree) -> Tree:
        for child in member.children:
            grow(child, tree.add(_label(child, run, best)))
        return tree

    console = table_console()
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
    """Return two lines: what the run is and achieved, and what it changed."""
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
    facts += _result(member)
    label.append("\n" + ", ".join(facts), style="not reverse not bold")
    changes = [f"{key} {_value(old)} -> {_value(new)}" for key, (old, new) in member.changes.items()]
    if len(changes) > _MOST_CHANGES:
        changes[_MOST_CHANGES:] = [f"and {len(changes) - _MOST_CHANGES} more"]
    if changes:
        label.append("\n" + ", ".join(changes), style="not reverse not bold dim")
    return label


def _result(member: "Member") -> list[str]:
    if member.record is None:
        return ["missing: its folder was removed"]
    status = member.record.summary.get("status", "running or killed")
    facts = [] if status == "finished" else [str(status)]
    if member.result is not None:
        facts.append(member.result.words())
    return facts


def _value(value: object) -> str:
    from deepracer_exp.analysis.comparison import value_text

    return f"{value:g}" if isinstance(value, float) else value_text(value, 32)
