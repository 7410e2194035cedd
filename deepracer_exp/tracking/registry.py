"""Checkpoints in MLflow's model registry: register them under an alias and look them up."""

import json
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepracer_exp.config.experiment import safe_name
from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.runs.checkpoint_files import checkpoint_sha256, find_checkpoint, pin, verify
from deepracer_exp.runs.clean import StoreOverview
from deepracer_exp.runs.run_files import (
    BEST_LAP,
    CHECKPOINTS,
    METRICS,
    REPORT,
    full_name,
    read_metrics,
    read_run_id,
)

from .calls import CALL_S, ended_within, pages
from .download import Download, download
from .metadata import picture, race_result
from .mlflow_metrics import metric_names
from .store import Store, client_of, existing_store, has_store, open_client

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel

_RUN_DIR, _CHECKPOINT, _SHA256 = "run_dir", "checkpoint", "sha256"
"""Tags of a version."""


@dataclass(frozen=True)
class Registered:
    """A version of a registered model: a checkpoint of a run."""

    model: str
    alias: str
    version: str
    run_dir: Path
    """The run's folder when it was registered."""
    checkpoint: str
    """Name of its folder."""
    sha256: str
    """Hash of the checkpoint."""
    model_id: str
    """MLflow's id of the logged model that has the files of the checkpoint."""
    run_id: str

    def __str__(self) -> str:
        return f"{self.model}@{self.alias}"


def is_alias(text: str) -> bool:
    """Return whether this is a valid alias.

    It starts with a letter, unlike a run's folder, and MLflow reserves `latest` and `v1`.
    """
    is_name = re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,79}", text) is not None
    return is_name and text.lower() != "latest" and not re.fullmatch(r"[vV]\d+", text)


def check_alias(what: str, alias: str) -> None:
    """Refuse an invalid alias; `what` begins the message."""
    if not is_alias(alias):
        raise BadInput(
            what,
            f"{alias!r} is not an alias",
            "a letter, then letters, digits, '_' and '-', at most 80; not latest and not v1, v2, ..., which MLflow "
            "reserves",
        )


def check_model(what: str, model: str) -> None:
    """Refuse an invalid model name; `what` begins the message."""
    try:
        safe_name(model)
    except ValueError as error:
        raise BadInput(what, f"{model!r} is not a model name: {error}") from None


def look_up(reference: str, uri: str | None, runs_dir: Path) -> Registered:
    """Look up `MODEL@ALIAS`, or `ALIAS` if exactly one model has it, in a store.

    Raises:
        BadInput: no model or several have it, it was not registered by this program, or the store does not answer.
    """
    model, separator, alias = reference.rpartition("@")
    check_alias(reference, alias)
    if separator:
        check_model(reference, model)
    aliases = _aliases(reference, uri, runs_dir)
    matches = [pair for pair in aliases if pair == (model, alias) or (not separator and pair[1] == alias)]
    if len(matches) == 1:
        with open_client(reference, uri, runs_dir) as client:
            return _registered(reference, client.get_model_version_by_alias(*matches[0]), alias)
    names = [f"{name}@{alias_name}" for name, alias_name in matches or aliases]
    if matches:
        raise BadInput(
            reference,
            f"ambiguous: {len(matches)} models have this alias: {', '.join(names[:5])}; give MODEL@ALIAS",
        )
    raise BadInput(
        reference,
        f"no registered model has this alias{nearest(reference, names)}; known: {', '.join(names[:10]) or 'none'}; "
        "deepracer-exp runs promote registers one",
    )


def _aliases(what: str, uri: str | None, runs_dir: Path) -> list[tuple[str, str]]:
    """Return model and name of each alias; a file is read without MLflow, which takes seconds to import."""
    if has_store(uri, runs_dir) and (file := existing_store(uri, runs_dir).sqlite_file) is not None:
        with suppress(sqlite3.Error), closing(sqlite3.connect(file)) as database:
            return database.execute("SELECT name, alias FROM registered_model_aliases").fetchall()
    with open_client(what, uri, runs_dir) as client:
        models = pages(client.search_registered_models)
        return [(model.name, name) for model in models for name in model.aliases]


def promote(
    run: Path,
    name: str,
    model: str,
    alias: str,
    features: Sequence[str],
    seen: Mapping[str, tuple[int, ...]],
    uri: str | None,
    runs_dir: Path,
) -> Registered:
    """Register a checkpoint as a version of a model and give it the alias.

    `name` is `best`, `last`, `fastest` or the number of an iteration; `features` and `seen` describe the observation.
    The alias is taken from the version that has it.

    The version is a logged model of MLflow: the checkpoint's files, the run's report and picture, a signature, and the
    checkpoint's evaluation as metrics. The checkpoint is pinned in the run's folder. A checkpoint that already is a
    version is not registered again.

    Raises:
        BadInput: a name is invalid, the checkpoint is missing or corrupt, the run is not recorded in this store or was
            deleted there, or the store does not answer.
    """
    check_model("--model", model)
    check_alias("--alias", alias)
    folder = find_checkpoint(run / CHECKPOINTS, name).resolve()
    verify(folder)
    run_id = read_run_id(run)
    if run_id is None:
        raise BadInput(
            run,
            "is not recorded in MLflow (another tracking=, or the store was down), so it cannot be registered",
        )
    tags = {_RUN_DIR: str(run.resolve()), _CHECKPOINT: folder.name, _SHA256: checkpoint_sha256(folder)}
    what = f"promote {full_name(run)}"
    with open_client(what, uri, runs_dir) as client:
        recorded = client.get_run(run_id).info
        if recorded.lifecycle_stage != "active":
            raise BadInput(what, f"was deleted in MLflow (run {run_id}); restore it there")
        pin(run / CHECKPOINTS, folder.name, f"registered as {model}")
        if not any(registered.name == model for registered in pages(client.search_registered_models)):
            client.create_registered_model(
                model, description=f"Policies of `deepracer-exp`, experiment `{model}`."
            )
        versions = pages(client.search_model_versions, filter_string=f"name = '{model}'")
        version = next((candidate for candidate in versions if candidate.tags.items() >= tags.items()), None)
        if version is None:
            row = _row_of(run, folder)
            metrics = _evaluated(row)
            store, experiment_id = existing_store(uri, runs_dir), recorded.experiment_id
            logged = _log_model(
                client,
                store,
                experiment_id,
                run_id,
                run,
                folder,
                tags,
                features,
                seen,
                metrics,
                row.get("env_steps"),
            )
            shown = f"Checkpoint {int(folder.name)} of `{full_name(run)}`: {race_result(metrics)}.\n\n{picture(run_id)}"
            version = _version_of(client, logged.model_id, model, run_id, tags, shown)
        client.set_registered_model_alias(model, alias, version.version)
        return _registered(what, version, alias)


def _row_of(run: Path, checkpoint: Path) -> dict[str, Any]:
    """Return the metrics of a checkpoint's iteration, nothing where they are missing."""
    file = run / METRICS
    rows = read_metrics(file) if file.exists() else []
    (row,) = [row for row in rows if row["iteration"] == int(checkpoint.name)] or [{}]
    return row


def _evaluated(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the evaluation of an iteration by metric name in MLflow."""
    named = metric_names(row)
    return {key: value for key, value in named.items() if key.startswith("race/") and value is not None}


def _log_model(
    client: "MlflowClient",
    store: Store,
    experiment_id: str,
    run_id: str,
    run: Path,
    checkpoint: Path,
    tags: Mapping[str, str],
    features: Sequence[str],
    seen: Mapping[str, tuple[int, ...]],
    metrics: Mapping[str, float],
    env_steps: int | None,
) -> "LoggedModel":
    """Log a checkpoint as a model of MLflow, with the tensors and JSON of the run's folder.

    `metrics` were measured after `env_steps`.
    """
    import numpy as np
    from mlflow.models import Model, ModelSignature
    from mlflow.types import Schema, TensorSpec

    # MLflow accepts no dots, colons or quotes in this name, which nothing reads.
    name = re.sub(r"[^A-Za-z0-9_-]", "_", f"{run.name}-{checkpoint.name}")
    logged = client.create_logged_model(experiment_id, name, run_id, dict(tags), model_type="policy")
    files = store.files_at(logged.artifact_location)
    observed = [
        TensorSpec(np.dtype(np.uint8 if key == "pixels" else np.float32), (-1, *shape), key)
        for key, shape in seen.items()
    ]
    command = TensorSpec(np.dtype(np.float32), (-1, 2), "command")
    described = Model(
        run_id=run_id,
        model_id=logged.model_id,
        signature=ModelSignature(Schema(observed), Schema([command])),
        flavors={"deepracer_exp": {"checkpoint": "checkpoint", "format": "torchrl.checkpoint"}},
        metadata={
            "observation": list(features) if "observation" in seen else list(seen),
            "command": ["steering_deg", "speed_mps"],
        },
    )
    with tempfile.TemporaryDirectory() as aside:
        described.save(str(Path(aside) / "MLmodel"))
        for name in (BEST_LAP, REPORT):
            if (run / name).exists():
                shutil.copy(run / name, aside)
        ended_within(CALL_S, partial(files.log_artifacts, aside))
    ended_within(CALL_S, partial(files.log_artifacts, str(checkpoint), "checkpoint"))
    for key, value in metrics.items():
        # The same point as the run's own, so that its curve has no duplicate.
        points = [point for point in client.get_metric_history(run_id, key) if point.step == env_steps]
        moment_ms = points[-1].timestamp if points else None
        client.log_metric(run_id, key, value, moment_ms, env_steps, model_id=logged.model_id)
    return client.finalize_logged_model(logged.model_id, "READY")


def _version_of(
    client: "MlflowClient", model_id: str, model: str, run_id: str, tags: Mapping[str, str], description: str
) -> Any:
    """Register a logged model as a version, so that MLflow's pages link to each other."""
    import mlflow

    # With a database MLflow looks up the logged model in the process's default store.
    mlflow.set_tracking_uri(client.tracking_uri)
    try:
        version = client.create_model_version(
            model, f"models:/{model_id}", run_id, dict(tags), description=description, model_id=model_id
        )
    finally:
        mlflow.set_tracking_uri(None)
    versions = json.dumps([{"name": model, "version": version.version}])
    client.set_logged_model_tags(model_id, {"mlflow.modelVersions": versions})
    return version


def read_overview(uri: str | None, runs_dir: Path) -> StoreOverview:
    """Read which runs a store has, which of them were deleted, and which checkpoints are registered.

    Raises:
        BadInput: the store does not answer.
    """
    with open_client("MLflow", uri, runs_dir) as client:
        from mlflow.entities import ViewType

        experiments = pages(client.search_experiments, view_type=ViewType.ALL)
        runs = pages(
            client.search_runs,
            experiment_ids=[experiment.experiment_id for experiment in experiments],
            run_view_type=ViewType.ALL,
        )
        deleted = {run.info.run_id: run.info.lifecycle_stage != "active" for run in runs}
        registered = {
            (full_name(Path(version.tags[_RUN_DIR])), version.tags[_CHECKPOINT])
            for version in pages(client.search_model_versions)
            if version.tags.keys() >= {_RUN_DIR, _CHECKPOINT}
        }
    return StoreOverview(deleted, registered)


def _registered(what: str, version: Any, alias: str) -> Registered:
    run_dir, checkpoint, sha256 = (version.tags.get(key) for key in (_RUN_DIR, _CHECKPOINT, _SHA256))
    if not run_dir or not sha256 or not re.fullmatch(r"\d{6,9}", checkpoint or ""):
        raise BadInput(
            what,
            f"version {version.version} of {version.name} was not registered by deepracer-exp runs promote",
        )
    model_id = str(version.source).removeprefix("models:/")
    return Registered(
        version.name, alias, str(version.version), Path(run_dir), checkpoint, sha256, model_id, version.run_id
    )


def download_folder(run_dir: Path, runs_dir: Path) -> Path:
    """Return the place in `runs_dir` of a run whose folder was elsewhere.

    Raises:
        BadInput: its name or that of its experiment is not one that a training gives.
    """
    for name in (run_dir.parent.name, run_dir.name):
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
            raise BadInput(run_dir, f"{name!r} is not the name of a run or an experiment")
    return runs_dir / run_dir.parent.name / run_dir.name


def fetch(registered: Registered, uri: str | None, runs_dir: Path) -> Path:
    """Download a registered checkpoint with its run from a store; return the run's folder.

    The folder is where it would be if the run had been trained in `runs_dir`.

    Raises:
        BadInput: a name cannot be one of a run, another run has that folder, or `download` fails.
    """
    store = existing_store(uri, runs_dir)
    client_of(store)  # leaves user and password in the environment, which the download inherits
    target = download_folder(registered.run_dir, runs_dir)
    if read_run_id(target) not in (None, registered.run_id):
        raise BadInput(
            registered,
            f"{target} is another run, so its checkpoint cannot be downloaded to it; give runs_dir=",
        )
    wanted = Download(
        uri=store.uri,
        model_id=registered.model_id,
        run_id=registered.run_id,
        checkpoint=registered.checkpoint,
        sha256=registered.sha256,
        with_run=not target.exists(),
    )
    download(str(registered), wanted, store, target)
    return target
