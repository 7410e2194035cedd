"""Set-up of a new run: a test call of its reward function, its folder, and its name and tags."""

import json
import logging
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType

import torch
from rich.console import Console

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.own_class import own_classes
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.errors import BadInput, RunFailed, count, reading
from deepracer_exp.evaluation.rival_run import keep_rival
from deepracer_exp.rewards.reward import RewardFunction
from deepracer_exp.runs.checkpoint_files import pin_for_clone
from deepracer_exp.runs.folder import RunFolder
from deepracer_exp.runs.lineage import Lineage, read_lineage
from deepracer_exp.runs.run_files import CHECKPOINTS, LINEAGE
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.sim.batch import CarBatch
from deepracer_exp.tracking.metadata import joined, lineage_tags, run_params, run_tags
from deepracer_exp.tracking.mlflow_metrics import now_ms
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.tracking.tracker import open_tracker
from deepracer_exp.tracking.tracking_file import TrackedRun

from .callbacks import standard_callbacks
from .metrics import track_names
from .plan import TrainPlan
from .trainer import Callback, Trainer

logger = logging.getLogger("deepracer_exp")


def try_out(plan: TrainPlan) -> RaceSetup:
    """Build the race of a plan and run the reward function's module once.

    Raises:
        BadInput: one of them cannot be used, or values contradict.
    """
    setup = build_setup(plan.experiment, files=plan.files)
    try_reward(plan.experiment, setup)
    return setup


def try_reward(experiment: Experiment, setup: RaceSetup) -> None:
    """Run the reward function's module once, let the car stand, and look for the device."""
    RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    with reading(f"car {experiment.car.name}", "dimensions, masses and settings of a car that can stand"):
        CarBatch(setup.car, 1, 1)
    gpus = torch.cuda.device_count()
    if experiment.device != "cpu" and (torch.device(experiment.device).index or 0) >= gpus:
        names = ["cpu", *(f"cuda:{number}" for number in range(gpus))]
        raise BadInput(
            f"device={experiment.device}",
            f"PyTorch finds {count(gpus, 'GPU')} here",
            f"{', '.join(names)}; a resumed run keeps its device, `deepracer-exp clone` may change it",
        )


def begin_run(
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
            assert plan.parent is not None
            pin_for_clone(plan.parent.path / CHECKPOINTS, lineage.checkpoint, folder.path)
        if created is not None:
            created(folder.path)
        trainer.save(best=start is not None and lineage is None)  # of an imported run there is no other
        commit = folder.describe(composition, setup.reward, experiment, names)
    except (OSError, RunFailed) as error:
        folder.remove()
        what = (
            f"cannot write {error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
        )
        raise BadInput(f"runs_dir={experiment.runs_dir}", f"{what}; give a folder with room") from error
    except BaseException as error:
        folder.remove()
        if isinstance(error, Exception) and (reason := own_error(error, experiment)):
            raise BadInput(reason) from error
        raise
    for note in (*composition.notes, *plan.files.remarks):
        logger.info(note)
    if rival is not None:
        logger.info("rival: %s, checkpoint %s", rival.path, rival.checkpoint)
    tracker.open(folder.path, described(trainer, composition, names, commit, run_name, tags))
    return trainer


def described(
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


def own_error(error: Exception, experiment: Experiment) -> str | None:
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


def _names(composition: Composition, track: str, reward: str) -> dict[str, str]:
    """Return readable names of the run's choices: an option's name, a file's stem, the folder of custom_files."""
    choices = composition.choices
    return {
        "track": track,
        "reward": reward,
        "action_space": choices["action_space"],
        "network": choices["network"],
        "lr_schedule": choices["lr_schedule"],
    } | dict(composition.names)
