"""`deepracer-exp compare` with logs: how recordings learned, and a policy raced as a log was driven."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import writing
from deepracer_exp.runs.files import TRACE

from .arguments import Stores
from .output import print_table, table_console, warnings_on_stderr
from .pages import Item, end_with_page, light, page_name, write_comparison_page, write_laps

if TYPE_CHECKING:
    from deepracer_exp.analysis.log_view import LogView

CHECKPOINT = "checkpoint"
"""Key of the policy that races."""


def compare_recordings(args: argparse.Namespace, items: Sequence[Item]) -> int:
    """Compare how logs, and runs among them, learned."""
    from deepracer_exp.analysis.charts.runs import (
        generalisation_matrix,
        generations,
        policy_of,
        recordings_compared,
    )
    from deepracer_exp.analysis.log_tables import Table, headline
    from deepracer_exp.analysis.log_view import prepare
    from deepracer_exp.reports.lap_replay import laps_of_log
    from deepracer_exp.runs.recording import read_log

    named: list[tuple[str | None, LogView]] = []
    whole: list[LogView] = []
    for item in items:
        for path in item.paths:
            view = prepare(read_log(path), args.track)
            whole += [view] * (args.replay is not None)
            named.append((item.group, light(view)))
    views = [view for _, view in named]
    charts = [
        recordings_compared(named),
        generations(views),
        generalisation_matrix(list(map(policy_of, views))),
    ]
    table = Table(("recording", "driven"), tuple((view.name, headline(view)) for view in views), 2)
    notes = ["Logs know the laps of the training only, driven by a policy that explores."]
    out = write_comparison_page(args.output, items, notes, [("Recordings", table, "")], charts)
    if args.replay is not None:
        write_laps(args.replay, laps_of_log(whole[0], whole[1]))
    print_table(table_console(), "Recordings", table)
    print(notes[0])
    end_with_page(out, args.open)
    if args.replay is not None:
        print(f"  laps  {args.replay}")
    return 0


def against_log(args: argparse.Namespace, name: str, place: Path, stores: Stores) -> int:
    """Race a policy as the laps of a log were driven; draw how both learned where the log has a training."""
    run = stores.find(name).with_policy(stores.values.get(CHECKPOINT))

    from deepracer_exp.analysis.charts.runs import recordings_compared
    from deepracer_exp.analysis.log_view import prepare, prepare_races
    from deepracer_exp.aws.logs.reader import read_recording
    from deepracer_exp.reports.against_log import write_against_log
    from deepracer_exp.reports.lap_replay import laps_of_log
    from deepracer_exp.runs.recording import read_log

    recording = read_recording(place)
    view = prepare_races(recording, args.track)

    from rich.console import Console

    from deepracer_exp.reports.driven_against_log import race_against_log

    with warnings_on_stderr():
        both = race_against_log(run, view, args.track, Console(stderr=True, highlight=False))
    learned = None
    if (run.path / TRACE).is_dir() and (args.replay is not None or prepare(recording, args.track).trained):
        views = [prepare(read_log(run.path)), prepare(recording, args.track)]
        learned = recordings_compared([(None, light(one)) for one in views])
        if args.replay is not None:
            write_laps(args.replay, laps_of_log(*views))
    out = Path(args.output or page_name("comparison", view.name))
    with writing(f"--output {out}", "a file in a folder"):
        write_against_log(out, run.path.name, both, view, learned)

    console, texts = table_console(), both.texts
    console.print(f"log        {view.name}: {both.logged.words}", soft_wrap=True)
    console.print(f"simulated  {run.path.name}: {both.simulated.words}\n", soft_wrap=True)
    print_table(console, None, texts)
    for sentence in both.sentences:
        console.print(sentence, soft_wrap=not console.is_terminal)
    end_with_page(out, args.open)
    return 0
