"""Download a registered checkpoint and its run's files from MLflow, for a run without a folder here.

It runs in a separate process, which can be killed whatever it waits for, and whose writes the kernel limits.
"""

import json
import os
import re
import resource
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from deepracer_exp.errors import BadInput, writing
from deepracer_exp.files import read_json
from deepracer_exp.lifeline import running
from deepracer_exp.patience import communicate
from deepracer_exp.runs.checkpoint_files import HASHES, checkpoint_sha256, verify
from deepracer_exp.runs.run_files import (
    CHECKPOINTS,
    CONFIG,
    METRICS,
    OVERRIDES,
    PROVENANCE,
    REWARD,
    SUMMARY,
    WRITTEN,
)
from deepracer_exp.scratch import folder_aside

from .calls import StoreRefusedError, StoreUnavailableError, store_errors
from .store import Store, client_of

_MOST_FILES = 100
_LONGEST_S = 600.0
_RUN_FILES = (CONFIG, OVERRIDES, PROVENANCE, REWARD, SUMMARY, METRICS)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_CHECKPOINT = "checkpoint"
"""Folder of the checkpoint in the logged model."""
_MODULE = "deepracer_exp.tracking.download"


@dataclass(frozen=True)
class Download:
    """A download: the files and their origin."""

    uri: str
    """Address of the store, with the password of a database: it comes on standard input, which `ps` does not show."""
    model_id: str
    """MLflow's id of the logged model that has the checkpoint."""
    run_id: str
    checkpoint: str
    """Name of the checkpoint's folder."""
    sha256: str
    """Hash of the checkpoint."""
    with_run: bool
    """Whether to download the run's files as well."""
    most_bytes: int = 512 * 2**20
    """Limit for all files together; the largest checkpoint of the project, one that sees pictures, has 30 MB."""


def download(what: str, wanted: Download, store: Store, target: Path) -> None:
    """Download a registered checkpoint with its run into `target`, or the checkpoint alone if the run is there.

    Its hashes are compared, and it is moved into place whole. `what` begins the message.

    Raises:
        BadInput: the store lacks a file, does not answer in time, or sends something other than the registered
            checkpoint.
    """
    what = f"{what}: MLflow ({store.shown})"
    with ExitStack() as stack:
        with writing(f"runs_dir={target.parent.parent}"):
            target.parent.mkdir(parents=True, exist_ok=True)
            aside = stack.enter_context(folder_aside(target.parent, ".download-"))
        _run(what, wanted, aside)
        checkpoint = aside / CHECKPOINTS / wanted.checkpoint
        verify(checkpoint)
        if checkpoint_sha256(checkpoint) != wanted.sha256:
            raise BadInput(what, "its files are not those of the registered checkpoint: their hash differs")
        with writing(target):
            if target.exists():
                place = target / CHECKPOINTS / wanted.checkpoint
                place.parent.mkdir(exist_ok=True)
                checkpoint.replace(place)
            else:
                aside.replace(target)


def _run(what: str, wanted: Download, folder: Path) -> None:
    # -P: modules come from where they are installed, not from the working folder.
    command = [sys.executable, "-P", "-m", _MODULE, str(folder)]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with running(command, **pipes) as process:
        try:
            _, said = communicate(process, _LONGEST_S, json.dumps(wanted.__dict__).encode())
        except TimeoutError as silence:
            raise BadInput(what, f"the download has not ended within {silence}") from None
    if process.returncode:
        lines = said.decode(errors="replace").strip().splitlines() or ["the download ended"]
        raise BadInput(what, lines[-1])


def _fetch(wanted: Download, folder: Path) -> None:
    """Download everything into `folder`, laid out as a run."""
    store = Store(wanted.uri, None, os.environ.get("MLFLOW_TRACKING_USERNAME"))
    client = client_of(store)
    if wanted.with_run:
        files = store.files_at(client.get_run(wanted.run_id).info.artifact_uri)
        there = {file.path for file in files.list_artifacts()}
        if CONFIG not in there:
            raise StoreRefusedError(
                f"has no {CONFIG} of run {wanted.run_id}, without which it cannot be raced"
            )
        for name in _RUN_FILES:
            if name in there:  # an imported model has no metrics
                _fetch_file(files, name, folder, wanted.most_bytes)
    model = client.get_logged_model(wanted.model_id)
    files = store.files_at(model.artifact_location)
    _fetch_file(files, f"{_CHECKPOINT}/{HASHES}", folder, wanted.most_bytes)
    hashes = read_json(folder / _CHECKPOINT / HASHES, WRITTEN)
    for name in _checked_names(hashes):
        _fetch_file(files, f"{_CHECKPOINT}/{name}", folder, wanted.most_bytes)
    (folder / CHECKPOINTS).mkdir()
    (folder / _CHECKPOINT).replace(folder / CHECKPOINTS / wanted.checkpoint)


def _fetch_file(repository: Any, name: str, folder: Path, most_bytes: int) -> None:
    from mlflow.exceptions import MlflowException

    used = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(most_bytes - used, 0), hard))
    try:
        repository.download_artifacts(name, str(folder))
    except (OSError, MlflowException) as error:
        if "File too large" in str(error):
            raise StoreRefusedError(f"has more than {most_bytes:,} bytes of files for it") from None
        raise


def _checked_names(hashes: Any) -> list[str]:
    """Return the names of a checkpoint's files."""
    names = list(hashes) if isinstance(hashes, dict) else []
    for name in names:
        parts = PurePosixPath(name).parts
        if not all(_NAME.fullmatch(part) for part in parts) or "/".join(parts) != name:
            raise StoreRefusedError(f"names {name!r} as a file of a checkpoint")
    if not 0 < len(names) <= _MOST_FILES:
        raise StoreRefusedError(f"names {len(names)} files of a checkpoint; accepted: 1 to {_MOST_FILES}")
    return names


def _main() -> int:
    wanted = Download(**json.load(sys.stdin))
    try:
        with store_errors():
            _fetch(wanted, Path(sys.argv[1]))
    except (StoreRefusedError, StoreUnavailableError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main())
