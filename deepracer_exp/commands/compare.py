"""`deepracer-exp compare`: runs, groups of runs over seeds, and logs of the service, beside each other."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, count
from deepracer_exp.runs.run_files import CONFIG, is_run

from .arguments import STORES, STORES_METAVAR, Stores, add_command, add_run, read_stores, runs_and_overrides
from .compare_runs import compare_runs
from .output import check_file, print_table, table_console
from .pages import (
    Item,
    add_page,
    add_replay,
    end_with_page,
    existing_logs,
    find_run,
    light,
    write_comparison_page,
    write_laps,
)

if TYPE_CHECKING:
    from deepracer_exp.reports.tables.log_view import LogView

_EPILOG = """\
  deepracer-exp compare RUN RUN                             how two runs differ, and what each achieved
  deepracer-exp compare season                              all runs of an experiment or study: those that differ only
                                                            in their seed and track are a group
  deepracer-exp compare before after                        two experiments
  deepracer-exp compare old=RUN,RUN,RUN new=RUN,RUN,RUN     groups of your own
  deepracer-exp compare RUN logs/ logs2/ --open             how runs and logs learned; open the page
  deepracer-exp compare RUN RUN --replay laps.html          their fastest laps, driven beside each other
  deepracer-exp compare season --format csv > curves.csv    the learning curves over seeds

Compared are the evaluated policies of the best checkpoints: their lap, completion and race score, and their learning
curves, as interquartile means over seeds with 95% bootstrap intervals. A difference that seeds explain is called that;
it takes at least four runs of each group on a track to show one.

LOGS is a folder, an archive or a file of any layout, as `deepracer-exp analyze` takes.
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = add_command(
        commands,
        "compare",
        _compare,
        help="compare runs, groups of runs over seeds, and logs",
        description="Compare runs, groups of runs over seeds and logs of the service, print how they differ, and "
        "write a page of tables and figures.",
        epilog=_EPILOG,
        entry="evaluate",
    )
    add_run(
        parser,
        f"GROUP=RUN,RUN,... | {STORES_METAVAR}",
        many=True,
    )
    parser.usage = (
        "%(prog)s [-h] [--open] [--track NAME | ROUTE] [-o FILE] [--replay PAGE.html] [--format FORMAT] "
        "RUN | LOGS | EXPERIMENT | STUDY | GROUP=RUN,RUN,... [KEY=VALUE ...]"
    )
    add_page(parser, "NAME-comparison.html")
    add_replay(parser, "the fastest lap of each of two runs or logs")
    parser.add_argument(
        "--format",
        choices=("table", "json", "csv"),
        default="table",
        help="format of the output: json has groups, differences and learning curves, csv the curves",
    )


def _compare(args: argparse.Namespace) -> int:
    from deepracer_exp.config.own_class import allow_given

    words, pairs = runs_and_overrides(args)
    overrides = [pair for pair in pairs if (key := pair.partition("=")[0]) in STORES or "." in key]
    groups = [pair for pair in pairs if pair not in overrides]
    stores = read_stores(allow_given(overrides))
    check_file("--output", args.output)
    check_file("--replay", args.replay, ".html")
    items = [_item(word, None, stores) for word in words]
    for group in groups:
        name, _, members = group.partition("=")
        items += [_item(member, name, stores) for member in members.split(",")]
    logs = [item for item in items if item.is_logs]
    runs = list(dict.fromkeys(path.resolve() for item in items if not item.is_logs for path in item.paths))
    if len(runs) + len(logs) < 2:
        raise BadInput(
            f"{' '.join([*words, *groups]) or 'RUN RUN'}: "
            f"{count(len(runs), 'run')} and {count(len(logs), 'log')}; accepted: two or more that differ, or an "
            "experiment or a study with several runs"
        )
    if args.replay is not None and len(runs) + len(logs) > 2:
        raise BadInput(f"--replay {args.replay}: {len(runs) + len(logs)} runs and logs given; accepted: two")
    if args.track is not None and not logs:
        raise BadInput(f"--track {args.track}", "accepted with logs only", "runs without it")
    if logs and args.format != "table":
        raise BadInput(f"--format {args.format}: accepted with runs only; {logs[0].word} is a log")
    return _compare_recordings(args, items) if logs else compare_runs(args, items)


def _item(word: str, group: str | None, stores: Stores) -> Item:
    """Resolve a word: a run, an experiment or study, or logs."""
    path = existing_logs(word)
    if path is None or not is_run(path):
        folders = [path] if path is not None else []
        if Path(word).name == word:
            folders.append(stores.runs_dir / word)
        for folder in folders:
            if members := sorted(file.parent for file in folder.glob(f"[!.]*/{CONFIG}")):
                return Item(word, group, tuple(members), True)
        if path is not None:
            return Item(word, group, (path,))
    return Item(word, group, (find_run(word, stores).path,))


def _compare_recordings(args: argparse.Namespace, items: Sequence[Item]) -> int:
    """Compare the learning curves of logs, and of runs among them."""
    from deepracer_exp.reports.charts.run_charts import (
        generalisation_matrix,
        generations,
        policy_of,
        recordings_compared,
    )
    from deepracer_exp.reports.pages.lap_replay import laps_of_log
    from deepracer_exp.reports.tables.log_tables import NONE, Table, evaluated_in_training, headline
    from deepracer_exp.reports.tables.log_view import prepare
    from deepracer_exp.runs.recording import read_log

    named: list[tuple[str | None, LogView]] = []
    whole: list[LogView] = []
    rows: list[tuple[str, ...]] = []
    for item in items:
        for path in item.paths:
            view = prepare(read_log(path), args.track)
            whole += [view] * (args.replay is not None)
            rows.append((view.name, headline(view), evaluated_in_training(view) or NONE))
            named.append((item.group, light(view)))
    views = [view for _, view in named]
    charts = [
        recordings_compared(named),
        generations(views),
        generalisation_matrix(list(map(policy_of, views))),
    ]
    table = Table(("recording", "driven", "evaluated in the training, the best"), tuple(rows), 3)
    notes = [
        "A training explores while it drives its laps; an evaluation or a race drives those of the policy itself."
    ]
    out = write_comparison_page(args.output, items, notes, [("Recordings", table, "")], charts)
    if args.replay is not None:
        write_laps(args.replay, laps_of_log(whole[0], whole[1]))
    print_table(table_console(), "Recordings", table)
    print(notes[0])
    end_with_page(out, args.open)
    if args.replay is not None:
        print(f"  laps  {args.replay}")
    return 0
