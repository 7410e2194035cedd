"""`deepracer-exp train`: compose an experiment and run it."""

import argparse
import traceback

from .arguments import add_overrides, complete_groups
from .output import print_notes, print_result, print_results, print_start
from .startup import check_files, start_workers_early

_EPILOG = """\
An experiment is one option of each group, and any value in it can be set:

  deepracer-exp train                                       the default: re:Invent 2018, PPO, stops when the
                                                            policy has converged
  deepracer-exp train stopping=reliable                     stop as soon as the car laps reliably
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
  deepracer-exp train --options GROUP                       list the options of a group
"""


def add_train(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "train",
        help="train a car",
        description="Train a car: compose an experiment from overrides and run it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_overrides(parser, "GROUP=OPTION | KEY=VALUE")
    parser.add_argument("--cfg", action="store_true", help="print the composed experiment as YAML and stop")
    options = parser.add_argument("--options", metavar="GROUP", help="list the options of a group and stop")
    options.completer = complete_groups  # type: ignore[attr-defined]
    parser.add_argument(
        "-m", "--multirun", action="store_true", help="run every combination of values given as lists"
    )
    parser.set_defaults(command=_train, runs_rewards=True)


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
    print_notes(note for _, composition in composed for note in composition.notes)
    if args.cfg:
        print("---\n".join(composition.yaml() for _, composition in composed), end="")
        return 0
    for experiment, _ in composed:
        check_files(experiment)
    print_start()
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
        print_result(outcome, experiment.runs_dir if experiment.tracking.kind == "mlflow" else None)
        if outcome.status == "interrupted":
            break
    if args.multirun:
        print_results(outcomes)
    return max(outcome.exit_code for outcome in outcomes)
