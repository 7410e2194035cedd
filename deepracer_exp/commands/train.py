"""`deepracer-exp train`, `resume`, `clone` and `sweep`: the commands that train cars."""

import argparse
import shlex
import sys
import traceback
from typing import TYPE_CHECKING

from deepracer_exp.collectors.forking import start_workers_early
from deepracer_exp.errors import BadInput, reading

from .arguments import (
    add_command,
    add_overrides,
    add_run,
    complete_groups,
    is_override,
    read_stores,
    run_and_overrides,
    split_stores,
)
from .output import (
    plain_console,
    print_notes,
    print_result,
    print_results,
    print_start,
    print_unsent,
    warnings_on_stderr,
)

if TYPE_CHECKING:
    from optuna.study import Study

    from deepracer_exp.training.plan import ResumePlan, TrainPlan

_TRAIN_EPILOG = """\
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
  deepracer-exp train reward.constants.STEP_COST=0.1        an UPPERCASE constant of the reward function
  deepracer-exp train -m seed=0,1,2 network=mlp_small,mlp   every combination, one run after the other; ends with
                                                            what each group of seeds scored, and what is chance
  deepracer-exp train track=Oval_track --cfg                print the experiment and stop

Groups: track race car action_space observation randomization episode reward network algorithm lr_schedule
collector evaluation checkpoints stopping budget tracking experiment
  deepracer-exp train --options GROUP                       list the options of a group
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the commands."""
    parser = add_command(
        commands,
        "train",
        _train,
        help="train a car",
        description="Train a car: compose an experiment from overrides and run it.",
        epilog=_TRAIN_EPILOG,
    )
    add_overrides(parser, "GROUP=OPTION | KEY=VALUE")
    parser.add_argument("--cfg", action="store_true", help="print the composed experiment as YAML and stop")
    options = parser.add_argument("--options", metavar="GROUP", help="list the options of a group and stop")
    options.completer = complete_groups  # type: ignore[attr-defined]
    parser.add_argument(
        "-m", "--multirun", action="store_true", help="run every combination of values given as lists"
    )

    parser = add_command(
        commands,
        "resume",
        _resume,
        help="continue a run that was killed, interrupted or failed",
        description="Continue a run from its last checkpoint.",
        epilog=_RESUME_EPILOG,
    )
    add_run(parser)

    parser = add_command(
        commands,
        "clone",
        _clone,
        help="start a new run from another run's policy",
        description="Continue from another run's checkpoint in a new run, at a tenth of its learning rate unless "
        "another one is given.",
        epilog=_CLONE_EPILOG,
    )
    add_run(parser, "checkpoint=NAME | GROUP=OPTION | KEY=VALUE")

    parser = add_command(
        commands,
        "sweep",
        _sweep,
        help="search for the values that race best",
        description="Train many cars, each with other values, and find the best.",
        epilog=_SWEEP_EPILOG,
        entry="sweep",
    )
    add_overrides(parser, "KEY=EXPRESSION | GROUP=OPTION | KEY=VALUE | report NAME | best NAME")
    parser.add_argument("--cfg", action="store_true", help="print the composed sweep as YAML and stop")


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

    from deepracer_exp.training.plan import plan_training

    plans = [plan_training(experiment, composition) for experiment, composition in composed]
    print_notes(remark for plan in plans for remark in plan.files.remarks)
    print_start()
    start_workers_early(any(plan.experiment.collector.forks for plan in plans))

    from deepracer_exp.reports.pages.run_page import RunReport
    from deepracer_exp.tracking.projector import Projector
    from deepracer_exp.training.new_run import try_out
    from deepracer_exp.training.run import run_training

    if len(plans) > 1:
        for plan in plans:
            try_out(plan)
    outcomes = []
    with Projector() as projector:
        for plan in plans:
            outcome = run_training(plan, plain_console(stderr=True), report=RunReport(), projector=projector)
            outcomes.append(outcome)
            if plan.experiment.debug and outcome.error is not None:
                traceback.print_exception(outcome.error)
            print_result(outcome, plan.experiment.tracking)
            if outcome.status == "interrupted":
                break
    if args.multirun:
        print_results(outcomes, plans[0].experiment.tracking)
    return max(outcome.exit_code for outcome in outcomes)


_RESUME_EPILOG = """\
  deepracer-exp resume RUN
  deepracer-exp resume RUN budget.env_steps=5000000         values that do not affect learning may be changed:
                                                            budget, stopping, tracking, checkpoints.keep and time
                                                            limits
  deepracer-exp resume RUN stopping=none                    resume a run that its stopping rule ended, until its
                                                            budget is used

The run continues from its last checkpoint, in its own folder and in the same MLflow run (a copy within runs_dir in a
new one); what it wrote after that checkpoint is overwritten. The result equals that of an uninterrupted run, bit for
bit, except with a budget in minutes. A reward function that keeps something between calls starts without it.
With a larger budget a learning rate and an entropy bonus that follow the budget rise again, and the command says so;
budget.schedule_until=0.5 holds them with twice the budget.
"""


def _resume(args: argparse.Namespace) -> int:
    from deepracer_exp.training.plan import plan_resume

    name, words = run_and_overrides(args)
    stores, changes = split_stores(words)
    # The folder says where the run is, but MLflow may have moved.
    overrides = [*changes, *(word for word in words if word.startswith("tracking.uri="))]
    return _continue(plan_resume(stores.find(name).path, overrides))


def _continue(plan: "ResumePlan | TrainPlan") -> int:
    """Resume a run, or train a clone."""
    print_start()
    start_workers_early(plan.experiment.collector.forks)

    from deepracer_exp.reports.pages.run_page import RunReport
    from deepracer_exp.training.run import run_training

    with warnings_on_stderr():
        outcome = run_training(plan, plain_console(stderr=True), report=RunReport())
    print_result(outcome, plan.experiment.tracking)
    return outcome.exit_code


_CLONE_EPILOG = """\
  deepracer-exp clone RUN randomization=sim2real budget.env_steps=1000000
                                                            the second phase, which makes a fast car a stable one
  deepracer-exp clone RUN                                   from its best checkpoint, on the conditions of its parent
  deepracer-exp clone RUN checkpoint=last                   from a checkpoint other than the best
  deepracer-exp clone RUN algorithm.lr=1e-5                 a learning rate other than a tenth of the parent's
  deepracer-exp clone RUN reward=racing_line track=Oval_track
                                                            another reward function, another track

The clone has the parent's configuration, its networks and a fresh optimizer. Action space, observation and network
cannot be changed. `deepracer-exp runs lineage RUN` draws the family tree.
"""


def _clone(args: argparse.Namespace) -> int:
    from deepracer_exp.training.clone import plan_clone

    name, words = run_and_overrides(args)
    checkpoints = [word for word in words if word.startswith("checkpoint=")]
    changes = [word for word in words if word not in checkpoints]
    checkpoint = checkpoints[-1].partition("=")[2] if checkpoints else None
    parent = split_stores(changes)[0].find(name)
    plan = plan_clone(parent.with_checkpoint(checkpoint), changes)
    args.debug = plan.experiment.debug
    print_notes((*plan.composition.notes, *plan.files.remarks))
    return _continue(plan)


_SWEEP_EPILOG = """\
A season in one command: rewards, actions and recipes, a second phase, and a page that says what to submit:
  deepracer-exp sweep sweep=season track=Oval_track

What to search, in Hydra's grammar:
  deepracer-exp sweep algorithm.lr='tag(log,interval(1e-5,1e-3))' network=mlp_small,mlp
  deepracer-exp sweep sweep=lr_entropy track=Oval_track     a ready-made study: season, lr_entropy,
                                                            reward_weights, action_space, network, everything,
                                                            sac, or NAME of ./sweeps/NAME.yaml
  KEY='interval(LOW,HIGH)'  'tag(log,interval(LOW,HIGH))'  'int(interval(LOW,HIGH))'  A,B  'range(FROM,BELOW,STEP)'
  GROUP='glob(*)'                                           all options of a group

How to search:
  sweep.trials=60 sweep.workers=2 sweep.seeds=3             trials in total, processes, seeds a trial
  sweep.sampler=gp                                          what chooses the next values (docs/sweeps.md)
  sweep.pruners=[entropy,median]                            what ends trials early (docs/sweeps.md); [] prunes nothing
  sweep.objectives=[lap_time,completion]                    a Pareto front instead of one best trial
  sweep.storage=postgresql+psycopg://USER@HOST/NAME         instead of runs/sweeps.db
  sweep/executor=ray                                        workers on a Ray cluster (docs/scaling.md)
  parent=RUN                                                trials are clones of RUN
  sweep.clone='{randomization: sim2real}'                   the best trial is cloned, and races its clone

To resume, report and use a study:
  deepracer-exp sweep study=NAME                            resumes a study that was interrupted or killed
  deepracer-exp sweep study=NAME sweep.trials=120           makes more trials
  deepracer-exp sweep report NAME [sweep.storage=URL]       writes the study's page and prints where it is
  deepracer-exp sweep best NAME                             prints the winning command
  deepracer-exp clone best:NAME                             trains the winner further
  deepracer-exp sweep sweep=NAME --cfg                      prints the sweep and stops

exit code: 0 all trials are done; 2 bad input; 3 all trials or the clone failed, or the database did
not answer; 130, 143 interrupted
"""
_WORDS = ("report", "best")
_WORKER = "deepracer_exp.sweeps.queue.worker"
"""Modules that a fork server imports once for all workers."""


def _sweep(args: argparse.Namespace) -> int:
    if args.overrides and args.overrides[0] in _WORDS:
        return _show_study(*args.overrides)
    from deepracer_exp.sweeps.plan import plan_sweep

    plan = plan_sweep(args.overrides, is_only_shown=args.cfg)
    request = plan.request
    args.debug = request.entry.debug
    print_notes(plan.remarks)
    if args.cfg:
        # The overrides of the training are shown where a ready-made sweep has them.
        request.composition.mapping["sweep"] |= {"train": list(request.base), "space": dict(request.space)}
        print(request.composition.yaml(), end="")
        return 0
    print_start()
    # The clone drives with processes of this one.
    forks = request.entry.sweep.executor.kind == "local" or request.entry.sweep.clone is not None
    start_workers_early(forks, _WORKER)
    if plan.lap_actions is not None:
        from .actions import write_lap_actions

        write_lap_actions(plan.lap_actions)

    from deepracer_exp.sweeps import PAGE_FILE
    from deepracer_exp.sweeps.report.best_trial import complete_trials
    from deepracer_exp.sweeps.run_sweep import sweep

    with warnings_on_stderr():
        study, folder, code = sweep(plan, plain_console(stderr=True))
    if code:
        where = [word for word in args.overrides if word.startswith(("runs_dir=", "sweep.storage="))]
        line = shlex.join(["deepracer-exp", "sweep", f"study={study.study_name}", *where])
        print(f"\ninterrupted; resume it with: {line}", file=sys.stderr)
        return code
    if complete_trials(study):
        _print_best(study)
    else:
        print("no trial was completed: all were pruned or failed")
    print(f"\n  page  {folder / PAGE_FILE}")
    print_unsent(folder)
    return 0


def _show_study(word: str, *arguments: str) -> int:
    """Write the report of a study, or print its best trial."""
    names = [argument for argument in arguments if not is_override(argument)]
    stores = read_stores((argument for argument in arguments if argument not in names), ["sweep.storage"])
    if len(names) != 1:
        raise BadInput(f"sweep {word}: accepted: one study, as in `deepracer-exp sweep {word} lr_entropy`")

    from deepracer_exp.config.experiment import safe_name
    from deepracer_exp.sweeps import DEFAULT_FILE, PAGE_FILE

    with reading(f"sweep {word} {names[0]}"):
        safe_name(names[0])
    from deepracer_exp.config.sweep import compose_sweep

    addresses = [word for word in arguments if word.startswith("sweep.storage=")]
    # Composed, because the address may be in a variable of the environment.
    runs_dir, storage = stores.runs_dir, compose_sweep(addresses).entry.sweep.storage
    if storage is None and not (runs_dir / DEFAULT_FILE).is_file():
        raise BadInput(f"runs_dir={runs_dir}: has no {DEFAULT_FILE}; give runs_dir=DIR or sweep.storage=URL")

    from deepracer_exp.sweeps.queue.storage import open_storage
    from deepracer_exp.sweeps.queue.study import load_study

    study = load_study(names[0], open_storage(storage, runs_dir))
    if word == "best":
        _print_best(study)
        return 0

    from deepracer_exp.sweeps.report.page import write_study_page

    print(write_study_page(study, runs_dir / study.study_name / PAGE_FILE))
    return 0


def _print_best(study: "Study") -> None:
    from deepracer_exp.runs.checkpoint_files import checkpoint_words
    from deepracer_exp.sweeps.report.best_trial import best_line, best_shown, best_trial
    from deepracer_exp.sweeps.report.last_race import last_race, race_rows
    from deepracer_exp.sweeps.report.page import export_step, tried

    if words := tried(study):
        print(f"\n{words}")
    print(f"\nbest: trial {best_trial(study).number}, {best_shown(study)}\n\n  {best_line(study)}")
    if (race := last_race(study)) is None:
        return
    first, (line, what) = race.racers[0], export_step(study)
    print("\n" + " ".join(filter(None, (race.verdict(), race.doubt()))))
    rows = race_rows(race)
    width = max(len(row["name"]) for row in rows)
    for row in rows:
        held_out = f" usual, {row['held_out_laps']} held-out" * race.has_held_out
        print(
            f"  {row['name']:{width}}  mean usual lap {row['lap_time']}, laps complete: {row['laps']}{held_out}"
        )
    print(f"\n  run     best:{study.study_name}, which is {first.run}, {checkpoint_words(first.checkpoint)}")
    print(f"  export  {line}  # {what}")
