"""Start a run, resume one, or continue a copy of one."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from rich.console import Console

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.config import acting
from deepracer_exp.env.setup import build_setup
from deepracer_exp.errors import NO_MEMORY, BadInput, RunFailed, is_refused_memory
from deepracer_exp.runs.run_files import SUMMARY, TRACKING
from deepracer_exp.runs.run_result import FINISHED, INTERRUPTED, Ending
from deepracer_exp.scratch import folder_aside
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.tracking.tracking_file import begin_again

from .clone import describe_clone, read_parent
from .display import print_lines, printing
from .machine import memory_needed
from .new_run import begin_run, own_error, try_out
from .plan import ResumePlan, TrainPlan
from .reopened_run import reopen_run
from .rounding import rounded
from .signals import Interruption
from .train_result import TakenOver, TrainResult
from .trainer import Callback, Trainer


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
    with Interruption(printing(console)) as interruption:
        if isinstance(plan, ResumePlan):
            return _run(reopen_run(plan, console, callbacks, report, run_name, tags, projector), interruption)
        start = None
        if plan.parent is not None:
            start = read_parent(plan.parent)
            for note in describe_clone(plan.parent, plan.experiment, start[1]):
                printing(console)(note)
        setup = try_out(plan)
        memory = memory_needed(plan.experiment)
        trainer = begin_run(
            plan, setup, console, start, callbacks, report, run_name, tags, created, projector
        )
        acting.remember()  # of a stored model (`store_run`) nothing has been used
        print_lines([*rounded(plan.experiment), *memory], console)
        return _run(trainer, interruption)


def store_run(plan: TrainPlan, networks: PolicyNetworks, reason: str) -> TrainResult:
    """Store networks that were trained elsewhere as a run without iterations.

    The reward function is not run. `networks` are its checkpoint, best and last; `reason` names their origin in the
    summary.

    Raises:
        BadInput: as for `run_training`; no folder is left.
    """
    setup = build_setup(plan.experiment, files=plan.files)
    trainer = begin_run(plan, setup, Console(quiet=True), (networks, None))
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
        if blamed := own_error(error, trainer.experiment):
            return trainer.fail(blamed, error)
        # A bug: its traceback is shown, but the run must not look as if it were running.
        trainer.fail(f"{type(error).__name__}: {error}", error)
        raise
