"""A sweep from its overrides to its winner."""

import collections
import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from optuna.study import Study
from optuna.trial import FrozenTrial
from rich.console import Console

from deepracer_exp.config.compose import compose_evaluation, compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import group_of, key_of
from deepracer_exp.config.running import TrackingConfig, TrackingOff
from deepracer_exp.config.sweep import SweepConfig, SweepRequest, compose_sweep
from deepracer_exp.env.reward import RewardFunction
from deepracer_exp.env.setup import build_setup
from deepracer_exp.errors import BadInput
from deepracer_exp.tracking.store import Store, resolve_store
from deepracer_exp.tracking.study_run import Progress, StudyRun, open_study_run
from deepracer_exp.tracking.tracking_file import Status
from deepracer_exp.training.signals import Interruption

from .best import best_line, best_shown, best_trial, best_values, complete_trials, write_best
from .database import resolve_database
from .driver import Driver
from .launch import Launcher, LocalLauncher
from .ledger import Ledger, Slot
from .plan import Plan
from .pruners import build_pruner
from .samplers import build_sampler
from .space import SearchSpace
from .storage import Storage, open_storage, patiently
from .study import MAY_DIFFER, completed, find_study, goes_on, load_study, open_study
from .table import SweepView
from .telling import tell_settled, tell_strays
from .trial_run import Interrupted

_DELIVERY_S, _FAREWELL_S = 30.0, 2.0
"""How long MLflow is waited for when a sweep is over, and when it was interrupted and can resume."""
REPORT = "sweep.html"
"""A study's page, in the folder of its runs."""


def sweep(overrides: Sequence[str], console: Console) -> tuple[Study, Path, int]:
    """Make the trials of a study that are still missing.

    Args:
        overrides: as given on the command line.
        console: stderr's, for the view.

    Returns:
        The study, the folder of its runs, and the exit code.

    Raises:
        BadInput: before anything is begun; nothing is left.
        RunFailed: all trials fail, or the database stays away.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    overrides, request, known = whole_request(overrides)
    runs_dir = _runs_dir(request)
    config = request.entry.sweep
    protocol = compose_evaluation(["run=any", f"evaluation={config.protocol}"])[0].evaluation
    request = _without_rules(request, overrides)
    parent = _parent(request, runs_dir, known)
    space = SearchSpace.from_request(request, _check(request, parent, runs_dir))
    build_sampler(config, space)
    build_pruner(config)
    experiment = _experiment(request, parent, space, runs_dir)
    store = _store(experiment, runs_dir)
    with contextlib.closing(_launcher(config, runs_dir, store)) as launcher:
        storage = open_storage(config.storage, runs_dir)
        study = open_study(request, overrides, space, parent, storage, runs_dir)
        study_run, study_run_id = begin_study_run(request, space, experiment.tracking, storage, runs_dir)
        plan = Plan(
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
        if plan.study_run_id is not None:
            study.set_user_attr("mlflow_run_id", plan.study_run_id)
        status: Status = "FAILED"
        code = 0
        try:
            code = _driven(plan, storage, study, launcher, console, study_run)
            status = "KILLED" if code else "FINISHED"
        except KeyboardInterrupt:  # the second one
            status, code = "KILLED", 130
        finally:
            if study_run is not None:
                study_run.finish(status, _FAREWELL_S if code else _DELIVERY_S)
        return study, plan.folder, code


def whole_request(overrides: Sequence[str]) -> tuple[list[str], SweepRequest, Study | None]:
    """Return what is asked for, with what a study that is to go on knows itself, and that study.

    Raises:
        BadInput: an override is not accepted, there is nothing to search, or no study of that name to go on with.
    """
    request = compose_sweep(overrides)
    known = _known(request, goes_on(overrides), _runs_dir(request))
    if known is None:
        return list(overrides), request, None
    whole = completed(overrides, known)
    request = compose_sweep(whole)
    if not request.space:
        raise BadInput(
            f"study={request.study}: exists; to go on with it only {', '.join(MAY_DIFFER)} may be given beside its "
            "name; for anything else give the whole search again"
        )
    return whole, request, known


def begin_study_run(
    request: SweepRequest, space: SearchSpace, tracking: TrackingConfig, storage: Storage, runs_dir: Path
) -> tuple[StudyRun | None, str | None]:
    """Begin the run of a study in MLflow, or go on with it; return it with its id.

    Args:
        request: what is asked for.
        space: of the request.
        tracking: of the trials.
        storage: of the study.
        runs_dir: where its runs are.

    Returns:
        None, None with `tracking=off`; no id where the store does not answer.
    """
    # MLflow cannot be told to make a run only where there is none: one driver at a time looks and makes it.
    with resolve_database(request.entry.sweep.storage, runs_dir).creation_lock(storage.engine):
        objectives = request.entry.sweep.objectives
        run = open_study_run(tracking, runs_dir, request.study, objectives, space.as_text(), request.base)
        return run, None if run is None else run.wait_for_id()


def _driven(
    plan: Plan,
    storage: Storage,
    study: Study,
    launcher: Launcher,
    console: Console,
    study_run: StudyRun | None,
) -> int:
    ledger, patience_s = Ledger(storage.engine, plan.study), plan.config.patience_s

    def record(slots: Sequence[Slot]) -> None:
        if study_run is not None:
            study_run.update(_progress(slots, plan, study))

    with Interruption() as interruption, SweepView(plan, launcher.workers, console) as view:
        slots = patiently(ledger.slots, patience_s)
        view.show(slots)
        if not ledger.is_done(plan.config.trials):
            code = Driver(plan, storage, launcher, view, record).run(interruption)
            if code is not None:
                return code
        for call in (tell_settled, tell_strays):
            patiently(partial(call, plan.study, ledger, storage.optuna), patience_s)
        try:
            _conclude(plan, study, view, ledger, interruption)
        except Interrupted:
            assert interruption.exit_code is not None
            return interruption.exit_code
        record(patiently(ledger.slots, patience_s))
    if study_run is not None:
        study_run.pictures([plan.folder / REPORT])
    return 0


def _progress(slots: Sequence[Slot], plan: Plan, study: Study) -> Progress:
    """Return how far the study is, for MLflow."""
    counts = collections.Counter(slot.outcome for slot in slots)
    steps = sum(slot.attrs.get("env_steps", 0) for slot in slots)
    told: dict[str, Any] = {
        "total": plan.config.trials,
        "complete": counts["COMPLETE"],
        "pruned": counts["PRUNED"],
        "failed": counts["FAIL"],
        "env_steps": steps,
    }
    if not complete_trials(study):
        return Progress(**told)
    best = best_trial(study)
    return Progress(
        **told,
        best_trial=best.number,
        best_values=dict(zip(plan.config.objectives, best_values(study), strict=True)),
        best_shown=best_shown(study),
        best_line=best_line(study),
        lap_time_s=best.user_attrs.get("lap_time_s"),
        completion=best.user_attrs.get("completion"),
    )


def _conclude(plan: Plan, study: Study, view: SweepView, ledger: Ledger, interruption: Interruption) -> None:
    """Find the winner, and write what is told of the study.

    Raises:
        Interrupted: the process was told to end while the best trials drove.
    """
    # Both take seconds to import, and workers shall begin before.
    from .report import write_report

    if complete_trials(study) and plan.config.rerank:
        import torch

        from .rerank import rerank

        torch.set_num_threads(1)

        def heed(*_: object) -> None:
            if interruption.signum is not None:
                raise Interrupted

        def tell(trial: FrozenTrial) -> None:
            heed()
            view.stage = f"trial {trial.number} drives {plan.config.rerank_laps} fresh laps"
            view.show(ledger.slots())

        again = [{**asdict(one), "interval": list(one.interval)} for one in rerank(plan, study, tell, heed)]
        study.set_user_attr("reranked_of", len(complete_trials(study)))
        study.set_user_attr("reranked", again)
        view.stage = ""
        view.show(ledger.slots())
    else:
        study.set_user_attr("reranked", [])
    if complete_trials(study):
        write_best(study, plan.runs_dir)
    write_report(study, plan.folder / REPORT)


def _runs_dir(request: SweepRequest) -> Path:
    given = [line.partition("=")[2] for line in request.base if line.partition("=")[0] == "runs_dir"]
    return Path(compose_experiment([f"runs_dir={given[-1]}"] if given else [])[0].runs_dir)


def _known(request: SweepRequest, must_be_there: bool, runs_dir: Path) -> Study | None:
    """Return the study that is asked for by its name, if it is there; no file is made for looking."""
    if request.entry.study is None:
        return None
    if request.entry.sweep.storage is None and not (runs_dir / "sweeps.db").exists():
        return None
    find = load_study if must_be_there else find_study
    return find(request.study, open_storage(request.entry.sweep.storage, runs_dir))


def _without_rules(request: SweepRequest, overrides: Sequence[str]) -> SweepRequest:
    """Let trials end by a stopping rule only where the pruner `entropy` is asked for, or a rule beside the pruners.

    Args:
        request: what is asked for.
        overrides: of it; where they choose the pruners, the rule that a ready-made sweep has with its own is not meant.
    """
    if "entropy" in request.entry.sweep.pruners:
        return request
    chosen = any(key_of(line) == "sweep.pruners" for line in overrides)
    told = overrides if chosen else (*request.base, *request.space)
    if "stopping" in map(group_of, told):
        return request
    base = [line for line in request.base if group_of(line) != "stopping"]
    return replace(request, base=(*base, "stopping=none"))


def _parent(request: SweepRequest, runs_dir: Path, known: Study | None) -> tuple[str, ...]:
    """Return what names the parent's run and checkpoint, as `Plan.parent`.

    `best:NAME` and aliases lead elsewhere some day: they are looked up when a study is begun.
    """
    parent = request.entry.parent
    if parent is None:
        return ()
    if known is not None and known.user_attrs.get("parent") == parent and "parent_run" in known.user_attrs:
        return tuple(known.user_attrs["parent_run"])

    from deepracer_exp.training.clone import prepare_clone

    try:
        _, lineage = prepare_clone([f"run={parent}", f"name={request.study}"], runs_dir, None).start
    except BadInput as error:
        raise BadInput(f"parent={parent}: {str(error).removeprefix(f'run={parent}: ')}") from error
    return f"run={lineage.parent_dir}", f"checkpoint={int(lineage.checkpoint)}"


def _check(request: SweepRequest, parent: tuple[str, ...], runs_dir: Path) -> Any:
    """Return what tries overrides: None as a training does, else as clones of the parent do."""
    if not parent:
        return None

    from deepracer_exp.training.clone import prepare_clone

    def check(overrides: list[str]) -> Mapping[str, Any]:
        clone = prepare_clone([*parent, *overrides, f"name={request.study}"], runs_dir, None)
        return clone.composition.mapping

    return check


def _experiment(
    request: SweepRequest, parent: tuple[str, ...], space: SearchSpace, runs_dir: Path
) -> Experiment:
    """Return the experiment of one trial, and read its files."""
    if parent:
        from deepracer_exp.training.clone import prepare_clone

        line = [*parent, *space.example(), f"name={request.study}"]
        return prepare_clone(line, runs_dir, None).experiment
    experiment, _ = compose_experiment(space.example())
    setup = build_setup(experiment)
    RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    return experiment


def _store(experiment: Experiment, runs_dir: Path) -> Store | None:
    tracking = experiment.tracking
    return None if isinstance(tracking, TrackingOff) else resolve_store(tracking.uri, runs_dir)


def _evaluations(experiment: Experiment, request: SweepRequest) -> int | None:
    """Return how often a trial is evaluated on its way, None where that is not known or differs between trials."""
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


def _launcher(config: SweepConfig, runs_dir: Path, store: Store | None) -> Launcher:
    if config.executor.kind == "local":
        return LocalLauncher(config.workers)
    from .ray_launch import RayLauncher

    return RayLauncher(config, config.executor, runs_dir, store)
