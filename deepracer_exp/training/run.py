"""Start a run, resume one, or continue a copy of one."""

import ast
import json
import logging
import math
import shutil
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from rich.console import Console

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.config import acting
from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import PPOConfig
from deepracer_exp.config.own_class import own_classes
from deepracer_exp.config.parse import parse_config
from deepracer_exp.config.running import BudgetConfig
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.errors import NO_MEMORY, BadInput, RunFailed, count, is_refused_memory, reading
from deepracer_exp.evaluation.rival_run import keep_rival, kept_rival
from deepracer_exp.rewards.reward import RewardFunction
from deepracer_exp.runs.checkpoints import check, checkpoint_name, intact_checkpoint, read_training
from deepracer_exp.runs.fingerprint import refuse_changes
from deepracer_exp.runs.folder import RunFolder
from deepracer_exp.runs.lineage import Lineage, read_lineage
from deepracer_exp.runs.next_steps import schedule_until
from deepracer_exp.runs.run_files import (
    CHECKPOINTS,
    CONFIG,
    LINEAGE,
    METRICS,
    REWARD,
    SUMMARY,
    TRACKING,
    read_object,
)
from deepracer_exp.runs.run_result import FINISHED, INTERRUPTED, Ending
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.scratch import folder_aside
from deepracer_exp.sim.batch import CarBatch
from deepracer_exp.tracking.metadata import joined, lineage_tags, run_params, run_tags
from deepracer_exp.tracking.mlflow_metrics import now_ms
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.tracking.tracker import open_tracker
from deepracer_exp.tracking.tracking_file import TrackedRun, begin_again, read_tracked_run
from deepracer_exp.training.stopping.stopping_rules import UNDECIDED

from .budget import Budget
from .callbacks import standard_callbacks
from .clone import describe_clone, read_parent
from .machine import memory_needed
from .metrics import track_names
from .plan import ResumePlan, TrainPlan
from .rounding import rounded
from .signals import Interruption
from .train_result import TakenOver, TrainResult
from .trainer import Callback, Trainer

logger = logging.getLogger("deepracer_exp")


def run_training(
    plan: TrainPlan | ResumePlan,
    console: Console | None = None,
    callbacks: Sequence[Callback] = (),
    report: Callback | None = None,
    run_name: str | None = None,
    tags: Mapping[str, str] = MappingProxyType({}),
    created: Callable[[Path], None] | None = None,
    projector: Projector | None = None,
) -> TrainResult:
    """Train a new run, a clone, or a run from its last checkpoint; return the result.

    Args:
        plan: of `plan_training`, `plan_clone` or `plan_resume`.
        console: shows the progress; None: nothing is shown.
        callbacks: called beside the standard ones, see `standard_callbacks`.
        report: makes pictures and pages of the run, `reports.pages.run_page.RunReport`; None: there are none.
        run_name: of the run in MLflow; None: from the reward function and the time.
        tags: of the run in MLflow, beside its own.
        created: called with the folder of a new run before it is recorded anywhere else.
        projector: records several runs, one after the other; None: this run has one of its own.

    Raises:
        BadInput: before anything was started; no folder of a new run is left. A run cannot be resumed while it is
            being trained, or with other values.
        TakenOver: a callback raised it.
    """
    console = console or Console(quiet=True)
    # Signals are caught from here on, so that Ctrl-C during the start leaves a whole folder, too.
    with Interruption(_printing(console)) as interruption:
        if isinstance(plan, ResumePlan):
            return _run(_reopen(plan, console, callbacks, report, run_name, tags, projector), interruption)
        start = None
        if plan.parent is not None:
            start = read_parent(plan.parent, plan.experiment)
            for note in describe_clone(plan.parent, plan.experiment, start[1]):
                _printing(console)(note)
        setup = try_out(plan)
        memory = memory_needed(plan.experiment)
        trainer = _begin(plan, setup, console, start, callbacks, report, run_name, tags, created, projector)
        _print_lines([*rounded(plan.experiment), *memory], console)
        return _run(trainer, interruption)


def store_run(plan: TrainPlan, networks: PolicyNetworks, reason: str) -> TrainResult:
    """Store networks that were trained elsewhere as a run without iterations.

    The reward function is not run. `networks` are its checkpoint, best and last; `reason` names their origin in the
    summary.

    Raises:
        BadInput: as for `run_training`; no folder is left.
    """
    setup = build_setup(plan.experiment, files=plan.files)
    trainer = _begin(plan, setup, Console(quiet=True), (networks, None))
    return trainer.end(Ending(FINISHED, reason), 0)


def copy_run(run_dir: Path, attempt: int) -> Path:
    """Copy a run whose folder another process holds, so that the copy can be resumed; return the copy's folder.

    The original keeps its run in MLflow; the copy gets a run of its own there.

    Raises:
        OSError: it cannot be copied.
    """
    base = run_dir.name.partition("-attempt")[0]
    target = run_dir.with_name(f"{base}-attempt{attempt}")
    # Files and checkpoints are written under a name with a dot first.
    left_out = shutil.ignore_patterns(SUMMARY, ".*")
    with folder_aside(target.parent, ".copy-") as aside:
        shutil.copytree(run_dir, aside, symlinks=True, ignore=left_out, dirs_exist_ok=True)
        if (aside / TRACKING).exists():
            begin_again(aside, target)
        aside.replace(target)
    return target


def try_out(plan: TrainPlan) -> RaceSetup:
    """Build the race of a plan and run the reward function's module once.

    Raises:
        BadInput: one of them cannot be used, or values contradict.
    """
    setup = build_setup(plan.experiment, files=plan.files)
    _try(plan.experiment, setup)
    return setup


def _try(experiment: Experiment, setup: RaceSetup) -> None:
    """Run the reward function's module once, let the car stand, and look for the device."""
    RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    with reading(f"car {experiment.car.name}", "dimensions, masses and settings of a car that can stand"):
        CarBatch(setup.car, 1, 1)
    gpus = torch.cuda.device_count()
    if experiment.device != "cpu" and (torch.device(experiment.device).index or 0) >= gpus:
        names = ["cpu", *(f"cuda:{number}" for number in range(gpus))]
        raise BadInput(
            f"device={experiment.device}", f"PyTorch finds {count(gpus, 'GPU')} here", ", ".join(names)
        )


def _begin(
    plan: TrainPlan,
    setup: RaceSetup,
    console: Console,
    start: tuple[PolicyNetworks, Lineage | None] | None,
    callbacks: Sequence[Callback] = (),
    report: Callback | None = None,
    run_name: str | None = None,
    tags: Mapping[str, str] = MappingProxyType({}),
    created: Callable[[Path], None] | None = None,
    projector: Projector | None = None,
) -> Trainer:
    """Create the folder of a new run and record it."""
    experiment, composition, rival = plan.experiment, plan.composition, None
    if plan.rival is not None:
        rival = StoredRun(plan.rival.path, plan.rival.read_policy().path.name)
    tracker = open_tracker(experiment.tracking, Path(experiment.runs_dir), projector)
    names = _names(composition, joined(track_names(setup)), setup.reward.name)
    every = standard_callbacks(experiment, setup, names, tracker, console, callbacks, report, rival)
    label = f"{names['track']}-{names['reward']}-seed{experiment.seed}"
    lineage = None if start is None else start[1]
    if lineage is not None:
        label += f"-clone{lineage.generation}"
    folder = RunFolder.create(experiment.runs_dir, experiment.name, label)
    try:
        if rival is not None:
            keep_rival(rival, folder.path)
        trainer = Trainer(experiment, setup, folder, composition.mapping, every)
        if start is not None:
            trainer.agent.begin_with(start[0])
        if lineage is not None:
            folder.write(LINEAGE, json.dumps(asdict(lineage), indent=2) + "\n")
        if created is not None:
            created(folder.path)
        trainer.save(best=start is not None and lineage is None)  # of an imported run there is no other
        commit = folder.describe(composition, setup.reward, experiment.seed, names)
    except (OSError, RunFailed) as error:
        folder.remove()
        what = (
            f"cannot write {error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
        )
        raise BadInput(f"runs_dir={experiment.runs_dir}", f"{what}; give a folder with room") from error
    except BaseException as error:
        folder.remove()
        if isinstance(error, Exception) and (reason := _own_error(error, experiment)):
            raise BadInput(reason) from error
        raise
    acting.remember()
    for note in (*composition.notes, *plan.files.remarks):
        logger.info(note)
    if rival is not None:
        logger.info("rival: %s, checkpoint %s", rival.path, rival.checkpoint)
    tracker.open(folder.path, _described(trainer, composition, names, commit, run_name, tags))
    return trainer


def _described(
    trainer: Trainer,
    composition: Composition,
    names: Mapping[str, str],
    commit: str | None,
    run_name: str | None,
    tags: Mapping[str, str],
) -> TrackedRun:
    """Return the name, parameters and tags that a run is recorded with."""
    folder, experiment = trainer.folder, trainer.experiment
    lineage = read_lineage(folder.path)
    run_own_tags = run_tags(names, commit, trainer.setup.reward.sha256, folder.path.resolve())
    if lineage is not None:
        run_own_tags |= lineage_tags(lineage)
    # MLflow's table shows some 20 characters; the folder's name is in the tag run_dir.
    what = names["reward"] if lineage is None else f"clone {lineage.generation}"
    return TrackedRun(
        run_name=run_name or f"{what} s{experiment.seed} {time.strftime('%H:%M:%S')}",
        experiment=experiment.name,
        start_ms=now_ms(),
        params=run_params(composition.choices, names, composition.mapping, composition.overrides),
        tags={**run_own_tags, **tags},
    )


def _reopen(
    plan: ResumePlan,
    console: Console,
    callbacks: Sequence[Callback],
    report: Callback | None,
    run_name: str | None,
    tags: Mapping[str, str],
    projector: Projector | None,
) -> Trainer:
    """Return a run to its last checkpoint."""
    run_dir, experiment, composition = plan.run_dir, plan.experiment, plan.composition
    names = plan.provenance.get("names", {})
    setup = build_setup(experiment)
    memory = memory_needed(experiment)
    checkpoint = intact_checkpoint(run_dir / CHECKPOINTS, "last", resumable=True)
    state = read_training(checkpoint)
    refuse_changes(run_dir, state, composition.mapping, setup)
    acting.refuse_reward(experiment.reward.file, run_dir.name, run_dir / REWARD)
    _try(experiment, setup)
    _forget_damaged_best(run_dir, state)
    tracker = open_tracker(experiment.tracking, Path(experiment.runs_dir), projector)
    rival = kept_rival(experiment, run_dir)
    every = standard_callbacks(experiment, setup, names, tracker, console, callbacks, report, rival)
    folder = RunFolder(run_dir)
    iteration = state["iteration"]
    try:
        trainer = Trainer(experiment, setup, folder, plan.stored, every)
        rows = [row for row in folder.metrics() if row["iteration"] <= iteration]
        if len(rows) != iteration:
            raise BadInput(
                f"{run_dir / METRICS}: has {len(rows)} of the {iteration} rows up to the checkpoint; restore "
                "the file, or start a new run from the checkpoint with `deepracer-exp clone`"
            )
        trainer.load(checkpoint, state)
        if (folder.path / TRACKING).exists():
            recorded = read_tracked_run(folder.path)
        else:  # killed before it was recorded, or trained with tracking=off
            commit = plan.provenance.get("git_commit")
            recorded = _described(trainer, composition, names, commit, run_name, tags)
        tracker.open(folder.path, recorded)
    except BadInput:
        folder.release()
        raise
    rows = trainer.replay(rows)
    if read_object(run_dir / SUMMARY).get("stopping"):
        for tag, value in UNDECIDED.items():
            tracker.set_tag(tag, value)
    folder.rewind(rows)
    best, fastest = ((row or {}).get("iteration") for row in (state["best"], trainer.fastest))
    trainer.checkpoints.rewind(iteration, best, fastest)
    folder.write(CONFIG, composition.yaml())
    acting.remember()
    for note in composition.notes:
        logger.warning(note)
    where = f"resumes after iteration {iteration}" if iteration else "had no checkpoint yet: begins again"
    logger.info(where)
    _printing(console)(f"{run_dir.name}: {where}")
    _print_lines([*rounded(experiment), *memory], console)
    if (moved := _moved_schedules(trainer, plan)) is not None:
        logger.warning(moved)
    for why in _differences_to_uninterrupted(experiment, setup):
        logger.warning("the result will not be that of an uninterrupted run: %s", why)
    return trainer


def _forget_damaged_best(run_dir: Path, state: dict[str, Any]) -> None:
    """Forget the best policy so far if its checkpoint cannot be read any more: a later one will be the best."""
    if state["best"] is None:
        return
    name = checkpoint_name(state["best"]["iteration"])
    try:
        check(run_dir / CHECKPOINTS / name)
    except BadInput as error:
        logger.warning(
            "the best checkpoint so far, %s, is lost: %s; a later one will be the best", name, error
        )
        state["best"] = None


def _moved_schedules(trainer: Trainer, plan: ResumePlan) -> str | None:
    """Warn of rates that a new budget changes at once, with the override that holds them; None: there are none."""
    before, now = parse_config(dict(plan.stored["budget"]), BudgetConfig), plan.experiment.budget
    budgets = [Budget(config) for config in (before, now)]
    old, new = (
        trainer.agent.rates(trainer.iteration, budget.scheduled(*trainer.usage)) for budget in budgets
    )
    moved = [
        f"{name} goes from {old[name]:.2g} to {new[name]:.2g}"
        for name in old
        if not math.isclose(old[name], new[name], rel_tol=0.01, abs_tol=1e-12)
    ]
    if not moved:
        return None
    (_, used_before), (limit, used_now) = (budget.used(*trainer.usage) for budget in budgets)
    held = schedule_until(before.schedule_until * used_now / used_before)
    return (
        f"budget.{limit}={getattr(now, limit):g}: with this budget the {' and the '.join(moved)}; add {held} to hold "
        "the schedule of the run"
    )


def _print_lines(lines: Sequence[str], console: Console) -> None:
    for line in lines:
        logger.info(line)
        _printing(console)(line)


def _printing(console: Console) -> Callable[[str], None]:
    """Return a function that prints a line as it is, above the progress view if there is one."""
    return lambda line: console.print(line, soft_wrap=True)


def _run(trainer: Trainer, interruption: Interruption) -> TrainResult:
    """Train, and write the ending, whatever it is."""
    try:
        return _ended(trainer, interruption)
    except TakenOver:
        trainer.release()
        raise


def _ended(trainer: Trainer, interruption: Interruption) -> TrainResult:
    try:
        ending, code = trainer.fit(interruption), interruption.exit_code
        return trainer.end(ending if code is None else replace(ending, status=INTERRUPTED), code or 0)
    except (RunFailed, BadInput) as error:  # BadInput: a file of the run was removed or changed meanwhile
        return trainer.fail(str(error), error)
    except OSError as error:
        return trainer.fail(f"{error.filename or trainer.folder.path}: {error.strerror or error}", error)
    except TakenOver:
        raise
    except KeyboardInterrupt:
        # No checkpoint, since an update may be half done, and no pictures.
        reason = "without the iteration in progress" if interruption.left_out else "by a second signal"
        ending = Ending(INTERRUPTED, f"ended at once {reason}")
        return trainer.end(ending, interruption.exit_code or 130)
    except Exception as error:
        if is_refused_memory(error):
            cars, frames = (
                trainer.experiment.collector.cars,
                trainer.experiment.algorithm.frames_per_iteration,
            )
            what = f"collector.cars={cars}, algorithm.frames_per_iteration={frames}: {NO_MEMORY}"
            return trainer.fail(what, error, RunFailed.exit_code if trainer.row else BadInput.exit_code)
        if own_error := _own_error(error, trainer.experiment):
            return trainer.fail(own_error, error)
        # A bug: its traceback is shown, but the run must not look as if it were running.
        trainer.fail(f"{type(error).__name__}: {error}", error)
        raise


def _own_error(error: Exception, experiment: Experiment) -> str | None:
    """Return a line for an error in a run with classes of the user's own, which it blames; None: it has none."""
    classes = list(own_classes(asdict(experiment)))
    if not classes or isinstance(error, BadInput):
        return None
    modules = [target.partition(":")[0] for _, target in classes]
    frames = list(traceback.walk_tb(error.__traceback__))
    theirs = [entry for entry in frames if entry[0].f_globals.get("__name__") in modules]
    frame, line = (theirs or frames)[-1]
    targets = ", ".join(f"{group}.target={target}" for group, target in classes)
    return f"{type(error).__name__}: {error} ({Path(frame.f_code.co_filename).name}, line {line}; with {targets})"


def _differences_to_uninterrupted(experiment: Experiment, setup: RaceSetup) -> list[str]:
    """Return why a resumed run cannot equal an uninterrupted one bit for bit."""
    why = []
    by_clock = experiment.budget.minutes is not None
    if by_clock and getattr(experiment.lr_schedule, "by", "fraction") == "fraction":
        why.append("the learning rate follows the clock (budget.minutes, lr_schedule.by=fraction)")
    algorithm = experiment.algorithm
    if by_clock and isinstance(algorithm, PPOConfig) and algorithm.entropy_end_factor != 1:
        why.append("the entropy bonus follows the clock (budget.minutes, algorithm.entropy_end_factor)")
    if any(isinstance(node, ast.Global) for node in ast.walk(ast.parse(setup.reward.text))):
        why.append(
            f"the reward function {setup.reward.name} keeps something in a global variable, which is lost"
        )
    return why


def _names(composition: Composition, track: str, reward: str) -> dict[str, str]:
    """Return readable names of the run's choices: an option's name, a file's stem, the folder of custom_files."""
    choices, mapping = composition.choices, composition.mapping
    actions_file = mapping["action_space"].get("file")
    return {
        "track": track,
        "reward": reward,
        "action_space": Path(actions_file).stem if actions_file else choices["action_space"],
        "network": choices["network"],
        "lr_schedule": choices["lr_schedule"],
    } | dict(composition.names)
