"""`deepracer-exp runs`: list runs, show their lineage, promote and clean them; and `ui`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, count
from deepracer_exp.runs.run_files import full_name

from .arguments import (
    STORES_METAVAR,
    add_command,
    add_overrides,
    add_run,
    is_override,
    port,
    read_stores,
    run_and_overrides,
)
from .output import table_console
from .runs_edit import add_edits
from .runs_list import LIST, add_list

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from deepracer_exp.runs.clean import Removable, StoreOverview
    from deepracer_exp.runs.lineage import FamilyMember

_MOST_CHANGES = 6
"""Changes of a clone that its lineage shows."""
_LINEAGE_COLUMNS = 120
"""Width of a family tree where there is no terminal."""
_EPILOG = """\
  deepracer-exp runs                                        list the runs, newest first
  deepracer-exp runs lineage RUN
  deepracer-exp runs promote RUN                            its best checkpoint, as EXPERIMENT@champion
  deepracer-exp runs promote best:default --alias rain      the best run of an experiment
  deepracer-exp runs promote RUN checkpoint=120 --model season
  deepracer-exp evaluate champion                           from then on; export and clone accept it, too
  deepracer-exp runs send                                   record in MLflow what it lacks of ended runs
  deepracer-exp runs list --where 'score_s<12' --sort score_s --format csv
  deepracer-exp runs rename RUN blue-car                    from then on blue-car means this run
  deepracer-exp runs note RUN "new tyres"
  deepracer-exp runs tag RUN car=blue checked=
  deepracer-exp runs delete RUN
  deepracer-exp runs clean --apply

All of them accept runs_dir=DIR (default: runs) and tracking.uri=URI (default: the MLflow store in runs_dir).
"""
_CLEAN_EPILOG = """\
What can be removed:
  - checkpoints that are neither best, last nor the fastest reliable one
  - the traces of failed runs
  - the folders of runs that were deleted in MLflow
  - with --traces, the traces of finished runs, or all but the newest tenth of their iterations; analyze, report and
    watch then know only what is left, and results, checkpoints and pages stay
  - with --replays, the replays of SAC runs that have ended; such a run cannot resume, and can be cloned as before

What is never removed: checkpoints that are registered (deepracer-exp runs promote), pinned or cloned from, and runs
that have one; runs in progress; files and folders that no training wrote, and whatever links point at.
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the family of commands, and `ui`."""
    family = commands.add_parser(
        "runs",
        help="list, label, promote and clean runs",
        description="List runs with their state, score, laps and age; show their lineage, register and clean them. "
        "`deepracer-exp compare` compares them.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = family.add_subparsers(metavar="ACTION", required=True)

    add_list(actions)

    lineage = add_command(
        actions,
        "lineage",
        _lineage,
        entry=None,
        help="show a run's family tree",
        description="Show what a run was cloned from and its clones, what each clone changed and achieved, and the "
        "best of each generation. Reads only the folders of the runs.",
    )
    add_run(lineage, STORES_METAVAR)

    promote = add_command(
        actions,
        "promote",
        _promote,
        entry=None,
        help="register a checkpoint under an alias",
        description="Register a checkpoint as a version of a model in MLflow and give it an alias, by which evaluate, "
        "export and clone find it. From then on nothing removes it from the run's folder.",
    )
    add_run(promote, f"checkpoint=best|last|fastest|N | {STORES_METAVAR}")
    promote.add_argument("--model", help="name of the model (default: the experiment's)")
    promote.add_argument(
        "--alias",
        default="champion",
        help="alias for it, taken from the version that has it (default: champion)",
    )

    add_edits(actions)

    clean = add_command(
        actions,
        "clean",
        _clean,
        entry=None,
        help="list what can be removed, or remove it",
        description="List what can be removed from the folders of the runs, with sizes; with --apply, remove it.",
        epilog=_CLEAN_EPILOG,
    )
    add_overrides(clean, STORES_METAVAR)
    clean.add_argument("--apply", action="store_true", help="remove what is listed")
    clean.add_argument(
        "--traces",
        choices=("thin", "drop"),
        help="list the traces of finished runs, too: all but the newest tenth of their iterations, or all",
    )
    clean.add_argument(
        "--replays",
        action="store_true",
        help="list the replays of SAC runs that have ended, too: without its replay a run cannot resume",
    )

    ui = add_command(
        commands,
        "ui",
        _ui,
        entry=None,
        help="open the MLflow pages of the recorded runs",
        description="Serve the MLflow pages of the project's runs on 127.0.0.1 until Ctrl-C.",
    )
    add_overrides(ui, STORES_METAVAR)
    ui.add_argument("--port", type=port, default=5000, help="port of the pages (default: 5000)")


def with_default_action(arguments: list[str]) -> list[str]:
    """Return the arguments of a command line in which `runs` without an action means `runs list`."""
    flag = len(arguments) > 1 and arguments[1].startswith("-") and arguments[1] not in ("-h", "--help")
    if arguments[:1] == ["runs"] and (len(arguments) == 1 or flag or is_override(arguments[1])):
        return ["runs", LIST, *arguments[1:]]
    return arguments


def _lineage(args: argparse.Namespace) -> int:
    from rich.padding import Padding
    from rich.tree import Tree

    from deepracer_exp.runs.lineage import best_by_generation, best_members, family

    name, overrides = run_and_overrides(args)
    stores = read_stores(overrides)
    run = stores.find(name).path
    root = family(run, stores.runs_dir)
    best = best_members(root)

    def grow(member: "FamilyMember", tree: Tree) -> Tree:
        for child in member.children:
            grow(child, tree.add(_label(child, run, best)))
        return tree

    console = table_console(_LINEAGE_COLUMNS)
    fastest = best_by_generation(root)
    courses = len({member.course for _, member, _ in fastest}) > 1
    with console.capture() as drawn:
        console.print(grow(root, Tree(_label(root, run, best))))
        if fastest:
            console.print()
        for generation, member, result in fastest:
            course = f" on {member.course}" * courses
            console.print(
                f"best of generation {generation}{course}: {full_name(member.path)}", soft_wrap=True
            )
            console.print(Padding(result.words(), (0, 0, 0, 2)))
    # Rich fills lines up to the width.
    console.file.write("".join(f"{line.rstrip()}\n" for line in drawn.get().splitlines()))
    return 0


def _label(member: "FamilyMember", run: Path, best: dict[int, str]) -> "Text":
    """Return lines on a run: its name, origin, result, and changed values."""
    from rich.text import Text

    from deepracer_exp.reports.tables.comparison import value_text
    from deepracer_exp.runs.checkpoint_files import checkpoint_words

    asked_for = member.path == run.resolve()
    label = Text(
        full_name(member.path), style="bold reverse" if asked_for else "bold" if member.record else "dim"
    )
    if asked_for:
        label.append("  <- this run", style="not reverse bold")
    if id(member) in best:
        label.append(f"  * {best[id(member)]}", style="not reverse bold green")
    facts = [f"generation {member.generation}"]
    if member.lineage is not None:
        facts += [
            f"from {checkpoint_words(member.lineage.checkpoint)}",
            *filter(None, [member.lineage.registered]),
        ]
    if member.record is None:
        facts.append("missing: its folder was removed")
    elif (status := member.record.summary.get("status", "running or killed")) != "finished":
        facts.append(str(status))
    label.append("\n" + ", ".join(facts), style="not reverse not bold")
    if member.result is not None:
        label.append("\n" + member.result.words(), style="not reverse not bold")
    texts = [
        [f"{value:g}" if isinstance(value, float) else value_text(value, 32) for value in both]
        for both in member.changes.values()
    ]
    changes = [f"{key} {old} -> {new}" for key, (old, new) in zip(member.changes, texts, strict=True)]
    if len(changes) > _MOST_CHANGES:
        changes[_MOST_CHANGES:] = [f"and {len(changes) - _MOST_CHANGES} more"]
    if changes:
        label.append("\n" + ", ".join(changes), style="not reverse not bold dim")
    return label


def _promote(args: argparse.Namespace) -> int:
    from deepracer_exp.config.driving import ObservationConfig
    from deepracer_exp.config.own_class import OF_POLICY, allow_given
    from deepracer_exp.config.parse import parse_config
    from deepracer_exp.runs.checkpoint_files import find_checkpoint
    from deepracer_exp.runs.next_steps import command_line
    from deepracer_exp.runs.run_files import read_config
    from deepracer_exp.tracking.registry import check_alias, check_model, promote

    name, overrides = run_and_overrides(args)
    stores = read_stores(allow_given(overrides), ["checkpoint"])
    check_alias("--alias", args.alias)
    if args.model is not None:
        check_model("--model", args.model)
    run = stores.find(name)
    checkpoint = stores.values.get("checkpoint") or run.checkpoint or "best"
    find_checkpoint(run.checkpoints, checkpoint)

    from deepracer_exp.env.observation import feature_names, observation_shape

    config = read_config(run.path)
    observation = parse_config(config.get("observation", {}), ObservationConfig)
    registered = promote(
        run.path,
        checkpoint,
        args.model or run.path.resolve().parent.name,
        args.alias,
        feature_names(observation),
        observation_shape(observation).seen,
        stores.uri,
        stores.runs_dir,
    )
    print(f"{registered}: version {registered.version}")
    print(f"  run         {run.path}")
    print(f"  checkpoint  {int(registered.checkpoint)}, sha256 {registered.sha256[:12]}")
    print(f"\n  race it     {command_line('evaluate', str(registered), config, OF_POLICY)}")
    return 0


def _clean(args: argparse.Namespace) -> int:
    from rich.filesize import decimal

    from deepracer_exp.runs.clean import DROP, THIN, asked_traces, remove, replays, survey, total_bytes

    stores = read_stores(args.overrides)
    runs_dir = stores.runs_dir
    if not runs_dir.is_dir():
        raise BadInput(f"runs_dir={runs_dir}: is not a folder; accepted: the folder that trainings write to")
    console = table_console()
    overview, note = _overview(stores.uri, runs_dir)
    if note is not None:
        print(note, file=sys.stderr)
    clutter = survey(runs_dir, overview)
    traces, of_replays = asked_traces(clutter.offered, DROP), replays(clutter.offered)
    removable = [*clutter.removable, *asked_traces(clutter.offered, args.traces), *of_replays * args.replays]
    _show_removable(removable, runs_dir, console)
    for reason in dict.fromkeys(reason for _, reason in clutter.kept):
        runs = [str(run.relative_to(runs_dir)) for run, why in clutter.kept if why == reason]
        more = f" and {len(runs) - 1} more" * (len(runs) > 1)
        console.print(f"kept: {runs[0]}{more}: {reason}", soft_wrap=True)
    if args.traces is None and traces:
        short = asked_traces(clutter.offered, THIN)
        print(
            f"offered: the traces of {count(len(traces), 'finished run')}: --traces drop removes "
            f"{decimal(total_bytes(traces))}, --traces thin {decimal(total_bytes(short))}"
        )
    if of_replays and not args.replays:
        print(
            f"offered: the replays of {count(len(of_replays), 'SAC run')} that will not resume: --replays removes "
            f"{decimal(total_bytes(of_replays))}"
        )
    if not removable:
        print("nothing to remove")
    elif args.apply:
        removed = [item for item in removable if remove(item)]
        print(f"removed {decimal(total_bytes(removed))}")
        for item in removable:
            if item not in removed:
                print(f"kept: {item.run.relative_to(runs_dir)}: a training or a clone has started meanwhile")
    else:
        print("--apply removes it")
    return 0


def _overview(uri: str | None, runs_dir: Path) -> "tuple[StoreOverview | None, str | None]":
    """Query MLflow if there is a store; return its overview, or a note on what is skipped without an answer."""
    from deepracer_exp.tracking.registry import read_overview
    from deepracer_exp.tracking.store import existing_store, has_store

    if not has_store(uri, runs_dir):
        return None, None
    existing_store(uri, runs_dir)  # an unusable address is bad input, not a store that does not answer
    try:
        return read_overview(uri, runs_dir), None
    except BadInput as error:
        return None, f"{error}; runs deleted there, and checkpoints of runs recorded there, are left out"


def _show_removable(items: "Sequence[Removable]", runs_dir: Path, console: "Console") -> None:
    from rich.filesize import decimal
    from rich.table import Table

    from deepracer_exp.runs.checkpoint_files import checkpoint_number
    from deepracer_exp.runs.clean import SPARE_CHECKPOINTS, total_bytes

    if not items:
        return
    table = Table("size", "what", "run", box=None, pad_edge=False)
    table.columns[0].justify = "right"
    for item in items:
        what, names = item.what, [checkpoint_number(path.name) for path in item.paths]
        if what == SPARE_CHECKPOINTS:
            shown = ", ".join(names) if len(names) <= 4 else f"{names[0]} to {names[-1]} ({len(names)})"
            what += f": {shown}"
        table.add_row(decimal(item.size), what, str(item.run.relative_to(runs_dir)))
    table.add_row()
    table.add_row(decimal(total_bytes(items)), "in all", "")
    console.print(table)
    console.print()


def _ui(args: argparse.Namespace) -> int:
    stores = read_stores(args.overrides)

    from deepracer_exp.tracking.ui import serve_ui

    serve_ui(stores.runs_dir, stores.uri, args.port, lambda line: print(line, flush=True))
    return 0
