"""What a run could not record while it went on, recorded from its folder."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.formats.run_files import read_metrics, read_object, read_run_id

from .lookup import has_store
from .names import END_TAG
from .points import now_ms, points_at, points_of
from .store import one_line, resolve_store
from .tracking_file import NAME, Status, Told, TrackingFile

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

ENDS: dict[str, Status] = {"finished": "FINISHED", "hopeless": "FINISHED", "failed": "FAILED"}
"""MLflow's word for the `status` in a run's summary; any other is KILLED."""

_log = logging.getLogger(__name__)


def deliver(run_dir: Path, uri: str | None, runs_dir: Path) -> int:
    """Record in MLflow what it lacks of a run that has ended and is not to go on, and mark the run as ended.

    Args:
        run_dir: the run's folder.
        uri: the store, as in `tracking.uri` with its password; None: the one in `runs_dir`.
        runs_dir: where runs are.

    Returns:
        The number of metric points that were missing.

    Raises:
        BadInput: the folder lacks what is needed, the run has not ended, or MLflow refuses (it was deleted there).
        RunFailed: the store does not answer; it may be tried again.
    """
    summary = read_object(run_dir / "summary.json")
    if not summary:
        raise BadInput(
            f"{run_dir}: has no summary.json, so the run has not ended; only ended runs are delivered"
        )
    metrics = run_dir / "metrics.jsonl"
    rows = read_metrics(metrics) if metrics.exists() else []
    store = resolve_store(uri, runs_dir)
    file = TrackingFile.read(run_dir / NAME, store.shown)
    from .mlflow_run import MLflowRun, StoreRefusedError, StoreUnavailableError

    run = MLflowRun(store)
    try:
        run.connect()
        run.reopen(file.told)
        file.change(run_id=run.run_id)
        run.log_params(file.told.params)
        written = run.log_metrics(
            [point for row in rows for point in points_of(row, row["env_steps"], file.told.start_ms)]
        )
        _log_files(run, run_dir, file.told)
        run.conclude(file.told, summary)
        run.set_tags({END_TAG: f"{summary['status']}: {summary['reason']}"})
        run.end(file.told.status or ENDS.get(summary["status"], "KILLED"), file.told.end_ms or now_ms())
    except StoreRefusedError as error:
        raise BadInput(f"{run_dir}: MLflow ({store.shown}) refused it: {one_line(error)}") from error
    except StoreUnavailableError as error:
        raise RunFailed(
            f"{run_dir}: MLflow ({store.shown}) does not answer; the folder keeps what is missing there:"
            f" {one_line(error)}"
        ) from error
    return written


def deliver_evaluation(
    run_dir: Path,
    uri: str | None,
    runs_dir: Path,
    env_steps: int,
    metrics: Mapping[str, float | None],
    files: Mapping[Path, str],
) -> None:
    """Record in MLflow what an evaluation of one of a run's checkpoints found; what goes wrong is logged.

    Args:
        run_dir: the run's folder; a run that is not recorded is left so.
        uri: the store, as in `tracking.uri`; None: the one in `runs_dir`.
        runs_dir: where runs are.
        env_steps: of the checkpoint.
        metrics: by their names in MLflow.
        files: and the folder that each gets there.
    """
    run_id = read_run_id(run_dir)
    if run_id is None or not has_store(uri, runs_dir):
        return
    store = resolve_store(uri, runs_dir)
    from .mlflow_run import MLflowRun, StoreRefusedError, StoreUnavailableError

    run = MLflowRun(store)
    run.run_id = run_id
    try:
        run.connect()
        run.log_metrics(points_at(metrics, env_steps, now_ms()))
        for file, folder in files.items():
            run.log_artifact(file, folder)
    except (StoreRefusedError, StoreUnavailableError) as error:
        _log.warning("MLflow (%s) does not have this evaluation: %s", store.shown, one_line(error))


def _log_files(run: "MLflowRun", run_dir: Path, told: Told) -> None:
    for name, folder in told.files.items():
        path = run_dir / name
        if not path.resolve().is_relative_to(run_dir.resolve()):
            # What was not written by the run may be anything by now.
            _log.warning("%s: lies outside the run's folder, so MLflow does not get it", path)
        elif path.exists():
            run.log_artifact(path, folder)
        else:
            _log.warning("%s: is gone, so MLflow does not get it", path)
