"""`deepracer-exp validate`: what a reward function pays for."""

import argparse
import os
import re

from deepracer_exp.errors import BadInput

from .arguments import add_command, add_overrides
from .output import print_notes
from .startup import check_files, start_workers_early

_EPILOG = """\
  deepracer-exp validate reward=racing_line                 from the reward zoo, on the default track
  deepracer-exp validate reward.file=my_reward.py track=Oval_track
  deepracer-exp validate reward.file=my_reward.py trial=60s also train for that long: do reward and progress rise?

exit code: 0 it can be trained, even if there are warnings; 2 it cannot, or with --strict the console would refuse it
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = add_command(
        commands,
        "validate",
        _validate,
        help="find out what a reward function pays for",
        description=(
            "Check a reward function as the AWS console does, call it in many situations on the track, draw what it "
            "pays for, and warn of common mistakes."
        ),
        epilog=_EPILOG,
        runs_rewards=True,
    )
    add_overrides(parser, "reward=NAME | reward.file=PATH | KEY=VALUE")
    parser.add_argument("-o", "--output", help="picture to write (default: runs/validate/REWARD-TRACK.png)")
    parser.add_argument("--strict", action="store_true", help="refuse what the AWS console would refuse")


def _validate(args: argparse.Namespace) -> int:
    # Before NumPy is imported: a reward function has one thread in a training, too, and on a busy machine the threads
    # of a small linear-algebra problem wait for one another.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

    from deepracer_exp.config.compose import compose_experiment

    trials = [override.removeprefix("trial=") for override in args.overrides if override.startswith("trial=")]
    overrides = [override for override in args.overrides if not override.startswith("trial=")]
    seconds = _trial_seconds(trials[-1]) if trials else None
    experiment, composition = compose_experiment(overrides)
    args.debug = experiment.debug
    print_notes(composition.notes)
    trial = None if seconds is None else compose_experiment([*overrides, *_trial_overrides(seconds)])
    check_files(experiment)
    if trial is not None:
        start_workers_early(experiment.collector.forks)

    from rich.console import Console

    from deepracer_exp.validation.validate import validate_reward

    return validate_reward(experiment, trial, args.output, args.strict, Console(), Console(stderr=True))


def _trial_seconds(text: str) -> float:
    """Return the seconds of `60s`, `2min` or `90`.

    Raises:
        BadInput: it is none of them.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(s|min)?", text)
    seconds = float(match[1]) * (60 if match[2] == "min" else 1) if match else 0.0
    if not seconds:
        raise BadInput(
            f"trial={text}: not a time; accepted: seconds or minutes above 0, e.g. trial=60s, trial=2min"
        )
    return seconds


def _trial_overrides(seconds: float) -> list[str]:
    """Return the overrides for a short training; its run goes to `runs/validate/`."""
    return [
        *("name=validate", "tracking=off", "stopping=none", "checkpoints.every=null"),
        *("budget=default", "budget.env_steps=null", "budget.alerts=[]", f"budget.minutes={seconds / 60!r}"),
    ]
