"""A sweep from its overrides to its winner. Its workers start before this process imports PyTorch."""

import collections
import contextlib
import copy
import logging
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import RDBStorage
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState
from rich.console import Console

from deepracer_exp.config import acting
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import group_of, key_of
from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.config.running import MLflowTracking
from deepracer_exp.config.stored import with_overrides
from deepracer_exp.config.sweep import SweepConfig, SweepRequest
from deepracer_exp.env.real_car import require_car
from deepracer_exp.env.setup import build_setup
from deepracer_exp.errors import BadInput, count, naming
from deepracer_exp.rewards.reward import RewardFunction
from deepracer_exp.runs.lineage import refuse_other_networks
from deepracer_exp.sweeps.queue.study import enqueue, known_settings
from deepracer_exp.sweeps.report.best_trial import (
    best_line,
    best_shown,
    best_trial,
    best_values,
    complete_trials,
    write_best,
)
from deepracer_exp.tracking.store import Store, resolve_store
from deepracer_exp.tracking.study_run import Progress, StudyRun
from deepracer_exp.tracking.tracking_file import Status
from deepracer_exp.training.plan import TrainPlan, plan_training
from deepracer_exp.training.signals import Interruption

from . import PAGE_FILE
from .fresh_laps import rerank
from .plan import SweepPlan
from .queue.claims import Claim, TrialClaims, report_results
from .queue.driver import Driver
from .queue.launcher import LocalLauncher
from .queue.ray_launcher import RayLauncher
from .queue.storage import answering, open_storage, patiently, resolve_database
from .queue.study import open_study
from .queue.worker_config import RUN_ID, Parent, WorkerConfig, plan_trial
from .report.last_race import LAST_RACE, last_race, write_submitted
from .report.view import SweepView
from .search.pruners import build_pruner
from .search.samplers import build_sampler
from .search.space import SearchSpace
from .trial import Interrupted, Trial

_log = logging.getLogger("deepracer_exp")

_DONE_S, _INTERRUPTED_S = 30.0, 2.0
"""Seconds to wait for MLflow at the end of a sweep, and after an interruption."""
_SAME_AS_TRIALS = ("track", "car", "race")
"""Groups that a clone has from its trial: their laps would not compare."""


def sweep(plan: SweepPlan, console: Console) -> tuple[Study, Path, int]:
    """Make the missing trials of a study; return it, the folder of its runs, and the exit code.

    Raises:
        BadInput: before anything is begun; nothing is left behind.
        RunFailed: all trials fail, workers keep dying, the database does not answer, or the clone fails.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    overrides, request = plan.overrides, _without_rules(plan.request, plan.overrides)
    runs_dir, protocol, config = request.runs_dir, request.protocol, request.entry.sweep
    parent = _parent(request, plan.study)
    plan_one = partial(plan_trial, parent=parent, stored=request.stored)
    check = (lambda lines: plan_one(lines).composition.mapping) if parent else None
    space = SearchSpace.from_request(request, check)
    build_sampler(config, space)
    build_pruner(config)
    settings = known_settings(request, space)
    example = plan_one(space.example())
    experiment = example.experiment
    check_clone(example, config, request.stored)
    for note in (*request.composition.notes, *example.composition.notes) if request.stored else ():
        _log.warning(note)
    if parent and protocol.real_car is not None:
        require_car(experiment)
    if not parent:
        setup = build_setup(experiment, files=example.files)
        RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    tracking = experiment.tracking
    store = resolve_store(tracking.uri, runs_dir) if isinstance(tracking, MLflowTracking) else None
    executor = config.executor
    launcher = (
        LocalLauncher(config.workers)
        if executor.kind == "local"
        else RayLauncher(config, executor, runs_dir, store)
    )
    with contextlib.closing(launcher):
        storage = open_storage(config.storage, runs_dir)
        with resolve_database(config.storage, runs_dir).creation_lock(storage.engine):
            study = open_study(request, overrides, space, parent, storage, runs_dir)
            enqueue(study, settings)
        waiting = study.get_trials(deepcopy=False, states=(TrialState.WAITING,))
        if waiting and waiting[-1].number >= config.trials:
            _log.warning(
                "sweep.enqueue: %s wait; sweep.trials=%d drives them",
                count(sum(trial.number >= config.trials for trial in waiting), "setting"),
                waiting[-1].number + 1,
            )
        acting.remember()
        # Only parent runs of a trial's seeds need it; the id of an earlier start may belong to another store.
        waits = config.seeds > 1 or RUN_ID in study.user_attrs
        study_run, study_run_id = begin_study_run(request, space, store, runs_dir, waits=waits)
        worker_config = WorkerConfig(
            study=request.study,
            runs_dir=launcher.folder(runs_dir),
            config=config,
            protocol=protocol,
            space=space,
            parent=parent,
            store=store,
            study_run_id=study_run_id,
            evaluations=_evaluations(experiment, request),
            cores=launcher.cores,
        )
        status: Status = "FAILED"
        code = 0
        try:
            code = _run(worker_config, storage, study, launcher, console, study_run, request.stored)
            status = "KILLED" if code else "FINISHED"
        except KeyboardInterrupt:  # the second one
            status, code = "KILLED", 130
        finally:
            if study_run is not None:
                study_run.finish(status, _INTERRUPTED_S if code else _DONE_S)
        return study, worker_config.folder, code


def check_clone(trial: TrainPlan, config: SweepConfig, stored: bool) -> None:
    """Refuse overrides with which a trial cannot be cloned; `stored` is as for `plan_trial`.

    Raises:
        BadInput: they name something unknown, give a value that is not accepted, or do not fit the trial's networks.
    """
    if config.clone is None:
        return
    with naming("sweep.clone"):
        mapping = copy.deepcopy(trial.composition.mapping)
        changed = with_overrides(mapping, {}, config.clone_overrides, stored=stored)
        clone = parse_experiment(changed.mapping)
        for name in _SAME_AS_TRIALS:
            if getattr(clone, name) != getattr(trial.experiment, name):
                raise BadInput(
                    name, "another one than that of the trials, which the clone is raced against", "theirs"
                )
        plan_training(clone, changed)
        refuse_other_networks(trial.experiment, clone)


def begin_study_run(
    request: SweepRequest,
    space: SearchSpace,
    store: Store | None,
    runs_dir: Path,
    *,
    waits: bool = True,
) -> tuple[StudyRun | None, str | None]:
    """Begin or continue the run of a study in MLflow; return it with its id.

    The id is None if the store does not answer, or if it is not waited for (`waits`): the first trials' runs are then
    put under the study's at the end.
    """
    if store is None:
        return None, None
    folder = runs_dir / request.study
    folder.mkdir(parents=True, exist_ok=True)
    objectives, lock = request.entry.sweep.objectives, folder / ".mlflow.lock"
    run = StudyRun(store, request.study, objectives, space.as_text(), request.base, lock)
    return run, run.wait_for_id() if waits else None


def _run(
    worker_config: WorkerConfig,
    storage: RDBStorage,
    study: Study,
    launcher: LocalLauncher | RayLauncher,
    console: Console,
    study_run: StudyRun | None,
    stored: bool,
) -> int:
    """Run the workers, then derive everything else from the trial claims; return the exit code."""
    claims, patience_s = TrialClaims(storage.engine, worker_config.study), worker_config.config.patience_s

    def track(now: Sequence[Claim]) -> None:
        if study_run is not None:
            study_run.update(progress_of(now, worker_config.config, study))

    with (
        Interruption() as interruption,
        SweepView(worker_config, launcher.workers, console) as view,
        answering(),
    ):

        def show(now: Sequence[Claim], stage: str = "") -> None:
            if study_run is not None and study_run.has_new_id():
                study.set_user_attr(RUN_ID, study_run.run_id)
            view.show(now, stage)

        show(patiently(claims.all, patience_s))
        if not patiently(partial(claims.is_done, worker_config.config.trials), patience_s):
            code = Driver(worker_config, storage, launcher, show, track).run(interruption)
            if code is not None:
                return code
        patiently(partial(report_results, claims, storage), patience_s)
        try:
            _conclude(worker_config, study, view, claims, interruption, stored)
        except Interrupted:
            assert interruption.exit_code is not None
            return interruption.exit_code
        track(patiently(claims.all, patience_s))
    if study_run is not None:
        study_run.log_report(worker_config.folder / PAGE_FILE)
    return 0


def progress_of(claims: Sequence[Claim], config: SweepConfig, study: Study) -> Progress:
    """Return the progress of the study, for MLflow."""
    ended = [claim.trial for claim in claims if claim.has_ended]
    counts = collections.Counter(trial.state for trial in ended)
    counted: dict[str, Any] = {
        "total": config.trials,
        "complete": counts["COMPLETE"],
        "pruned": counts["PRUNED"],
        "failed": counts["FAIL"],
        "env_steps": sum(trial.env_steps for trial in ended),
    }
    if not complete_trials(study):
        return Progress(**counted)
    best = best_trial(study)
    return Progress(
        **counted,
        best_trial=best.number,
        best_values=dict(zip(config.objectives, best_values(study), strict=True)),
        best_shown=best_shown(study),
        best_line=best_line(study),
        lap_time_s=Trial.of(best).lap_time_s,
        completion=Trial.of(best).completion,
    )


def _conclude(
    worker_config: WorkerConfig,
    study: Study,
    view: SweepView,
    claims: TrialClaims,
    interruption: Interruption,
    stored: bool,
) -> None:
    """Find the winner, and write best_of_sweep.json and the page; then the same with the clone, if there is one.

    `stored`: whether the clone's overrides come from the study, not from the user.
    """
    # Imported here: it takes seconds, and the workers start first.
    from .report.page import write_study_page

    config, runs_dir, page = worker_config.config, worker_config.runs_dir, worker_config.folder / PAGE_FILE

    def check(*_: object) -> None:
        if interruption.signum is not None:
            raise Interrupted

    if complete_trials(study) and config.rerank:
        import torch

        torch.set_num_threads(1)

        def show(trial: FrozenTrial) -> None:
            check()
            view.show(claims.all(), f"trial {trial.number} drives {config.rerank_laps} fresh laps")

        again = rerank(worker_config, study, show, check)
        study.set_user_attr("reranked_of", len(complete_trials(study)))
        study.set_user_attr("reranked", [asdict(laps) for laps in again])
        view.show(claims.all())
    else:
        study.set_user_attr("reranked", [])
    # If this is interrupted, the run to submit stays that of the last race.
    if config.clone is None or last_race(study) is None:
        study.set_user_attr(LAST_RACE, None)
        if complete_trials(study):
            write_best(study, runs_dir)
    write_study_page(study, page)
    if complete_trials(study) and config.clone is not None:
        from .last_stage import LastStage

        look = partial(patiently, claims.all, config.patience_s)
        race = LastStage(worker_config, study, stored, view, look, check).run()
        write_submitted(study, runs_dir, race)
        write_study_page(study, page)


def _without_rules(request: SweepRequest, overrides: Sequence[str]) -> SweepRequest:
    """Remove the stopping rule unless the pruner `entropy` or a rule beside the pruners is asked for.

    If the overrides choose the pruners, the rule that a ready-made sweep pairs with its own does not count.
    """
    if "entropy" in request.entry.sweep.pruners:
        return request
    chosen = any(key_of(line) == "sweep.pruners" for line in overrides)
    lines = overrides if chosen else (*request.base, *request.space)
    if "stopping" in map(group_of, lines):
        return request
    base = [line for line in request.base if group_of(line) != "stopping"]
    return replace(request, base=(*base, "stopping=none"))


def _parent(request: SweepRequest, study: Study | None) -> Parent | None:
    """Return the run that trials clone: the stored one of a study that has begun."""
    run = request.entry.parent
    if run is None:
        return None
    if study is not None and study.user_attrs.get("parent") == run and "parent_run" in study.user_attrs:
        return Parent(**study.user_attrs["parent_run"])
    return Parent.find(run, request.study, request.runs_dir, request.tracking_uri)


def _evaluations(experiment: Experiment, request: SweepRequest) -> int | None:
    """Return the number of a trial's evaluations before its end, None if unknown or different between trials."""
    if {key.partition(".")[0] for key in request.space} & {"budget", "checkpoints", "experiment"} or any(
        key == "algorithm" or key.endswith("_per_iteration") for key in request.space
    ):
        return None
    every, algorithm, budget = experiment.checkpoints.every, experiment.algorithm, experiment.budget
    if every is None or algorithm.frames_per_iteration is None:
        return None
    limits = [budget.iterations] if budget.iterations is not None else []
    if budget.env_steps is not None:
        limits.append(-(-budget.env_steps // algorithm.frames_per_iteration))
    return min(limits) // every if limits else None
