"""`deepracer-exp sweep`: search for the values that race best."""

import argparse
import shlex
import sys

from deepracer_exp.errors import BadInput, reading

from .arguments import add_command, add_overrides, is_override, read_stores
from .output import print_start, warnings_on_stderr
from .startup import check_sweep, start_workers_early

_EPILOG = """\
what to search, in Hydra's grammar
  deepracer-exp sweep algorithm.lr='tag(log,interval(1e-5,1e-3))' network=mlp_small,mlp
  deepracer-exp sweep sweep=lr_entropy track=Oval_track     a ready-made sweep: lr_entropy, reward_weights,
                                                            action_space, network, everything
  KEY='interval(LOW,HIGH)'  'tag(log,interval(LOW,HIGH))'  'int(interval(LOW,HIGH))'  A,B  'range(FROM,BELOW,STEP)'
  GROUP='glob(*)'                                           all options of a group

how
  sweep.trials=60 sweep.workers=2 sweep.seeds=3             trials in total, processes, seeds a trial
  sweep.sampler=gp                                          what chooses the next values (docs/sweeps.md)
  sweep.pruners=[entropy,median]                            what ends trials early (docs/sweeps.md); [] prunes nothing
  sweep.objectives=[lap_time,completion]                    a Pareto front instead of one best trial
  sweep.storage=postgresql+psycopg://USER@HOST/NAME         instead of runs/sweeps.db
  sweep/executor=ray                                        workers on a Ray cluster (docs/scaling.md)
  parent=RUN                                                trials are clones of RUN

  deepracer-exp sweep study=NAME                            resumes a study that was interrupted or killed
  deepracer-exp sweep study=NAME sweep.trials=120           makes more trials
  deepracer-exp sweep report NAME [sweep.storage=URL]       writes the study's page and prints where it is
  deepracer-exp sweep best NAME                             prints the winning command
  deepracer-exp clone best:NAME                             trains the winner further
  deepracer-exp sweep sweep=NAME --cfg                      prints the sweep and stops

exit code: 0 all trials are done; 2 bad input; 3 all trials failed, or the database did not answer; 130, 143 interrupted
"""
_WORDS = ("report", "best")
_PRELOADED = "sweeps.worker"
"""What a fork server imports once for all workers."""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = add_command(
        commands,
        "sweep",
        _sweep,
        help="search for the values that race best",
        description="Train many cars, each with other values, and find the best.",
        epilog=_EPILOG,
        runs_rewards=True,
        entry="sweep",
    )
    add_overrides(parser, "KEY=EXPRESSION | GROUP=OPTION | KEY=VALUE | report NAME | best NAME")
    parser.add_argument("--cfg", action="store_true", help="print the composed sweep as YAML and stop")


def _sweep(args: argparse.Namespace) -> int:
    if args.overrides and args.overrides[0] in _WORDS:
        return _show_study(*args.overrides)
    from deepracer_exp.config.sweep import compose_sweep

    request = compose_sweep(args.overrides)
    args.debug = request.entry.debug
    check_sweep(request)
    if args.cfg:
        if not request.space:  # an existing study has its own
            from sweeps.study import load_request

            _, request, _ = load_request(args.overrides)
        # The overrides of the training are shown where a ready-made sweep has them.
        request.composition.mapping["sweep"] |= {"train": list(request.base), "space": dict(request.space)}
        print(request.composition.yaml(), end="")
        return 0
    print_start()
    start_workers_early(request.entry.sweep.executor.kind == "local", _PRELOADED)

    from rich.console import Console

    from sweeps.best import complete_trials
    from sweeps.sweep import REPORT, sweep

    with warnings_on_stderr():
        study, folder, code = sweep(args.overrides, Console(stderr=True))
    if code:
        where = [one for one in args.overrides if one.startswith(("runs_dir=", "sweep.storage="))]
        line = shlex.join(["deepracer-exp", "sweep", f"study={study.study_name}", *where])
        print(f"\ninterrupted; resume it with: {line}", file=sys.stderr)
        return code
    if complete_trials(study):
        _print_best(study)
    else:
        print("no trial was completed: all were pruned or failed")
    print(f"\n  page  {folder / REPORT}")
    return 0


def _show_study(word: str, *arguments: str) -> int:
    """Write the report of a study, or print its best trial."""
    names = [given for given in arguments if not is_override(given)]
    stores = read_stores((given for given in arguments if is_override(given)), ["sweep.storage"])
    if len(names) != 1:
        raise BadInput(f"sweep {word}: accepted: one study, as in `deepracer-exp sweep {word} lr_entropy`")

    from deepracer_exp.config.experiment import safe_name
    from sweeps import DEFAULT_FILE

    with reading(f"sweep {word} {names[0]}"):
        safe_name(names[0])
    runs_dir, storage = stores.runs_dir, stores.values.get("sweep.storage")
    if storage is None and not (runs_dir / DEFAULT_FILE).is_file():
        raise BadInput(f"runs_dir={runs_dir}: has no {DEFAULT_FILE}; give runs_dir=DIR or sweep.storage=URL")

    from sweeps.storage import open_storage
    from sweeps.study import load_study

    study = load_study(names[0], open_storage(storage, runs_dir))
    if word == "best":
        _print_best(study)
        return 0

    from sweeps.report import write_study_page
    from sweeps.sweep import REPORT

    print(write_study_page(study, runs_dir / study.study_name / REPORT))
    return 0


def _print_best(study: object) -> None:
    from sweeps.best import best_line, best_shown, best_trial

    number, shown = best_trial(study).number, best_shown(study)  # type: ignore[arg-type]
    print(f"\nbest: trial {number}, {shown}\n\n  {best_line(study)}")  # type: ignore[arg-type]
