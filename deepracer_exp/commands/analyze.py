"""`deepracer-exp analyze` and `compare`: how a training went, from its logs, and how far from them a simulation is."""

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepracer_exp.errors import BadInput, count, reading, writing
from deepracer_exp.files import LOG_BYTES, open_user_file
from deepracer_exp.runs.files import REPORT, is_run

from .arguments import (
    Stores,
    add_command,
    add_overrides,
    add_run,
    complete_runs,
    is_override,
    read_stores,
    runs_and_overrides,
)
from .output import table_console, warnings_on_stderr
from .replay import add_replay, check_replay, write_laps
from .startup import check_policy

if TYPE_CHECKING:
    from deepracer_exp.analysis.log_view import LogView
    from deepracer_exp.analysis.page import Glimpse
    from deepracer_exp.config.car import CarConfig

_ANALYZE_EPILOG = """\
  deepracer-exp analyze RUN                                 one of our runs
  deepracer-exp analyze ~/Downloads/training.tar.gz         logs of the service, the console or deepracer-for-cloud:
                                                            a folder, an archive or a file of any layout
  deepracer-exp analyze RUN --compare RUN logs/             compare how it and others learned
  deepracer-exp analyze RUN --reward racing_line            what another reward function would have paid for
  deepracer-exp analyze RUN --target 9.5 --open             the chance of a lap under 9.5 s; open the page
  deepracer-exp analyze RUN --compare logs/ --replay laps.html
                                                            the fastest lap of each, driven beside each other
  deepracer-exp analyze RUN --line line.py                  the line of its fastest exploring lap, for a reward function

The page needs no network: the outcome and the next steps, findings in words, figures and tables, and what could not be
read and why.
"""
_COMPARE_EPILOG = """\
  deepracer-exp compare RUN ~/Downloads/evaluation.tar.gz   our laps beside those of the service's evaluation
  deepracer-exp compare RUN logs/ checkpoint=last --open    another checkpoint; open the page

LOGS is a folder, an archive or a file of any layout, as `deepracer-exp analyze` takes. The policy races on the log's
track, in its direction, from the same starts, as many laps in a row. `deepracer-exp runs compare` compares runs.
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the commands."""
    parser = add_command(
        commands,
        "analyze",
        _analyze,
        help="find out from logs how a training went",
        description="Read the logs of a training, ours or the service's of any year, print the findings, and write a "
        "page of figures.",
        epilog=_ANALYZE_EPILOG,
        runs_rewards=True,
    )
    what = parser.add_argument("what", nargs="?", metavar="RUN | LOGS", help="a run, or logs of the service")
    what.completer = complete_runs  # type: ignore[attr-defined]
    add_overrides(parser, "runs_dir=DIR | tracking.uri=URI")
    parser.add_argument(
        "--compare",
        nargs="+",
        action="extend",
        default=[],
        metavar="RUN | LOGS",
        help="runs or logs to compare it with",
    )
    parser.add_argument(
        "--reward",
        metavar="NAME | FILE",
        help="reward function, of the zoo or a file, to replay on its steps",
    )
    parser.add_argument("--target", metavar="S", help="lap time in seconds: how likely is a lap below it?")
    add_replay(parser, "its fastest exploring lap and that of the first of --compare, or an ordinary one")
    parser.add_argument(
        "--line",
        metavar="FILE",
        help="write the line of its fastest exploring lap (.csv, .npy, or .py: a Python list)",
    )
    parser.add_argument("--lap", metavar="EPISODE", help="the lap of --line: a complete episode of the log")
    _add_page(parser, "report.html of a run, else NAME-analysis.html")

    parser = add_command(
        commands,
        "compare",
        _compare,
        help="put simulated laps of a policy beside the service's log of it",
        description="Race a run's best policy as the laps of a log were driven, print lap times, line, actions and "
        "where they differ most, and write a page of figures.",
        epilog=_COMPARE_EPILOG,
        entry="evaluate",
    )
    add_run(parser, "checkpoint=NAME | runs_dir=DIR | tracking.uri=URI", many=True)
    parser.usage = "%(prog)s [-h] [--open] [--track NAME | ROUTE] [-o FILE] RUN LOGS [KEY=VALUE ...]"
    _add_page(parser, "NAME-comparison.html")


def _add_page(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.add_argument(
        "--track",
        metavar="NAME | ROUTE",
        help="one of several tracks; or, of a track that the log does not name, its name or file (.npy, .yaml)",
    )
    parser.add_argument("-o", "--output", metavar="FILE", help=f"page to write (default: {default})")


def _analyze(args: argparse.Namespace) -> int:
    from deepracer_exp.analysis.line_file import check_line_file, recorded_line, write_line

    target_s = None if args.target is None else _seconds(args.target)

    # `--compare RUN LOGS runs_dir=DIR` takes all three words.
    words = [word for word in (args.what, *args.overrides) if word is not None]
    stores = read_stores(word for word in [*words, *args.compare] if is_override(word))
    logs = [word for word in words if not is_override(word)]
    if len(logs) != 1:
        raise BadInput(
            f"{' '.join(logs) or 'RUN'}: {len(logs)} runs or logs given; accepted: one, and others after --compare"
        )
    place = _place(logs[0], stores)
    beside = [_place(what, stores) for what in args.compare if not is_override(what)]
    _check_output(args.output)
    check_replay(args.replay)
    check_line_file(args.line)
    episode = None if args.lap is None else _episode(args.lap, args.line)
    reward = None
    if args.reward is not None:
        from deepracer_exp.rewards.source import named_reward_source

        reward = named_reward_source(args.reward)

    from deepracer_exp.analysis.findings import findings
    from deepracer_exp.analysis.lap_replay import laps_of_log
    from deepracer_exp.analysis.log_report import LogPage, write_page
    from deepracer_exp.analysis.log_tables import headline, trainings
    from deepracer_exp.analysis.log_view import prepare
    from deepracer_exp.analysis.reward_replay import replay_reward
    from deepracer_exp.analysis.reward_terms import run_terms
    from deepracer_exp.runs.files import read_config, sees_pictures
    from deepracer_exp.runs.own_recording import is_own_run, read_log

    recording = read_log(place)
    try:
        config = read_config(place) if is_own_run(place) else {}
    except BadInput:  # the page lists which files could not be read
        config = {}
    car = _car(config)
    view, terms = run_terms(prepare(recording, args.track), car)
    line = None if args.line is None else recorded_line(view, episode)
    strip: list[Glimpse] = []
    if sees_pictures(config):
        from deepracer_exp.evaluation.sight import run_glimpses

        view, strip = run_glimpses(view, place)
    others, rival = [], None
    for other in beside:
        compared = prepare(read_log(other))
        rival = rival or compared
        others.append(_light(compared))
    laps = None if args.replay is None else laps_of_log(view, rival)
    replay = None if reward is None else replay_reward(view, reward, car)
    default = place / REPORT if is_own_run(place) else _page("analysis", recording.name)
    out = Path(args.output or default)
    found = findings(view, target_s)
    with writing(f"--output {out}", "a file in a folder"):
        write_page(out, LogPage(view, found, others, replay, terms, strip))
    if laps is not None:
        write_laps(args.replay, laps)
    if line is not None:
        with writing(f"--line {args.line}"):
            write_line(Path(args.line), line[0])

    print(f"{view.name}: {headline(view)}")
    several = trainings(view)
    if several is not None:
        print(f"     trainings in it: {several}. One alone: give its files in a folder of their own")
    for number, one in enumerate(found, 1):
        print(f"{number:3d}  {one.sentence}")
    for sentence in replay.sentences if replay is not None else ():
        print(f"     {sentence}")
    if view.problems:
        print(f"\n  {count(len(view.problems), 'problem')} while reading, the first: {view.problems[0]}")
    _end(out, args.open)
    if args.replay is not None:
        print(f"  laps  {args.replay}")
    if line is not None:
        print(f"  line  {args.line} ({line[1]})")
    return 0


def _compare(args: argparse.Namespace) -> int:
    from deepracer_exp.config.own_class import allow_given

    given, overrides = runs_and_overrides(args)
    stores = read_stores(allow_given(overrides), ["checkpoint"])
    if len(given) != 2:
        raise BadInput(
            f"{' '.join(given) or 'RUN LOGS'}: {len(given)} given; accepted: a run, and logs of the service"
        )
    name, logs = given
    _check_output(args.output)
    chosen = stores.values.get("checkpoint")
    place = existing_logs(logs)
    if place is None and not is_run(Path(name)) and existing_logs(name) is not None:
        raise BadInput(f"{name}: is no run; write {shlex.join(['deepracer-exp', 'compare', logs, name])}")
    if place is None or is_run(place):
        why = "no such file or folder" if place is None else "is a run"
        runs = shlex.join(["deepracer-exp", "runs", "compare", name, logs])
        raise BadInput(f"{logs}: {why}; accepted: logs of the service; {runs} compares runs")
    run = check_policy(name, str(stores.runs_dir), stores.uri, chosen)

    from deepracer_exp.analysis.against_log import prepare_races, write_against_log
    from deepracer_exp.deepracer.recording_reader import read_recording

    view = prepare_races(read_recording(place), args.track)

    from rich.console import Console
    from rich.table import Table

    from deepracer_exp.evaluation.against_log import race_against_log

    with warnings_on_stderr():
        both = race_against_log(run, chosen, view, args.track, Console(stderr=True, highlight=False))
    out = Path(args.output or _page("comparison", view.name))
    with writing(f"--output {out}", "a file in a folder"):
        write_against_log(out, run.path.name, both, view)

    console, texts = table_console(), both.texts
    table = Table(box=None, pad_edge=False)
    for number, head in enumerate(texts.heads):
        table.add_column(head, justify="right" if number else "left")
    for row in texts.rows:
        table.add_row(*row)
    console.print(f"log        {view.name}: {both.logged.words}", soft_wrap=True)
    console.print(f"simulated  {run.path.name}: {both.simulated.words}\n", soft_wrap=True)
    console.print(table)
    console.print()
    for sentence in both.sentences:
        console.print(sentence, soft_wrap=not console.is_terminal)
    _end(out, args.open)
    return 0


def _check_output(output: str | None) -> None:
    if output is not None and not Path(output).absolute().parent.is_dir():
        raise BadInput(f"--output {output}: its folder does not exist; accepted: a file in a folder")


def _end(page: Path, is_opened: bool) -> None:
    """Print where the page is, and open it."""
    print(f"\n  page  {page}")
    if is_opened:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())


def existing_logs(what: str) -> Path | None:
    """Return an existing file or folder, None if there is none.

    Raises:
        BadInput: it is "", or cannot be read.
    """
    if not what.strip():
        raise BadInput(f"{what!r}: names nothing; accepted: logs of the service, or a run")
    with reading(what, "logs of the service, or a run"):
        path = Path(what).expanduser()
        if not path.exists():
            return None
        if not path.is_dir():
            open_user_file(path, "logs of the service, or a run", LOG_BYTES).close()
        return path


def _place(what: str, stores: Stores) -> Path:
    """Return the file or folder of logs, or the folder of a run.

    Raises:
        BadInput: there is none, or the name of a run is ambiguous.
    """
    path = existing_logs(what)
    if path is not None:
        return path
    from deepracer_exp.runs.resolve import resolve

    try:
        return resolve(what, stores.runs_dir, stores.uri).path
    except BadInput as error:
        why = str(error).removeprefix(f"{what}: ")
        raise BadInput(f"{what}: no such file or folder, and no run: {why}") from None


def _car(config: dict[str, Any]) -> "CarConfig":
    """Return the car of a run of ours; the service's has the dimensions of the default one."""
    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.config.parse import parse_experiment

    try:
        return parse_experiment(config).car if config else compose_experiment([])[0].car
    except BadInput:  # another version, whose cars had the same dimensions
        return compose_experiment([])[0].car


def _light(view: "LogView") -> "LogView":
    """Return a view without the steps of its training: a comparison shows iterations and races only."""
    from dataclasses import replace

    steps = view.recording.steps
    recording = replace(view.recording, steps=steps[steps["stream"] != "training"].copy())
    return replace(view, steps=view.steps.iloc[:0].copy(), recording=recording)


def _page(kind: str, name: str) -> Path:
    safe = "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in name).strip("-.")
    return Path(f"{safe[:80] or 'log'}-{kind}.html")


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
