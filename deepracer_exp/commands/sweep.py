"""`deepracer-exp sweep`: search for the values that race best."""

import argparse
import shlex
import sys
from pathlib import Path

from deepracer_exp.errors import BadInput, reading

_EPILOG = """\
what is searched, in Hydra's grammar
  deepracer-exp sweep algorithm.lr='tag(log,interval(1e-5,1e-3))' network=mlp_small,mlp
  deepracer-exp sweep sweep=lr_entropy track=Oval_track     a ready-made sweep: lr_entropy, reward_weights,
                                                            action_space, network, everything
  KEY='interval(LOW,HIGH)'  'tag(log,interval(LOW,HIGH))'  'int(interval(LOW,HIGH))'  A,B  'range(FROM,BELOW,STEP)'
  GROUP='glob(*)'                                           all options of a group

how
  sweep.trials=60 sweep.workers=2 sweep.seeds=3             trials in total, processes, seeds a trial
  sweep.sampler=tpe                                         gp, cmaes, qmc, random, grid, nsga2
  sweep.pruners=[entropy,median]                            also percentile, hyperband, wilcoxon; [] prunes nothing
  sweep.objectives=[lap_time,completion]                    a Pareto front instead of one best trial
  sweep.storage=postgresql+psycopg://USER@HOST/NAME         instead of runs/sweeps.db
  sweep/executor=ray                                        workers on a Ray cluster (docs/scaling.md)
  parent=RUN                                                trials are clones of RUN

  deepracer-exp sweep study=NAME                            resumes a study that was interrupted or killed
  deepracer-exp sweep study=NAME sweep.trials=120           makes more trials
  deepracer-exp sweep report NAME                           writes the study's page and prints where it is
  deepracer-exp sweep best NAME                             prints the winning command
  deepracer-exp clone run=best:NAME                         trains on from the winner
  deepracer-exp sweep sweep=NAME --cfg                      print the sweep and stop

exit code: 0 all trials are made; 2 bad input; 3 all trials fail, or the database stays away; 130, 143 interrupted
"""
_WORDS = ("report", "best")


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    sweep = commands.add_parser(
        "sweep",
        help="search for the values that race best",
        description="Train many cars, each with other values, and find the best.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    sweep.add_argument(
        "overrides", nargs="*", metavar="KEY=EXPRESSION | GROUP=OPTION | KEY=VALUE | report NAME | best NAME"
    )
    sweep.add_argument("--cfg", action="store_true", help="print the composed sweep as YAML and stop")
    sweep.add_argument("--runs-dir", help="for report and best: where runs are (default: runs)")
    sweep.add_argument("--storage", help="for report and best: the study's database, as in sweep.storage")
    sweep.set_defaults(command=_sweep)


def _sweep(args: argparse.Namespace) -> int:
    if args.overrides and args.overrides[0] in _WORDS:
        return _told(args)
    if args.runs_dir is not None or args.storage is not None:
        raise BadInput(
            "--runs-dir and --storage are of report and best; write runs_dir=DIR or sweep.storage=URL"
        )
    from deepracer_exp.config.sweep import compose_sweep
    from sweeps.process import PRELOADED

    from .checking import check_sweep
    from .starting import start_workers_early

    request = compose_sweep(args.overrides)
    args.debug = request.entry.debug
    check_sweep(request)
    if args.cfg:
        if not request.space:  # that of a study that is there
            from sweeps.sweep import whole_request

            _, request, _ = whole_request(args.overrides)
        # What the command line says of the training stands where a ready-made sweep has it.
        request.composition.mapping["sweep"] |= {"train": list(request.base), "space": dict(request.space)}
        print(request.composition.yaml(), end="")
        return 0
    print("starting", file=sys.stderr, flush=True)
    start_workers_early(request.entry.sweep.executor.kind == "local", PRELOADED)

    from rich.console import Console

    from sweeps.best import complete_trials
    from sweeps.sweep import REPORT, sweep

    from .stderr_warnings import warnings_on_stderr

    with warnings_on_stderr():
        study, folder, code = sweep(args.overrides, Console(stderr=True))
    if code:
        where = [one for one in args.overrides if one.startswith(("runs_dir=", "sweep.storage="))]
        line = shlex.join(["deepracer-exp", "sweep", f"study={study.study_name}", *where])
        print(f"\ninterrupted; resume it with: {line}", file=sys.stderr)
        return code
    if complete_trials(study):
        _tell_best(study)
    else:
        print("no trial was worth finishing: all were pruned or failed")
    print(f"\n  page  {folder / REPORT}")
    return 0


def _told(args: argparse.Namespace) -> int:
    word, *names = args.overrides
    if len(names) != 1:
        raise BadInput(f"sweep {word}: one study is accepted, as in `deepracer-exp sweep {word} lr_entropy`")

    from deepracer_exp.config.experiment import safe_name

    with reading(f"sweep {word} {names[0]}"):
        safe_name(names[0])
    runs_dir = Path(args.runs_dir or "runs")
    if args.storage is None and not (runs_dir / "sweeps.db").is_file():
        raise BadInput(f"--runs-dir {runs_dir}: has no sweeps.db; give the folder, or --storage URL")

    from sweeps.storage import open_storage
    from sweeps.study import load_study

    study = load_study(names[0], open_storage(args.storage, runs_dir))
    if word == "best":
        _tell_best(study)
        return 0

    from sweeps.report import write_report
    from sweeps.sweep import REPORT

    print(write_report(study, runs_dir / study.study_name / REPORT))
    return 0


def _tell_best(study: object) -> None:
    from sweeps.best import best_line, best_shown, best_trial

    number, shown = best_trial(study).number, best_shown(study)  # type: ignore[arg-type]
    print(f"\nbest: trial {number}, {shown}\n\n  {best_line(study)}")  # type: ignore[arg-type]
