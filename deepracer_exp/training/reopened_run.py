"""Resuming a run from its last checkpoint."""

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from deepracer_exp.config import acting
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import PPOConfig
from deepracer_exp.config.parse import parse_config
from deepracer_exp.config.running import BudgetConfig
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.rival_run import kept_rival
from deepracer_exp.rewards.source import keeps_state
from deepracer_exp.runs.checkpoints import check, checkpoint_name, intact_checkpoint, read_training
from deepracer_exp.runs.fingerprint import refuse_changes
from deepracer_exp.runs.folder import RunFolder
from deepracer_exp.runs.next_steps import schedule_until
from deepracer_exp.runs.run_files import (
    CHECKPOINTS,
    CONFIG,
    METRICS,
    REWARD,
    SUMMARY,
    TRACKING,
    read_object,
)
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.tracking.tracker import open_tracker
from deepracer_exp.tracking.tracking_file import begin_again, is_copy, read_tracked_run
from deepracer_exp.training.stopping.stopping_rules import UNDECIDED

from .budget import Budget
from .callbacks import standard_callbacks
from .display import print_lines, printing
from .machine import memory_needed
from .new_run import described, try_reward
from .plan import ResumePlan
from .rounding import rounded
from .trainer import Callback, Trainer

logger = logging.getLogger("deepracer_exp")


def reopen_run(
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
    try_reward(experiment, setup)
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
            if is_copy(folder.path):
                begin_again(folder.path, folder.path)
            recorded = read_tracked_run(folder.path)
        else:  # killed before it was recorded, or trained with tracking=off
            commit = plan.provenance.get("git_commit")
            recorded = described(trainer, composition, names, commit, run_name, tags)
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
    printing(console)(f"{run_dir.name}: {where}")
    print_lines([*rounded(experiment), *memory], console)
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
        f"budget.{limit}={getattr(now, limit)}: with this budget the {' and the '.join(moved)}; add {held} to hold "
        "the schedule of the run"
    )


def _differences_to_uninterrupted(experiment: Experiment, setup: RaceSetup) -> list[str]:
    """Return why a resumed run cannot equal an uninterrupted one bit for bit."""
    why = []
    by_clock = experiment.budget.minutes is not None
    if by_clock and getattr(experiment.lr_schedule, "by", "fraction") == "fraction":
        why.append("the learning rate follows the clock (budget.minutes, lr_schedule.by=fraction)")
    algorithm = experiment.algorithm
    if by_clock and isinstance(algorithm, PPOConfig) and algorithm.entropy_end_factor != 1:
        why.append("the entropy bonus follows the clock (budget.minutes, algorithm.entropy_end_factor)")
    if keeps_state(setup.reward):
        why.append(f"the reward function {setup.reward.name} remembers earlier calls, which are lost")
    return why
