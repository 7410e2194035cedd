"""Checkpoints in MLflow's registry of models: put there under an alias, and found again by it."""

import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepracer_exp.config.experiment import safe_name
from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.formats.checkpoint_files import HASHES, checkpoint_sha256, pin, verify
from deepracer_exp.formats.run_files import read_run_id

from .lookup import asked

if TYPE_CHECKING:
    from mlflow import MlflowClient

_RUN_DIR, _CHECKPOINT, _SHA256 = "run_dir", "checkpoint", "sha256"
"""Tags of a version."""


@dataclass(frozen=True, kw_only=True)
class Registered:
    """A version of a model: a checkpoint of a run."""

    model: str
    alias: str
    version: str
    run_dir: Path
    """Where the run's folder was when it was registered."""
    checkpoint: str
    """Name of its folder."""
    sha256: str
    """Hash of the checkpoint."""

    def __str__(self) -> str:
        return f"{self.model}@{self.alias}"


def is_alias(text: str) -> bool:
    """Return whether an alias may be called so.

    It begins with a letter, as no run's folder does, and MLflow keeps `latest` and `v1` for itself.
    """
    is_name = re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,79}", text) is not None
    return is_name and text.lower() != "latest" and not re.fullmatch(r"[vV]\d+", text)


def check_alias(what: str, alias: str) -> None:
    """Refuse an alias that cannot be; `what` is the beginning of the complaint.

    Raises:
        BadInput: it cannot.
    """
    if not is_alias(alias):
        raise BadInput(
            f"{what}: {alias!r} is no alias; accepted: a letter, then letters, digits, '_' and '-', at most 80; "
            "not latest and not v1, v2, ..., which MLflow keeps for itself"
        )


def check_model(what: str, model: str) -> None:
    """Refuse the name of a model that cannot be; `what` is the beginning of the complaint.

    Raises:
        BadInput: it cannot.
    """
    try:
        safe_name(model)
    except ValueError as error:
        raise BadInput(f"{what}: {model!r} is no model: {error}") from None


def look_up(reference: str, uri: str | None, runs_dir: Path) -> Registered:
    """Return what `MODEL@ALIAS` stands for, or `ALIAS` where exactly one model has it.

    Args:
        reference: either.
        uri: the store, as in `tracking.uri`; None: the one in `runs_dir`.
        runs_dir: where runs are.

    Raises:
        BadInput: none or several stand for it, it is none of ours, or the store does not answer.
    """
    what = f"run={reference}"
    model, at, alias = reference.rpartition("@")
    check_alias(what, alias)
    if at:
        check_model(what, model)
    with asked(what, uri, runs_dir) as client:
        known = [(found.name, name) for found in _models(client) for name in found.aliases]
        meant = [one for one in known if one == (model, alias) or (not at and one[1] == alias)]
        if len(meant) == 1:
            version = client.get_model_version_by_alias(*meant[0])
            return _registered(what, version, alias)
    names = [f"{name}@{given}" for name, given in known]
    if meant:
        raise BadInput(
            f"{what}: {len(meant)} models have this alias: {', '.join(names[:5])}; give MODEL@ALIAS"
        )
    raise BadInput(
        f"{what}: no registered model has this alias{nearest(reference, names)}; "
        f"known: {', '.join(names[:10]) or 'none'}; deepracer-exp promote registers one"
    )


def promote(run: Path, name: str, model: str, alias: str, uri: str | None, runs_dir: Path) -> Registered:
    """Register a checkpoint as a version of a model, and give that version the alias.

    The checkpoint's files go to the run's files in MLflow, unless they are there, and the checkpoint stays in the
    run's folder from now on. A checkpoint that is a version already becomes none a second time.

    Args:
        run: its folder.
        name: of the checkpoint: `best`, `last` or the number of an iteration.
        model: made where there is none of this name.
        alias: taken from the version that has it.
        uri: the store, as in `tracking.uri`; None: the one in `runs_dir`.
        runs_dir: where runs are.

    Raises:
        BadInput: a name cannot be, the checkpoint is missing or torn, the run is not recorded in this store or was
            deleted there, or the store does not answer.
    """
    check_model("--model", model)
    check_alias("--alias", alias)
    folder = _folder(run, name)
    verify(folder)
    run_id = read_run_id(run)
    if run_id is None:
        raise BadInput(
            f"{run}: is not recorded in MLflow (tracking=off, or no store answered), so it cannot be registered there"
        )
    tags = {
        _RUN_DIR: str(run.resolve()),
        _CHECKPOINT: folder.name,
        _SHA256: checkpoint_sha256(folder),
    }
    what = f"promote {run.name}"
    with asked(what, uri, runs_dir) as client:
        recorded = client.get_run(run_id)
    if recorded.info.lifecycle_stage != "active":
        raise BadInput(f"{what}: was deleted in MLflow (run {run_id}); restore it there")
    pin(run / "checkpoints", folder.name, f"registered as {model}")
    with asked(what, uri, runs_dir) as client:
        place = f"checkpoints/{folder.name}"
        if not _is_there(client, run_id, place, folder):
            client.log_artifacts(run_id, str(folder), place)
        if not any(found.name == model for found in _models(client)):
            client.create_registered_model(model)
        versions = pages(client.search_model_versions, filter_string=f"name = '{model}'")
        version = next((found for found in versions if found.tags.items() >= tags.items()), None)
        if version is None:
            source = f"{recorded.info.artifact_uri}/{place}"
            version = client.create_model_version(model, source, run_id, tags)
        client.set_registered_model_alias(model, alias, version.version)
        return _registered(what, version, alias)


def registered_checkpoints(client: "MlflowClient") -> set[tuple[str, str]]:
    """Return every checkpoint that is a version of a model: name of the run's folder, name of the checkpoint's."""
    return {
        (Path(version.tags[_RUN_DIR]).name, version.tags[_CHECKPOINT])
        for version in pages(client.search_model_versions)
        if version.tags.keys() >= {_RUN_DIR, _CHECKPOINT}
    }


def _registered(what: str, version: Any, alias: str) -> Registered:
    run_dir, checkpoint, sha256 = (version.tags.get(key) for key in (_RUN_DIR, _CHECKPOINT, _SHA256))
    if not run_dir or not sha256 or not re.fullmatch(r"\d{6,9}", checkpoint or ""):
        raise BadInput(
            f"{what}: version {version.version} of {version.name} was not registered by deepracer-exp promote"
        )
    return Registered(
        model=version.name,
        alias=alias,
        version=str(version.version),
        run_dir=Path(run_dir),
        checkpoint=checkpoint,
        sha256=sha256,
    )


def _folder(run: Path, name: str) -> Path:
    """Return a checkpoint's own folder."""
    folder = run / "checkpoints" / (f"{int(name):06d}" if name.isdigit() else name)
    if not folder.is_dir():
        raise BadInput(
            f"--checkpoint {name}: {folder} is not there; accepted: best, last or an iteration that is"
        )
    return folder.resolve()


def _is_there(client: "MlflowClient", run_id: str, place: str, folder: Path) -> bool:
    """Return whether the run's files have this very checkpoint, whole."""
    wanted = {
        f"{place}/{file.relative_to(folder).as_posix()}": file.stat().st_size
        for file in folder.rglob("*")
        if file.is_file()
    }
    if dict(_artifacts(client, run_id, place)) != wanted:
        return False
    with tempfile.TemporaryDirectory() as aside:
        theirs = Path(client.download_artifacts(run_id, f"{place}/{HASHES}", aside))
        return theirs.read_bytes() == (folder / HASHES).read_bytes()


def _artifacts(client: "MlflowClient", run_id: str, place: str) -> Iterator[tuple[str, int]]:
    for found in client.list_artifacts(run_id, place):
        if found.is_dir:
            yield from _artifacts(client, run_id, found.path)
        else:
            yield found.path, found.file_size


def _models(client: "MlflowClient") -> Iterator[Any]:
    return pages(client.search_registered_models)


def pages(search: Callable[..., Any], **what: Any) -> Iterator[Any]:
    """Return what one of the client's searches finds, on all its pages."""
    token = None
    while True:
        page = search(**what, page_token=token)
        yield from page
        token = page.token
        if not token:
            return
