"""`deepracer-exp evaluate`, `check`, `watch` and `checkpoints`: the quality of a run."""

import argparse
import ctypes.util
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from deepracer_exp.errors import BadInput

from .arguments import add_command, add_run, port, run_and_overrides, runs_and_overrides
from .output import check_file, plain_console, table_console, warnings_on_stderr
from .pages import add_replay, write_laps

if TYPE_CHECKING:
    from deepracer_exp.evaluation.plan import EvaluatePlan

_EVALUATE_EPILOG = """\
  deepracer-exp evaluate RUN                                its best checkpoint, on the trials of its training
  deepracer-exp evaluate RUN evaluation=summit              three_trials, four_minutes, summit or aws_virtual
  deepracer-exp evaluate RUN evaluation=real_car            as the physical car sees and acts
  deepracer-exp evaluate RUN evaluation=head_to_head rival=RUN
                                                            races of two policies
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
        entry="evaluate",
    )
    add_run(parser, "checkpoint=NAME | evaluation=NAME | KEY=VALUE")
    parser.add_argument("--video", metavar="FILE", help="film the fastest usual lap (.mp4)")
    parser.add_argument(
        "--trace", metavar="FOLDER", help="write every control step as the service does (for `analyze`)"
    )
    parser.add_argument(
        "--cfg", action="store_true", help="print the composed configuration as YAML and stop"
    )

    parser = add_command(
        commands,
        "check",
        _check,
        help="check a policy before it drives the physical car",
        description=(
            "Say what will happen on the physical car: what it makes of each action, whether its network is fast "
            "enough, laps and margins under each part of the car, zig-zag, and pictures that decide badly. The last "
            "line is `ready`, or says what to do."
        ),
        epilog=_CHECK_EPILOG,
        entry="evaluate",
    )
    add_run(parser, "checkpoint=NAME | evaluation.KEY=VALUE | KEY=VALUE")
    parser.add_argument("--car", action="store_true", required=True, help="check for the physical car")
    parser.add_argument(
        *("-o", "--output"),
        metavar="FILE",
        help="file to write these pictures to (.png; default: films/ in the run's folder)",
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


def _evaluate(args: argparse.Namespace) -> int:
    if args.cfg:
        runs, overrides = runs_and_overrides(args)
        if runs:  # by whose protocol it is judged unless another is named
            config = asdict(_planned(args, *run_and_overrides(args)).config)
            print(yaml.safe_dump(config, sort_keys=False, default_flow_style=None, width=110), end="")
            return 0

        from deepracer_exp.config.compose import compose_evaluation

        print(compose_evaluation(overrides)[1].yaml(), end="")
        return 0
    run, overrides = run_and_overrides(args)
    check_file("--video", args.video, ".mp4")
    plan = _planned(args, run, overrides)
    video, trace = (None if path is None else Path(path) for path in (args.video, args.trace))
    if trace is not None and (trace.is_file() or (trace.is_dir() and any(trace.iterdir()))):
        raise BadInput(f"--trace {trace}", "is there already and not empty", "a new or an empty folder")
    if video is not None:
        _choose_graphics()

    from deepracer_exp.evaluation.run_evaluation import evaluate_run

    out = table_console(160)
    with warnings_on_stderr():
        evaluate_run(plan, video, out, plain_console(stderr=True), trace)
    return 0


_CHECK_EPILOG = """\
  deepracer-exp check RUN --car                             its best checkpoint, as evaluation=real_car
  deepracer-exp check RUN --car evaluation.real_car.timing.frames_per_s=15
                                                            with AWS's own software
  deepracer-exp check RUN --car evaluation.real_car.controls.full_throttle_mps=2
                                                            with the speed that the car reaches at full throttle
"""


def _check(args: argparse.Namespace) -> int:
    run, overrides = run_and_overrides(args)
    check_file("--output", args.output, ".png")
    named = any(override.startswith("evaluation=") for override in overrides)
    plan = _planned(args, run, overrides if named else ["evaluation=real_car", *overrides])
    if plan.config.evaluation.real_car is None:
        raise BadInput(
            "evaluation", "is not of the physical car", "evaluation=real_car, which is the default"
        )
    _refuse_rival(plan, "--car")

    from deepracer_exp.commands.export.car_check import check_run

    with warnings_on_stderr():
        picture = None if args.output is None else Path(args.output)
        check_run(plan, picture, table_console(160), plain_console(stderr=True))
    return 0


def _planned(
    args: argparse.Namespace, run: str, overrides: list[str], has_checkpoint: bool = True
) -> "EvaluatePlan":
    from deepracer_exp.config.stored import request_evaluation
    from deepracer_exp.evaluation.plan import plan_evaluation

    plan = plan_evaluation(run, request_evaluation(overrides), has_checkpoint=has_checkpoint)
    args.debug = plan.config.debug
    return plan


def _refuse_rival(plan: "EvaluatePlan", flag: str) -> None:
    if plan.config.rival is not None:
        raise BadInput(f"rival={plan.config.rival}", f"{flag} shows races of a policy against itself", "null")


def _checkpoints_given(args: argparse.Namespace) -> list[str]:
    return [override for override in runs_and_overrides(args)[1] if override.startswith("checkpoint=")]


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
    check_file("--output", args.output, ".mp4")
    run, overrides = run_and_overrides(args)
    if not args.live:
        plan = _planned(args, run, overrides)

        from deepracer_exp.reports.pages.watch import film_run

        file = None if args.output is None else Path(args.output)
        with warnings_on_stderr():
            film_run(
                plan.run,
                plan.config.evaluation,
                file,
                plain_console(),
                plain_console(stderr=True),
                plan.rival,
            )
        return 0
    from deepracer_exp.reports.pages.live_server import LiveServer

    # Its first checkpoint may be still to come.
    plan = _planned(args, run, overrides, has_checkpoint=False)
    _refuse_rival(plan, "--live")
    with LiveServer(args.port or 0) as server, warnings_on_stderr():
        print(server.url, flush=True)

        from deepracer_exp.reports.pages.live_page import serve_live
        from deepracer_exp.training.budget import Budget

        used = Budget(plan.run.experiment.budget).used
        serve_live(plan.run, plan.config.evaluation, server, used)
    return 0


def _replay_laps(args: argparse.Namespace) -> int:
    check_file("--replay", args.replay, ".html")
    if args.live or args.output is not None:
        other = "--live" if args.live else f"--output {args.output}"
        raise BadInput(f"--replay {args.replay}: accepted: without {other}")
    runs, overrides = runs_and_overrides(args)
    if not 1 <= len(runs) <= 2:
        raise BadInput(
            f"{' '.join(runs) or 'RUN'}: {len(runs)} given; accepted: a run, and another one or logs"
        )
    plan, rival, view = _planned(args, runs[0], overrides), None, None
    _refuse_rival(plan, "--replay")
    if runs[1:]:
        from deepracer_exp.runs.run_files import is_run

        place = Path(runs[1]).expanduser()
        if place.exists() and not is_run(place):
            from deepracer_exp.aws.logs.reader import read_recording
            from deepracer_exp.reports.tables.log_view import prepare_races

            view = prepare_races(read_recording(place))
        else:
            from deepracer_exp.tracking.resolve import resolve

            rival = resolve(runs[1], Path(plan.config.runs_dir), plan.config.tracking.uri).with_policy()

    from deepracer_exp.reports.pages.driven_laps import laps_to_replay
    from deepracer_exp.reports.pages.lap_replay import fastest_lap_of_log

    protocol = plan.config.evaluation
    with warnings_on_stderr():
        laps = laps_to_replay(plan.run, protocol, ordinary=not runs[1:])
        if view is not None:
            laps.append(fastest_lap_of_log(view, laps[0]))
        elif rival is not None:
            laps += laps_to_replay(rival, protocol, beside=laps[0])
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


def _choose_graphics() -> None:
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
    check_file("--output", args.output, ".html")
    plan = _planned(args, *run_and_overrides(args))

    from deepracer_exp.reports.pages.checkpoint_comparison import show_checkpoints

    progress = plain_console(stderr=True)
    with warnings_on_stderr():
        show_checkpoints(
            plan.run, plan.config.evaluation, args.output, table_console(160), progress, plan.rival
        )
    return 0
