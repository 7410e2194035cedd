"""The command line; each command imports what it needs, so that `--help` answers at once."""

import argparse
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NoReturn

from deepracer_exp import __version__
from deepracer_exp.addresses import redact, without_passwords
from deepracer_exp.commands import (
    analyze,
    checkpoints,
    clean,
    clone,
    compare,
    export,
    lineage,
    promote,
    resume,
    stopping,
    sweep,
)
from deepracer_exp.commands.checking import check_files, check_run
from deepracer_exp.commands.ending import tell, tell_all
from deepracer_exp.commands.starting import start_workers_early
from deepracer_exp.commands.stderr_warnings import warnings_on_stderr
from deepracer_exp.commands.supervised import supervised
from deepracer_exp.errors import BadInput, RunFailed, nearest

_TRAIN_EPILOG = """\
An experiment is one option of each group, and any value in it can be set:

  deepracer-exp train                                       the default: re:Invent 2018, PPO, stops when
                                                            there is nothing more to gain
  deepracer-exp train stopping=reliable                     stops as soon as the car laps reliably
  deepracer-exp train track=Oval_track reward=racing_line   other options
  deepracer-exp train algorithm.lr=3e-4 seed=7              other values
  deepracer-exp train experiment=fast_lap                   a set of choices from conf/experiment/
  deepracer-exp train reward.file=my_reward.py              your own reward function
  deepracer-exp train custom_files=DIR                      reward_function.py, model_metadata.json and
                                                            hyperparameters.json as DeepRacer has them
  deepracer-exp train reward.constants.SPEED_WEIGHT=2       an UPPERCASE constant of the reward function
  deepracer-exp train -m seed=0,1,2 network=mlp_small,mlp   every combination, one run after the other
  deepracer-exp train track=Oval_track --cfg                print the experiment and stop

groups: track car action_space observation randomization episode reward network algorithm lr_schedule
        collector evaluation checkpoints stopping budget tracking experiment
  deepracer-exp train --options GROUP                       the options of a group
"""


_VALIDATE_EPILOG = """\
  deepracer-exp validate reward=racing_line                 of the reward zoo, on the default track
  deepracer-exp validate reward.file=my_reward.py track=Oval_track
  deepracer-exp validate reward.file=my_reward.py trial=60s also train so long: do reward and progress rise?

exit code: 0 it can be trained, whatever the warnings; 2 it cannot, or --strict and the console would refuse it
"""


_EVALUATE_EPILOG = """\
  deepracer-exp evaluate run=RUN                            RUN: a run's folder, its name or the beginning of it,
                                                            MLflow's id, best:EXPERIMENT, MODEL@ALIAS or ALIAS
  deepracer-exp evaluate run=RUN evaluation=summit          three_trials, four_minutes, summit or aws_virtual
  deepracer-exp evaluate run=RUN checkpoint=last evaluation.trials=20
  deepracer-exp evaluate run=RUN evaluation.tracks=[Oval_track,Bowtie_track]
  deepracer-exp evaluate run=RUN evaluation.held_out=null   on the usual conditions only
  deepracer-exp evaluate run=RUN --video lap.mp4 --view top

The results are also written into the run's folder, evaluations/TIME.json.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit with its code: 0 done, 2 bad input, 3 the run failed, 130/143 interrupted.

    Args:
        arguments: of the command line; None: those of this process, in which no reward function runs then.
    """
    args = argparse.Namespace()
    try:
        args = _parsed(arguments)
    except BadInput as error:
        sys.exit(_fail(error, BadInput.exit_code, args))
    if arguments is None and getattr(args, "runs_rewards", False):
        sys.exit(supervised(lambda: _call(args)))
    sys.exit(_call(args))


def _call(args: argparse.Namespace) -> int:
    """Run the command that was asked for and return its exit code."""
    try:
        code = int(args.command(args))
        sys.stdout.flush()  # while an error still is one
        return code
    except BadInput as error:
        return _fail(error, BadInput.exit_code, args)
    except RunFailed as error:
        return _fail(error, RunFailed.exit_code, args)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader of our output (`| head`) has gone; what Python still holds for it is of no use.
        sys.stderr.close()
        return 141


class _Parser(argparse.ArgumentParser):
    """Argparse that complains in one line."""

    def error(self, message: str) -> NoReturn:
        raise BadInput(f"{message}; `{self.prog} --help` tells more")

    def _check_value(self, action: argparse.Action, value: str) -> None:
        # Newer versions of argparse suggest the nearest word themselves.
        choices = list(action.choices or ())
        if choices and value not in choices:
            name = action.option_strings[0] if action.option_strings else str(action.metavar).lower()
            raise BadInput(
                f"{value}: no such {name}{nearest(value, choices)}; accepted: {', '.join(choices)}"
            )


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = _parser()
    if arguments is None:
        sys.argv[1:] = without_passwords(sys.argv[1:])  # which the run's folder keeps
    args, rest = parser.parse_known_args(None if arguments is None else without_passwords(list(arguments)))
    if any(argument.startswith("-") for argument in rest) or (rest and "overrides" not in args):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if rest:  # argparse takes no positional arguments after an option between them
        args.overrides += rest
    return args


def _parser() -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = _Parser(
        prog="deepracer-exp",
        description="Hundreds of DeepRacer-style racing experiments a day, on one machine.",
        epilog="`deepracer-exp COMMAND --help` tells more. Results go to runs/ in the current folder.",
    )
    parser.add_argument("--version", action="version", version=f"deepracer-exp {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    train = commands.add_parser(
        "train",
        help="train a car",
        description="Train a car: compose an experiment from overrides and run it.",
        epilog=_TRAIN_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    train.add_argument("overrides", nargs="*", metavar="GROUP=OPTION | KEY=VALUE")
    train.add_argument("--cfg", action="store_true", help="print the composed experiment as YAML and stop")
    train.add_argument("--options", metavar="GROUP", help="print the options of a group and stop")
    train.add_argument(
        "-m", "--multirun", action="store_true", help="run every combination of values given as lists"
    )
    train.set_defaults(command=_train, runs_rewards=True)

    bring = commands.add_parser(
        "import",
        help="make options of a DeepRacer model's files",
        description=(
            "Make options of reward_function.py, model_metadata.json and hyperparameters.json, those of them that are "
            "there: files in ./conf, to train with and to edit. Options in ./conf of the current folder stand beside "
            "the project's own in every command. To train once with such files: deepracer-exp train custom_files=DIR."
        ),
    )
    bring.add_argument(
        "folder", metavar="DIR", help="deepracer-for-cloud's custom_files, or a model's folder"
    )
    bring.add_argument(
        "--name", required=True, help="of the options, as in: deepracer-exp train experiment=NAME"
    )
    bring.set_defaults(command=_import)

    validate = commands.add_parser(
        "validate",
        help="find out what a reward function pays for",
        description=(
            "Check a reward function as the AWS console does, call it in many situations on the track, draw what it "
            "pays for, and warn of what often goes wrong."
        ),
        epilog=_VALIDATE_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    validate.add_argument("overrides", nargs="*", metavar="reward=NAME | reward.file=PATH | KEY=VALUE")
    validate.add_argument("-o", "--output", help="picture to write (default: runs/validate/REWARD-TRACK.png)")
    validate.add_argument("--strict", action="store_true", help="refuse what the AWS console would refuse")
    validate.set_defaults(command=_validate, runs_rewards=True)

    evaluate = commands.add_parser(
        "evaluate",
        help="find out how good a trained car is",
        description=(
            "Let a run's best policy race: several trials at once, on the usual conditions and on such it was not "
            "trained on, on any tracks."
        ),
        epilog=_EVALUATE_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    evaluate.add_argument("overrides", nargs="*", metavar="run=RUN | evaluation=NAME | KEY=VALUE")
    evaluate.add_argument("--video", metavar="FILE", help="film the fastest lap (.mp4)")
    evaluate.add_argument("--view", choices=("chase", "top"), default="chase", help="of the film")
    evaluate.add_argument("--cfg", action="store_true", help="print what is asked for as YAML and stop")
    evaluate.set_defaults(command=_evaluate, runs_rewards=True)

    tracks = commands.add_parser(
        "tracks",
        help="list the tracks, or draw one",
        description="List the tracks with length, width and variants; with a name, draw that track.",
    )
    tracks.add_argument("name", nargs="?", help="a track of the list, or a route file (.npy, .yaml)")
    tracks.add_argument("-o", "--output", help="also write a picture of it")
    tracks.set_defaults(command=_tracks)

    ui = commands.add_parser(
        "ui",
        help="open the MLflow pages of the recorded runs",
        description="Serve the MLflow pages of the project's runs on 127.0.0.1 until Ctrl-C.",
    )
    ui.add_argument("--port", type=int, default=5000)
    ui.add_argument("--runs-dir", default="runs", help="where the runs are (default: runs)")
    ui.add_argument("--uri", help="another MLflow store, as given to tracking.uri")
    ui.set_defaults(command=_ui)

    analyze.register(commands)
    sweep.register(commands)
    resume.register(commands)
    clone.register(commands)
    checkpoints.register(commands)
    stopping.register(commands)
    compare.register(commands)
    export.register(commands)
    promote.register(commands)
    lineage.register(commands)
    clean.register(commands)
    return parser


def _train(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_experiment, expand_grid
    from deepracer_exp.config.options import options_of

    if args.options is not None:
        described = options_of(args.options)
        for name, what in described.items():
            print(f"{name:{max(map(len, described))}}  {what}".rstrip())
        return 0
    grid = expand_grid(args.overrides) if args.multirun else [list(args.overrides)]
    # All combinations are checked, and their files read, before the first one runs.
    composed = [compose_experiment(overrides) for overrides in grid]
    args.debug = any(experiment.debug for experiment, _ in composed)
    _tell_notes(note for _, composition in composed for note in composition.notes)
    if args.cfg:
        print("---\n".join(composition.yaml() for _, composition in composed), end="")
        return 0
    for experiment, _ in composed:
        check_files(experiment)
    # The imports to come take seconds, and the first start after an installation compiles for longer.
    print("starting", file=sys.stderr, flush=True)
    start_workers_early(any(experiment.collector.forks for experiment, _ in composed))

    from rich.console import Console

    from deepracer_exp.training.run import read_files, train

    if len(composed) > 1:
        for experiment, _ in composed:
            read_files(experiment)
    outcomes = []
    for experiment, composition in composed:
        outcome = train(experiment, composition, Console(stderr=True))
        outcomes.append(outcome)
        if experiment.debug and outcome.error is not None:
            traceback.print_exception(outcome.error)
        tell(outcome, None if experiment.tracking.kind == "off" else experiment.runs_dir)
        if outcome.status == "interrupted":
            break
    if args.multirun:
        tell_all(outcomes)
    return max(outcome.exit_code for outcome in outcomes)


def _validate(args: argparse.Namespace) -> int:
    # Before NumPy is imported: a reward function has one thread in a training, too, and on a busy machine the threads
    # of a small linear-algebra problem wait for one another.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.validation.trial import trial_overrides, trial_seconds

    trials = [override.removeprefix("trial=") for override in args.overrides if override.startswith("trial=")]
    overrides = [override for override in args.overrides if not override.startswith("trial=")]
    seconds = trial_seconds(trials[-1]) if trials else None
    experiment, composition = compose_experiment(overrides)
    args.debug = experiment.debug
    _tell_notes(composition.notes)
    trial = None if seconds is None else compose_experiment([*overrides, *trial_overrides(seconds)])
    check_files(experiment)
    if trial is not None:
        start_workers_early(experiment.collector.forks)

    from rich.console import Console

    from deepracer_exp.validation.validate import validate

    return validate(experiment, trial, args.output, args.strict, Console(), Console(stderr=True))


def _evaluate(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_entry, compose_evaluation

    if args.cfg:
        print(compose_entry("evaluate", args.overrides).yaml(), end="")
        return 0
    config, _ = compose_evaluation(args.overrides)
    args.debug = config.debug
    if args.video is not None:
        # MuJoCo looks at this once, when it is imported.
        from deepracer_exp.evaluation.graphics import choose_graphics

        choose_graphics()
    check_run(config.run, config.runs_dir, config.tracking_uri, config.checkpoint)

    from rich.console import Console

    from deepracer_exp.evaluation.evaluate import evaluate

    video = None if args.video is None else (Path(args.video), args.view)
    out = Console(width=None if sys.stdout.isatty() else 160)
    with warnings_on_stderr():
        evaluate(config, video, out, Console(stderr=True))
    return 0


def _import(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.config.custom_files import KEY, read_custom_files
    from deepracer_exp.config.import_files import import_files
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.env.reward_source import load_reward_source

    files = read_custom_files(args.folder)
    experiment, composition = compose_experiment([override_line(KEY, args.folder)])
    load_reward_source(experiment.reward)
    written = import_files(files, args.name, composition)
    _tell_notes(composition.notes)
    for path in written:
        print(path)
    print(f"\n  train it  deepracer-exp train experiment={args.name}")
    return 0


def _tell_notes(notes: Iterable[str]) -> None:
    for note in dict.fromkeys(notes):
        print(note, file=sys.stderr)


def _tracks(args: argparse.Namespace) -> int:
    from rich.console import Console

    from deepracer_exp.commands.tracks import list_tracks, show_track

    if args.name is None:
        list_tracks(Console(width=None if sys.stdout.isatty() else 160))
    else:
        show_track(args.name, args.output)
    return 0


def _ui(args: argparse.Namespace) -> int:
    from deepracer_exp.tracking.ui import serve_ui

    announce: Callable[[str], None] = lambda line: print(line, flush=True)  # noqa: E731 - print has no such type
    serve_ui(Path(args.runs_dir), args.uri, args.port, announce)
    return 0


def _fail(error: Exception, code: int, args: argparse.Namespace) -> int:
    if getattr(args, "debug", False) or "debug=true" in getattr(args, "overrides", ()):
        print(redact("".join(traceback.format_exception(error))), end="", file=sys.stderr)
    print(f"deepracer-exp: {redact(str(error))}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
