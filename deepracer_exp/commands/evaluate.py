"""`deepracer-exp evaluate`, `watch`, `checkpoints` and `stopping`: how good a run is, and when it should have ended."""

import argparse
import ctypes.util
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput

from .arguments import add_command, add_run, port, run_and_overrides, runs_and_overrides, split_stores
from .output import table_console, warnings_on_stderr
from .replay import add_replay, check_replay, write_laps
from .startup import check_policy

if TYPE_CHECKING:
    from deepracer_exp.config.evaluation import EvaluateConfig
    from deepracer_exp.lookup.resolve import StoredRun

_EVALUATE_EPILOG = """\
  deepracer-exp evaluate RUN                                its best checkpoint
  deepracer-exp evaluate RUN evaluation=summit              three_trials, four_minutes, summit or aws_virtual
  deepracer-exp evaluate RUN evaluation=real_car            as the physical car sees and acts
  deepracer-exp evaluate RUN checkpoint=last evaluation.trials=20
  deepracer-exp evaluate RUN evaluation.tracks=[Oval_track,Bowtie_track]
  deepracer-exp evaluate RUN evaluation.held_out=null       on the usual conditions only
  deepracer-exp evaluate RUN --video lap.mp4

The results are also written to evaluations/TIME.json in the run's folder.
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the commands."""
    parser = add_command(
        commands,
        "evaluate",
        _evaluate,
        help="measure how good a trained car is",
        description=(
            "Race a run's best policy: several trials at once, on the usual and on held-out conditions (slippery "
            "floor, heavy car, delayed actions, ...), on any tracks."
        ),
        epilog=_EVALUATE_EPILOG,
        runs_rewards=True,
        entry="evaluate",
    )
    add_run(parser, "checkpoint=NAME | evaluation=NAME | KEY=VALUE")
    parser.add_argument("--video", metavar="FILE", help="film the fastest usual lap (.mp4)")
    parser.add_argument(
        "--cfg", action="store_true", help="print the composed configuration as YAML and stop"
    )

    parser = add_command(
        commands,
        "watch",
        _watch,
        help="film what a trained car sees, or watch a training",
        description=(
            "Race a run's best policy and film its fastest usual lap: what the car sees, where the policy looks, how "
            "likely each action is, and the view from above. With --live, serve a page on 127.0.0.1 with the newest "
            "evaluation laps of a training while it runs, until Ctrl-C."
        ),
        epilog=_WATCH_EPILOG,
        runs_rewards=True,
        entry="evaluate",
    )
    add_run(parser, "checkpoint=NAME | evaluation=NAME | KEY=VALUE", many=True)
    parser.usage = (
        "%(prog)s [-h] [-o FILE] [--live] [--port PORT] [--replay PAGE.html] RUN [RUN | LOGS] [KEY=VALUE ...]"
    )
    parser.add_argument(
        *("-o", "--output"), metavar="FILE", help="film to write (.mp4; default: films/ in the run's folder)"
    )
    parser.add_argument("--live", action="store_true", help="serve a page that follows the training")
    parser.add_argument("--port", type=port, help="port of the page (default: a free one)")
    add_replay(parser, "its fastest usual lap and an ordinary one, or the fastest of another run or of logs")

    parser = add_command(
        commands,
        "checkpoints",
        _checkpoints,
        help="compare a run's checkpoints and recommend one",
        description="Race every kept checkpoint of a run, show how fast it is and how often it completes a lap, and "
        "recommend one.",
        epilog=_CHECKPOINTS_EPILOG,
        entry="evaluate",
    )
    add_run(parser, "evaluation=NAME | KEY=VALUE")
    parser.add_argument(
        "-o", "--output", metavar="FILE", help="page to write (.html): the table, figures and all laps"
    )

    parser = commands.add_parser(
        "stopping",
        help="try a stopping rule on finished runs",
        description="Try stopping rules on finished runs.",
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    replay = add_command(
        actions,
        "replay",
        _replay,
        help="show where a rule would have ended runs, what it saves and what it loses",
        description="Apply a stopping rule to the metrics of runs: where would it have ended them, what would that "
        "have saved, and how much better did they still become?",
        epilog=_STOPPING_EPILOG,
    )
    add_run(replay, "stopping=NAME | stopping.KEY=VALUE", many=True)


def _evaluate(args: argparse.Namespace) -> int:
    if args.cfg:
        from deepracer_exp.config.compose import compose_entry
        from deepracer_exp.config.overrides import override_line

        runs, overrides = runs_and_overrides(args)
        named = [override_line("run", run) for run in runs]
        print(compose_entry("evaluate", [*overrides, *named]).yaml(), end="")
        return 0
    config, _ = _composed(args)
    if args.video is not None:
        check_film("--video", Path(args.video))
        choose_graphics()
    run = _policy(config)

    from rich.console import Console

    from deepracer_exp.evaluation.evaluate import evaluate_run

    video = None if args.video is None else Path(args.video)
    out = Console(width=None if sys.stdout.isatty() else 160)
    with warnings_on_stderr():
        evaluate_run(run, config, video, out, Console(stderr=True))
    return 0


def _composed(args: argparse.Namespace) -> "tuple[EvaluateConfig, bool]":
    """Return the configuration of the command line, and whether the trials are those of the training."""
    from deepracer_exp.config.compose import compose_evaluation
    from deepracer_exp.config.overrides import group_of, override_line

    run, overrides = run_and_overrides(args)
    config, _ = compose_evaluation([*overrides, override_line("run", run)])
    args.debug = config.debug
    return config, not any(group_of(given) == "evaluation" for given in overrides)


def _policy(config: "EvaluateConfig") -> "StoredRun":
    """Return the run to race, after what can be checked before the imports that take seconds."""
    return check_policy(
        config.run, config.runs_dir, config.tracking.uri, config.checkpoint, config.evaluation
    )


def _checkpoints_given(args: argparse.Namespace) -> list[str]:
    return [given for given in runs_and_overrides(args)[1] if given.startswith("checkpoint=")]


_WATCH_EPILOG = """\
  deepracer-exp watch RUN                                   film the fastest usual lap of its best checkpoint
  deepracer-exp watch RUN checkpoint=last -o last.mp4
  deepracer-exp watch RUN evaluation.tracks=[Oval_track]    on another track
  deepracer-exp watch RUN --live                            a page that follows the training
  deepracer-exp watch RUN --replay laps.html                a page: its fastest usual lap beside an ordinary one
  deepracer-exp watch RUN RUN --replay laps.html            or beside the fastest lap of another run, or of logs

The page shows the laps that the training evaluates its policy by; evaluation=NAME shows others.
"""


def _watch(args: argparse.Namespace) -> int:
    chosen = [*_checkpoints_given(args), *[f"--output {args.output}"] * (args.output is not None)]
    if args.live and chosen:
        raise BadInput(
            f"{chosen[0]}: --live serves a page of the newest checkpoint; accepted: only without --live"
        )
    if args.port is not None and not args.live:
        raise BadInput(f"--port {args.port}: accepted: only with --live")
    if args.replay is not None:
        return _replay_laps(args)
    if args.output is not None:
        check_film("--output", Path(args.output))
    config, own_trials = _composed(args)
    if not args.live:
        run = _policy(config)

        from rich.console import Console

        from deepracer_exp.reports.watch import film_run

        file = None if args.output is None else Path(args.output)
        with warnings_on_stderr():
            film_run(run, config, file, Console(), Console(stderr=True))
        return 0
    from deepracer_exp.config.own_class import OF_POLICY
    from deepracer_exp.config.parse import import_own_classes
    from deepracer_exp.lookup.resolve import resolve
    from deepracer_exp.reports.live_server import LiveServer

    # Its first checkpoint may be still to come.
    stored = resolve(config.run, Path(config.runs_dir), config.tracking.uri)
    import_own_classes(stored.experiment, OF_POLICY)
    protocol = stored.experiment.evaluation if own_trials else config.evaluation
    with LiveServer(args.port or 0) as server, warnings_on_stderr():
        print(server.url, flush=True)

        from deepracer_exp.reports.live import serve_live
        from deepracer_exp.training.budget import Budget

        serve_live(stored, protocol, server, Budget(stored.experiment.budget, stored.path).used)
    return 0


def _replay_laps(args: argparse.Namespace) -> int:
    check_replay(args.replay)
    if args.live or args.output is not None:
        other = "--live" if args.live else f"--output {args.output}"
        raise BadInput(f"--replay {args.replay}: accepted: without {other}")
    runs, overrides = runs_and_overrides(args)
    if not 1 <= len(runs) <= 2:
        raise BadInput(
            f"{' '.join(runs) or 'RUN'}: {len(runs)} given; accepted: a run, and another one or logs"
        )
    args.runs, args.overrides = runs[:1], overrides
    config, own_trials = _composed(args)
    run, rival, view = _policy(config), None, None
    if runs[1:]:
        from deepracer_exp.runs.files import is_run

        place = Path(runs[1]).expanduser()
        if place.exists() and not is_run(place):
            from deepracer_exp.analysis.log_view import prepare_races
            from deepracer_exp.aws.logs.reader import read_recording

            view = prepare_races(read_recording(place))
        else:
            rival = check_policy(runs[1], config.runs_dir, config.tracking.uri, None)

    from deepracer_exp.reports.driven_laps import laps_to_replay
    from deepracer_exp.reports.lap_replay import fastest_lap_of_log

    protocol = run.experiment.evaluation if own_trials else config.evaluation
    with warnings_on_stderr():
        laps = laps_to_replay(run, config.checkpoint, protocol, ordinary=not runs[1:])
        if view is not None:
            laps.append(fastest_lap_of_log(view, laps[0]))
        elif rival is not None:
            laps += laps_to_replay(rival, None, protocol, beside=laps[0])
    write_laps(args.replay, laps)
    print(f"  laps  {args.replay}")
    return 0


_CHECKPOINTS_EPILOG = """\
  deepracer-exp checkpoints RUN                             the trials by which the training chose its best one
  deepracer-exp checkpoints RUN evaluation=summit evaluation.trials=40
  deepracer-exp checkpoints RUN evaluation.tracks=[Oval_track,Bowtie_track]
  deepracer-exp checkpoints RUN -o checkpoints.html         a page, too: speed against stability, all laps

Every checkpoint drives the same trials, on the usual and on held-out conditions.
"""


def check_film(flag: str, file: Path) -> None:
    """Check where a film is to be written.

    Raises:
        BadInput: the file is not an .mp4, or its folder does not exist.
    """
    if file.suffix != ".mp4" or not file.absolute().parent.is_dir():
        raise BadInput(f"{flag} {file}: accepted: an .mp4 in an existing folder")


def choose_graphics() -> None:
    """Set MUJOCO_GL, which MuJoCo reads when it is imported, to a library that this machine has, unless it is set.

    Raises:
        BadInput: the machine has no such library, or MuJoCo cannot draw with it.
    """
    if not os.environ.get("MUJOCO_GL") and sys.platform == "linux":
        libraries = (("egl", "EGL"), ("osmesa", "OSMesa"))
        name = next((name for name, library in libraries if ctypes.util.find_library(library)), None)
        if name is None:
            raise BadInput(
                "--video: this machine has neither EGL nor OSMesa to draw with; install libegl1 (with "
                "libgl1-mesa-dri) or libosmesa6, or set MUJOCO_GL"
            )
        os.environ["MUJOCO_GL"] = name
    chosen = os.environ.get("MUJOCO_GL", "")

    from deepracer_exp.evaluation.video import can_draw

    if not can_draw():
        raise BadInput(
            f"--video: MuJoCo cannot draw with MUJOCO_GL={chosen} here; accepted: egl or osmesa with its library, glfw "
            "with a display"
        )


def _checkpoints(args: argparse.Namespace) -> int:
    if chosen := _checkpoints_given(args):
        raise BadInput(f"{chosen[0]}: all kept checkpoints are raced; `deepracer-exp evaluate` races one")
    if args.output is not None:
        page = Path(args.output)
        if page.suffix != ".html" or not page.absolute().parent.is_dir():
            raise BadInput(f"--output {page}: accepted: the name of a page (.html) in a folder")
    config, own_trials = _composed(args)
    run = _policy(config)

    from rich.console import Console

    from deepracer_exp.reports.checkpoint_comparison import show_checkpoints

    progress = Console(stderr=True, highlight=False, markup=False)
    with warnings_on_stderr():
        show_checkpoints(run, config, own_trials, args.output, table_console(160), progress)
    return 0


_STOPPING_EPILOG = """\
  deepracer-exp stopping replay RUN                           the rule `entropy` with its default values
  deepracer-exp stopping replay RUN RUN stopping=plateau      another rule
  deepracer-exp stopping replay RUN stopping.converged.patience=40,80
                                                              other values, one after the other
"""


def _replay(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_experiment, expand_grid
    from deepracer_exp.lookup.resolve import resolve
    from deepracer_exp.runs.files import read_record

    runs, given = runs_and_overrides(args)
    stores, overrides = split_stores(given)
    for override in overrides:
        if not override.startswith(("stopping=", "stopping.")):
            raise BadInput(f"{override}: accepted: stopping=NAME and stopping.KEY=VALUE")
    if not runs:
        raise BadInput("RUN: missing; accepted: a run's folder, or its name in runs/EXPERIMENT/")
    if not any(override.startswith("stopping=") for override in overrides):
        overrides.insert(0, "stopping=entropy")
    records = [read_record(resolve(run, stores.runs_dir, stores.uri).path) for run in runs]

    from deepracer_exp.stopping.replay import replay, table

    rules = [
        (" ".join(map(_within_group, lines)), compose_experiment(lines)[0])
        for lines in expand_grid(overrides)
    ]
    replays = [replay(record, config.stopping, rule) for record in records for rule, config in rules]
    table_console().print(table(replays))
    return 0


def _within_group(line: str) -> str:
    """Return an override without its group: ``plateau``, ``converged.patience=40``."""
    key, _, value = line.partition("=")
    _, _, inside = key.partition(".")
    return f"{inside}={value}" if inside else value
