"""`deepracer-exp analyze`: what a training's logs tell, as one page."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, reading
from deepracer_exp.formats.user_file import LOG_BYTES, open_user_file

if TYPE_CHECKING:
    from deepracer_exp.analysis.log_view import LogView

_EPILOG = """\
  deepracer-exp analyze RUN                                 RUN: a run's folder, its name or the beginning of it,
                                                            MLflow's id, best:EXPERIMENT, MODEL@ALIAS or ALIAS
  deepracer-exp analyze ~/Downloads/training.tar.gz         logs of the service, the console or deepracer-for-cloud:
                                                            a folder, an archive or a file, found by looking
  deepracer-exp analyze RUN --compare RUN logs/             others beside it: how each of them learned
  deepracer-exp analyze RUN --reward racing_line            what another reward function would have paid for
  deepracer-exp analyze RUN --target 9.5 --open             the chance of a lap under 9.5 s; open the page

The page needs no network: findings in words first, then figures and tables, then what could not be read and why.
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    analyze = commands.add_parser(
        "analyze",
        help="find out from logs how a training went",
        description="Read the logs of a training, ours or the service's of any year, print what they tell, and write "
        "a page of figures.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    analyze.add_argument("what", metavar="PATH | RUN", help="logs, or a run")
    analyze.add_argument(
        "--compare", nargs="+", action="extend", default=[], metavar="PATH | RUN", help="others beside it"
    )
    analyze.add_argument("--open", action="store_true", help="open the page in the browser")
    analyze.add_argument(
        "--reward", metavar="NAME | FILE", help="of the reward zoo, or a file: replayed on the recorded steps"
    )
    analyze.add_argument("--target", metavar="S", help="lap time in seconds whose chance is told")
    analyze.add_argument(
        "--track",
        metavar="NAME | ROUTE",
        help="of several courses, or the route (.npy) of an unknown one",
    )
    analyze.add_argument(
        "--out", metavar="FILE", help="page to write (default: report.html of a run, else NAME-analysis.html)"
    )
    analyze.add_argument("--runs-dir", default="runs", help="where runs given by name are (default: runs)")
    analyze.add_argument(
        "--tracking-uri", help="MLflow store of ids and aliases (default: the one in --runs-dir)"
    )
    analyze.set_defaults(command=_analyze, runs_rewards=True)


def _analyze(args: argparse.Namespace) -> int:
    target_s = None if args.target is None else _seconds(args.target)

    place = _place(args.what, args)
    beside = [_place(what, args) for what in args.compare]
    if args.out is not None and not Path(args.out).absolute().parent.is_dir():
        raise BadInput(f"--out {args.out}: its folder is not there; accepted: a file in a folder")
    if args.reward is not None:
        from deepracer_exp.env.reward_source import named_reward_source

        named_reward_source(args.reward)

    from deepracer_exp.analysis.findings import findings
    from deepracer_exp.analysis.log_report import LogPage, write_page
    from deepracer_exp.analysis.log_tables import count, headline
    from deepracer_exp.analysis.log_view import prepare
    from deepracer_exp.analysis.reward_comparison import compare_rewards
    from deepracer_exp.evaluation.reward_replay import replay_reward
    from deepracer_exp.evaluation.run_terms import run_terms
    from deepracer_exp.formats.recording_reader import read_recording

    recording = read_recording(place)
    view, terms = run_terms(prepare(recording, args.track))
    others = [_light(prepare(read_recording(other))) for other in beside]
    replay = None if args.reward is None else compare_rewards(view, replay_reward(recording, args.reward))
    out = Path(args.out) if args.out else _default_out(place, recording.name)
    found = findings(view, target_s)
    try:
        write_page(out, LogPage(view, found, others, replay, terms))
    except OSError as error:
        raise BadInput(
            f"--out {out}: cannot be written: {error.strerror}; accepted: a file in a folder"
        ) from error

    print(f"{view.name}: {headline(view)}")
    for number, one in enumerate(found, 1):
        print(f"{number:3d}  {one.sentence}")
    for sentence in replay.sentences if replay is not None else ():
        print(f"     {sentence}")
    if view.problems:
        print(f"\n  {count(len(view.problems), 'problem')} while reading, the first: {view.problems[0]}")
    print(f"\n  page  {out}")
    if args.open:
        import webbrowser

        webbrowser.open(out.resolve().as_uri())
    return 0


def _place(what: str, args: argparse.Namespace) -> Path:
    """Return the file or folder that is meant.

    Raises:
        BadInput: there is none, or it is a run's name that several have.
    """
    with reading(what, "logs of the service, or a run"):
        path = Path(what).expanduser()
        if path.exists():
            if not path.is_dir():
                open_user_file(path, "logs of the service, or a run", LOG_BYTES).close()
            return path
    from deepracer_exp.evaluation.run import find_run

    try:
        return find_run(what, Path(args.runs_dir), args.tracking_uri)
    except BadInput as error:
        why = str(error).removeprefix(f"run={what}: ")
        raise BadInput(f"{what}: no such file or folder, and no run: {why}") from None


def _light(view: "LogView") -> "LogView":
    """Return a view without the steps of its training: what stands beside another is its iterations and races."""
    from dataclasses import replace

    steps = view.recording.steps
    recording = replace(view.recording, steps=steps[steps["stream"] != "training"].copy())
    return replace(view, steps=view.steps.iloc[:0].copy(), recording=recording)


def _default_out(place: Path, name: str) -> Path:
    from deepracer_exp.formats.own_recording import is_own_run

    if is_own_run(place):
        return place / "report.html"
    safe = "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in name).strip("-.")
    return Path(f"{safe[:80] or 'log'}-analysis.html")


def _seconds(text: str) -> float:
    import math

    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise BadInput(f"--target {text}: accepted: seconds above 0, such as 9.5")
    return seconds
