"""`deepracer-exp compare` of runs, and of groups of runs over seeds."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from string import ascii_uppercase
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, count
from deepracer_exp.runs.run_files import METRICS
from deepracer_exp.runs.run_result import TRAINING_LAPS

from .output import print_table, table_console
from .pages import Item, end_with_page, light, write_comparison_page, write_laps

if TYPE_CHECKING:
    from deepracer_exp.reports.charts.figure import Chart
    from deepracer_exp.reports.tables.groups import RunGroup
    from deepracer_exp.reports.tables.log_tables import Table
    from deepracer_exp.runs.run_files import RunRecord

_RUNS = "Runs"
_MOST_GROUPS = 12
"""Most groups shown, those with the best race score."""
_ACHIEVED = (
    f"Laps, completion and race score are those of the best checkpoint in {TRAINING_LAPS}, which take the most "
    "probable actions."
)
_SCORED = (
    f"Interquartile means over the runs, with 95% intervals: of each run's best checkpoint in {TRAINING_LAPS}, which "
    "take the most probable actions."
)
_DIFFERENCES = (
    "The probability of improvement is that a run of the group is better than one of the other on the same track. A "
    "difference counts if neither interval holds what there would be without one, zero and 50%. On all tracks together "
    "a figure is a share of its mean on each track."
)


def compare_runs(args: argparse.Namespace, items: Sequence[Item]) -> int:
    """Compare runs, and groups of them."""
    from deepracer_exp.reports.tables.group_tables import curves_table, groups_as_json
    from deepracer_exp.reports.tables.groups import compared

    groups = _groups(items)
    records = [record for group in groups for record in group.records]
    if len(records) < 2:
        raise BadInput(
            " ".join(item.word for item in items),
            f"{count(len(records), 'run')} with an iteration",
            "two or more, or an experiment or a study that has them",
        )
    if args.format == "csv":
        curves_table(groups).to_csv(sys.stdout, index=False)
    elif args.format == "json":
        print(json.dumps(groups_as_json(groups, compared(groups)), indent=1))
    if args.format == "table" or args.output is not None:
        _show(args, items, _best(groups), len(groups), records)
    if args.replay is not None:
        from deepracer_exp.runs.stored_run import StoredRun

        stored = [StoredRun(record.path).with_policy() for record in records]

        from deepracer_exp.reports.pages.driven_laps import laps_to_replay

        protocol = stored[0].experiment.evaluation
        (first,) = laps_to_replay(stored[0], protocol)
        write_laps(args.replay, [first, *laps_to_replay(stored[1], protocol, beside=first)])
        if args.format == "table":
            print(f"  laps  {args.replay}: the fastest laps of their best checkpoints")
    return 0


def _groups(items: Sequence[Item]) -> "list[RunGroup]":
    """Return the groups of runs; an experiment among several keeps its name."""
    from deepracer_exp.reports.tables.groups import RunGroup, group_runs
    from deepracer_exp.runs.run_files import read_record

    records: dict[Path, RunRecord] = {}

    def read(path: Path) -> "RunRecord":
        key = path.resolve()
        if key not in records:
            records[key] = read_record(path)
        return records[key]

    several = len({item.word for item in items if item.is_experiment and item.group is None}) > 1
    pools: dict[str, list[tuple[str | None, RunRecord]]] = {}
    for item in items:
        pool = item.word if several and item.is_experiment and item.group is None else ""
        pairs = pools.setdefault(pool, [])
        for path in item.paths:
            # Runs without an iteration do not make an experiment invalid.
            if item.is_experiment and not (path / METRICS).is_file():
                continue
            pair = item.group, read(path)
            if not pair[1].rows:
                if item.is_experiment:
                    continue
                raise BadInput(f"{path / METRICS}: has no iteration; there is nothing to compare")
            if pair not in pairs:
                pairs.append(pair)
    groups: list[RunGroup] = []
    for pool, pairs in pools.items():
        named = group_runs(pairs)
        if pool:
            named = [
                RunGroup(pool if len(named) == 1 else f"{pool}: {group.name}", group.records)
                for group in named
            ]
        groups += named
    return groups


def _best(groups: "list[RunGroup]") -> "list[RunGroup]":
    """Return the groups to show."""
    if len(groups) <= _MOST_GROUPS:
        return groups

    def score_s(group: "RunGroup") -> float:
        estimate = group.estimate("race_score_s")
        return float("inf") if estimate is None else estimate.iqm

    return sorted(groups, key=score_s)[:_MOST_GROUPS]


def _show(
    args: argparse.Namespace,
    items: Sequence[Item],
    groups: "list[RunGroup]",
    of_all: int,
    records: "list[RunRecord]",
) -> None:
    """Print the comparison and write the page."""
    from deepracer_exp.reports.charts.group_charts import best_checkpoints, learning_curve_charts
    from deepracer_exp.reports.charts.run_charts import generalisation_matrix, stored_completion
    from deepracer_exp.reports.tables.group_tables import differences_table, scored, sentences, title_of
    from deepracer_exp.reports.tables.groups import RunGroup, compared, course_of

    single = all(len(group.records) == 1 for group in groups)
    if single:
        letters = dict(zip(ascii_uppercase, groups, strict=False))
        groups = [RunGroup(f"{group.name} ({letter})", group.records) for letter, group in letters.items()]
    differences = compared(groups)
    notes = sentences(groups, differences)
    configuration, *others = _run_tables(groups)
    tables = [configuration]
    if not single:
        tables.append(("Groups", scored(groups), _SCORED))
        if differences:
            tables.append((title_of(differences), differences_table(differences), _DIFFERENCES))
    tables += others
    if of_all > len(groups):
        notes.append(f"{of_all} groups: shown are the {len(groups)} with the best race score.")
    shown = [record for group in groups for record in group.records]
    charts = [
        *learning_curve_charts(groups),
        None if single else best_checkpoints(groups),
        _generations(shown),
        generalisation_matrix(
            [(record.name, course_of(record), stored_completion(record.path)) for record in shown]
        ),
    ]
    out = write_comparison_page(args.output, items, notes, tables, charts)
    if args.format == "table":
        console = table_console()
        for title, table, _ in tables:
            if single or title != _RUNS:  # the page lists the runs of groups
                print_table(console, title, table)
        for sentence in notes:
            console.print(sentence, soft_wrap=not console.is_terminal)
        end_with_page(out, args.open)


def _run_tables(groups: "Sequence[RunGroup]") -> "list[tuple[str, Table, str]]":
    """Return tables of differing settings, of results and of runs.

    With several groups of several runs, settings are those of the groups, and results of single runs are left out.
    """
    from deepracer_exp.reports.tables.comparison import results, value_text
    from deepracer_exp.reports.tables.log_tables import Table
    from deepracer_exp.runs.lineage import run_differences

    records = [record for group in groups for record in group.records]
    if len(groups) > 1 and len(records) > len(groups):
        named = [(group.name, str(record.path)) for group in groups for record in group.records]
        tables = [(_RUNS, Table(("group", "run"), tuple(named), 2), "")]
        heads, records = [group.name for group in groups], [group.records[0] for group in groups]
        ignored = ["seed", "name"]
    else:
        heads, ignored = [*ascii_uppercase[: len(records)]], []
        named = list(zip(heads, (str(record.path) for record in records), strict=False))
        achieved = [(name, *texts) for name, texts, _ in results(records[: len(heads)])]
        tables = [
            ("Results", Table(("", *heads), tuple(achieved), 1), _ACHIEVED),
            (_RUNS, Table(("", "run"), tuple(named), 2), ""),
        ]
    differences = run_differences(records[: len(heads)]).items()
    chosen = [(key, *map(value_text, values)) for key, values in differences if key not in ignored]
    table = Table(("", *heads), tuple(chosen), 1 + len(heads))
    return [("Configuration", table, "" if chosen else "No difference."), *tables]


def _generations(records: "Sequence[RunRecord]") -> "Chart | None":
    """Draw a run and the clones of it on one axis of iterations; None where there are none, or without their traces."""
    from deepracer_exp.reports.charts.run_charts import generations
    from deepracer_exp.reports.tables.log_view import prepare
    from deepracer_exp.runs.lineage import clone_chain
    from deepracer_exp.runs.recording import read_log

    chain = clone_chain([record.path for record in records])
    if not chain:
        return None
    try:
        return generations([light(prepare(read_log(folder))) for folder in chain])
    except BadInput:  # a trace was removed
        return None
