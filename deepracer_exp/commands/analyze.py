"""`deepracer-exp analyze`: how a training went, from its logs."""

import argparse
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, count, writing
from deepracer_exp.runs.run_files import REPORT

from .arguments import STORES_METAVAR, add_command, add_run, read_stores, runs_and_overrides
from .output import check_file
from .pages import (
    add_page,
    add_replay,
    end_with_page,
    page_name,
    run_or_logs,
    write_laps,
)

if TYPE_CHECKING:
    from deepracer_exp.reports.tables.log_view import LogView

_EPILOG = """\
  deepracer-exp analyze RUN                                 one of our runs
  deepracer-exp analyze ~/Downloads/training.tar.gz         logs of the service, the console or deepracer-for-cloud:
                                                            a folder, an archive or a file of any layout
  deepracer-exp analyze RUN --reward racing_line            the rewards of another function for the same driving
  deepracer-exp analyze RUN --target 9.5 --open             the chance of a lap under 9.5 s; open the page
  deepracer-exp analyze RUN --replay laps.html              its fastest exploring lap beside an ordinary one
  deepracer-exp analyze RUN --line line.py                  the line of its fastest exploring lap, for a reward function

The page needs no network: the outcome and the next steps, findings in words, figures and tables, and what could not be
read and why. With --replay or --line alone no page is written. `deepracer-exp compare` puts runs and logs beside each
other.
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = add_command(
        commands,
        "analyze",
        _analyze,
        entry=None,
        help="find out from logs how a training went",
        description="Read the logs of a training, ours or the service's of any year, print the findings, and write a "
        "page of figures.",
        epilog=_EPILOG,
    )
    add_run(
        parser,
        STORES_METAVAR,
        many=True,
        metavar="RUN | LOGS",
        help="a run, or logs of the service",
    )
    parser.usage = "%(prog)s [-h] [OPTION ...] RUN | LOGS [KEY=VALUE ...]"
    parser.add_argument(
        "--reward",
        metavar="NAME | FILE",
        help="reward function, of the zoo or a file, to replay on its steps",
    )
    parser.add_argument("--target", metavar="S", help="lap time in seconds: how likely is a lap below it?")
    add_replay(parser, "its fastest exploring lap and an ordinary one")
    parser.add_argument(
        "--line",
        metavar="FILE",
        help="write the line of its fastest exploring lap (.csv, .npy, or .py: a Python list)",
    )
    parser.add_argument("--lap", metavar="EPISODE", help="the lap of --line: a complete episode of the log")
    parser.add_argument(
        "--fastest",
        action="store_true",
        help="of a run: find the fastest lap of its car first, so that the page shows what is lost to it",
    )
    add_page(parser, "report.html of a run, else NAME-analysis.html")


def _analyze(args: argparse.Namespace) -> int:
    from deepracer_exp.reports.tables.line_file import check_line_file

    target_s = None if args.target is None else _seconds(args.target)

    logs, overrides = runs_and_overrides(args)
    stores = read_stores(overrides)
    if len(logs) != 1:
        more = "; deepracer-exp compare takes several" * (len(logs) > 1)
        raise BadInput(f"{' '.join(logs) or 'RUN'}: {len(logs)} runs or logs given; accepted: one{more}")
    place = run_or_logs(logs[0], stores)
    check_file("--output", args.output)
    check_file("--replay", args.replay, ".html")
    check_line_file(args.line)
    episode = None if args.lap is None else _episode(args.lap, args.line)
    reward = None
    if args.reward is not None:
        from deepracer_exp.rewards.source import named_reward_source

        reward = named_reward_source(args.reward)

    from deepracer_exp.config.named import service_car
    from deepracer_exp.config.parse import parse_experiment
    from deepracer_exp.reports.findings import findings
    from deepracer_exp.reports.pages.log_report import LogPage, write_log_page
    from deepracer_exp.reports.tables.log_tables import headline, other_tracks, result_in_words, trainings
    from deepracer_exp.reports.tables.log_view import prepare
    from deepracer_exp.reports.tables.reward_replay import replay_reward
    from deepracer_exp.reports.tables.reward_terms import run_terms
    from deepracer_exp.runs.recording import is_traced_run, read_log
    from deepracer_exp.runs.run_files import read_config

    log = read_log(place)
    if _wants_laps_only(args):
        view = prepare(log, args.track)
        written = _write_laps_asked_for(args, view, episode)
        print(f"{view.name}: {headline(view)}\n")
        print(*written, sep="\n")
        return 0
    config, car = {}, service_car()
    if is_traced_run(place):
        # The page lists files that cannot be read; cars of another version had the same dimensions.
        with suppress(BadInput):
            config = read_config(place)
            car = parse_experiment(config).car
    view, terms = run_terms(prepare(log, args.track), car)
    best = None
    if config:
        from deepracer_exp.reports.pages.best_drive import drive_best

        view, best = drive_best(view, place)
    if args.fastest:
        _find_fastest(view, place)
    replay = None if reward is None else replay_reward(view, reward, car)
    default = place / REPORT if is_traced_run(place) else page_name("analysis", view.name)
    out = Path(args.output or default)
    sentences = findings(view, target_s)
    with writing(f"--output {out}", "a file in a folder"):
        write_log_page(out, LogPage(view, sentences, replay, terms, best))

    print(f"{view.name}: {result_in_words(view)}")
    if result_in_words(view) != headline(view):
        print(f"     {headline(view)}")
    several = trainings(view)
    if several is not None:
        print(f"     trainings in it: {several}. One alone: give its files in a folder of their own")
    if elsewhere := other_tracks(view):
        print(f"     not on this page, driven on other tracks: {elsewhere}; --track chooses one")
    for number, finding in enumerate(sentences, 1):
        print(f"{number:3d}  {finding.sentence}")
    for sentence in replay.sentences if replay is not None else ():
        print(f"     {sentence}")
    if view.problems:
        print(f"\n  {count(len(view.problems), 'problem')} while reading, the first: {view.problems[0]}")
    end_with_page(out, args.open)
    for line in _write_laps_asked_for(args, view, episode):
        print(line)
    return 0


def _wants_laps_only(args: argparse.Namespace) -> bool:
    """Return whether only laps are wanted, and no page."""
    shown = args.output is not None or args.open or args.fastest
    return not (shown or args.reward or args.target) and (args.replay is not None or args.line is not None)


def _write_laps_asked_for(args: argparse.Namespace, view: "LogView", episode: int | None) -> list[str]:
    """Write the page of two laps and the line of one, if requested; return their places.

    Raises:
        BadInput: the log has no such lap, or a file cannot be written.
    """
    from deepracer_exp.reports.pages.lap_replay import laps_of_log
    from deepracer_exp.reports.tables.line_file import recorded_line, write_line

    line = None if args.line is None else recorded_line(view, episode)
    written = []
    if args.replay is not None:
        write_laps(args.replay, laps_of_log(view, None))
        written.append(f"  laps  {args.replay}")
    if line is not None:
        with writing(f"--line {args.line}"):
            write_line(Path(args.line), line[0])
        written.append(f"  line  {args.line} ({line[1]})")
    return written


def _episode(lap: str, line: str | None) -> int:
    try:
        episode = int(lap)
    except ValueError:
        episode = -1
    if line is None or episode < 0:
        raise BadInput(f"--lap {lap}: accepted: the number of an episode, beside --line FILE")
    return episode


def _seconds(text: str) -> float:
    import math

    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise BadInput(f"--target {text}: accepted: seconds above 0, such as 9.5")
    return seconds


def _find_fastest(view: "LogView", place: Path) -> None:
    """Search for the fastest lap of a run's car, unless an earlier search has kept it."""
    from deepracer_exp.reports.tables.against_fastest import question_of
    from deepracer_exp.runs.recording import is_traced_run

    from .tracks import search_fastest

    question = question_of(view, place) if is_traced_run(place) else None
    if question is None:
        raise BadInput(
            f"--fastest: {place}: car and track are not known; accepted: a run of ours on one track"
        )
    search_fastest(question.experiment, question.track)
