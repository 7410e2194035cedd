"""Complete the records of run folders in MLflow after their training."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.labels import USER_TAG, Labels, read_labels
from deepracer_exp.runs.run_files import SUMMARY, TRACKING, read_object, read_run_id, run_folders
from deepracer_exp.runs.run_result import FAILED, FINISHED, STOPPED_EARLY

from .calls import StoreRefusedError, StoreUnavailableError, run_if_there
from .metadata import NAME, USER_NOTE, label_tags
from .mlflow_metrics import now_ms, points_at
from .projection import MLflowProjection
from .store import has_store, open_client, prepare_mlflow, resolve_store
from .tracking_file import Status, read_recorded, read_tracked_run, write_tracked_run

ENDS: dict[str, Status] = {FINISHED: "FINISHED", STOPPED_EARLY: "FINISHED", FAILED: "FAILED"}
"""MLflow's word for the `status` in a run's summary; any other is KILLED."""

_log = logging.getLogger(__name__)


def deliver(run_dir: Path, uri: str | None, runs_dir: Path) -> int:
    """Complete an ended run in MLflow and mark it as ended; return the number of metric points that were missing.

    `uri` is the store, as in `tracking.uri` with its password; None: the one in `runs_dir`.

    Raises:
        BadInput: a file is missing, the run has not ended, or MLflow refuses (the run was deleted there).
        RunFailed: the store does not answer; try again later.
    """
    tracked, summary = read_tracked_run(run_dir), read_object(run_dir / SUMMARY)
    if not summary:
        raise BadInput(
            run_dir,
            "has no summary.json, so the run has not ended; only ended runs can be recorded afterwards",
        )
    store = resolve_store(uri, runs_dir)
    if tracked.store != store.shown:
        tracked = replace(tracked, store=store.shown, run_id=None, complete=False)
    if tracked.status is None:  # killed before it recorded its end
        tracked = replace(tracked, status=ENDS.get(summary["status"], "KILLED"), end_ms=now_ms())
    write_tracked_run(run_dir, tracked)
    projection = MLflowProjection(store, run_dir)
    try:
        problem = projection.update()
    except StoreUnavailableError as error:
        raise RunFailed(
            f"{run_dir}: MLflow ({store.shown}) does not answer; the run folder keeps what is missing there:"
            f" {error}"
        ) from error
    if problem is not None:
        raise BadInput(run_dir, f"MLflow ({store.shown}) {problem}")
    if (run_id := read_run_id(run_dir)) is not None:
        # Without those that were removed while the store was away.
        deliver_labels(run_id, read_labels(run_dir), uri, runs_dir)
    return projection.written


def deliver_evaluation(
    run_dir: Path,
    uri: str | None,
    runs_dir: Path,
    env_steps: int,
    metrics: Mapping[str, float | None],
    files: Mapping[Path, str],
) -> None:
    """Record the results of evaluating a checkpoint of a recorded run in MLflow; errors are logged.

    `uri` and `runs_dir` are as for `deliver`, `env_steps` are those of the checkpoint, `metrics` have MLflow's names,
    `files` map each file to its folder in MLflow.
    """
    run_id = read_run_id(run_dir)
    if run_id is None or not has_store(uri, runs_dir):
        return
    store, recorded = resolve_store(uri, runs_dir), read_object(run_dir / TRACKING).get("store")
    try:
        if recorded is not None and not store.is_named(recorded):
            raise StoreRefusedError(f"its run is in {recorded}; give tracking.uri={recorded}")
        prepare_mlflow()
        from .mlflow_run import MLflowRun

        run = MLflowRun(store)
        run.run_id = run_id
        run.log(points_at(metrics, env_steps, now_ms()))
        for file, folder in files.items():
            run.log_artifact(file, folder)
    except (StoreRefusedError, StoreUnavailableError) as error:
        _log.warning(
            "MLflow (%s): this evaluation was not recorded; evaluate again later: %s",
            store.shown,
            error,
        )


def is_delivered(run_dir: Path, uri: str | None, runs_dir: Path) -> bool:
    """Return whether a store has everything of an ended run, according to its folder; MLflow is not imported.

    Raises:
        BadInput: tracking.json is invalid, or `uri` can never work.
    """
    run, store = read_tracked_run(run_dir), resolve_store(uri, runs_dir)
    is_whole = read_recorded(run_dir).has_all_of(run)
    return is_whole and store.is_named(run.store) and has_store(uri, runs_dir)


def undelivered(folders: Iterable[Path]) -> dict[Path, str]:
    """Return the ended runs that are incomplete in their store, each with that store, without password.

    Runs that were not recorded in MLflow are left out; MLflow is not imported.

    Raises:
        BadInput: a tracking.json is invalid.
    """
    ended = [folder for folder in folders if (folder / TRACKING).exists() and (folder / SUMMARY).exists()]
    tracked = {folder: read_tracked_run(folder) for folder in ended}
    return {
        folder: run.store
        for folder, run in tracked.items()
        if run.store and not read_recorded(folder).has_all_of(run)
    }


def deliver_labels(run_id: str, labels: Labels, uri: str | None, runs_dir: Path) -> None:
    """Record a run's name, note and tags in MLflow, without those it had before.

    Raises:
        BadInput: the store does not answer or refuses.
    """
    with open_client(run_id, uri, runs_dir) as client:
        tags, wanted = client.get_run(run_id).data.tags, label_tags(labels)
        for key in tags:
            if key not in wanted and (key == USER_NOTE or key.startswith(USER_TAG)):
                client.delete_tag(run_id, key)
        for key, value in wanted.items():
            client.set_tag(run_id, key, value)


def recorded_labels(run_id: str, uri: str | None, runs_dir: Path) -> Labels:
    """Return the name, note and tags that a run has in MLflow; raises as `deliver_labels`."""
    with open_client(run_id, uri, runs_dir) as client:
        tags = client.get_run(run_id).data.tags
    labels = {key.removeprefix(USER_TAG): value for key, value in tags.items() if key.startswith(USER_TAG)}
    return Labels(tags.get(NAME), tags.get(USER_NOTE), labels)


@contextmanager
def marked_deleted(run_dir: Path, run_id: str, uri: str | None, runs_dir: Path) -> Iterator[None]:
    """Mark a run as deleted in the store that recorded it, once the block has removed its folder.

    The store is asked first, so that nothing is removed where it does not answer; `uri` as for `deliver`. `mlflow gc`
    removes the run there for good.

    Raises:
        BadInput: the run was recorded in another store, or this one does not answer.
    """
    recorded = read_recorded(run_dir).store
    if not resolve_store(uri, runs_dir).is_named(recorded):
        raise BadInput(
            run_dir, f"was recorded in {recorded}; give tracking.uri={recorded} to delete it there"
        )
    if not has_store(uri, runs_dir):
        yield
        return
    with open_client(f"{run_dir}: nothing was deleted", uri, runs_dir) as client:
        run = run_if_there(client, run_id)  # gone after `mlflow gc`, or in a new store
        is_active = run is not None and run.info.lifecycle_stage == "active"
    # A copy of the folder has the same record, which is not its own to delete.
    others = (folder for folder in run_folders(runs_dir) if folder.resolve() != run_dir.resolve())
    is_active = is_active and not any(read_run_id(folder) == run_id for folder in others)
    yield
    if is_active:
        with open_client(f"{run_dir}: deleted here, but not marked in MLflow", uri, runs_dir) as client:
            client.delete_run(run_id)
