"""Runs read back from their folders."""

from dataclasses import dataclass
from pathlib import Path

import yaml

from deepracer_exp.config.compose import validate
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.tracking.lookup import folder_of, is_run_id


@dataclass(frozen=True)
class StoredRun:
    """A run as its folder tells it."""

    path: Path
    experiment: Experiment

    @property
    def checkpoints(self) -> Path:
        """Return the folder of its checkpoints."""
        return self.path / "checkpoints"


def read_run(run: str, runs_dir: Path, tracking_uri: str | None) -> StoredRun:
    """Find a run and read its configuration.

    Args:
        run: its folder, the folder's name or the beginning of it, or MLflow's id.
        runs_dir: where runs are.
        tracking_uri: where ids are looked up; None: in `runs_dir`.

    Raises:
        BadInput: no run, or several, are meant, or its configuration is not one of this version.
    """
    path = find_run(run, runs_dir, tracking_uri)
    file = path / "config.yaml"
    try:
        mapping = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise BadInput(f"{file}: cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(mapping, dict):
        raise BadInput(f"{file}: holds no keys; wanted is the config.yaml of a run")
    try:
        return StoredRun(path, validate(mapping))
    except BadInput as error:
        raise BadInput(f"{file}: {error}; was the run made by another version?") from None


def find_run(run: str, runs_dir: Path, tracking_uri: str | None) -> Path:
    """Return the folder of a run; arguments as in `read_run`.

    Raises:
        BadInput: no run, or several, are meant.
    """
    for folder in (Path(run).expanduser(), runs_dir / run):
        if (folder / "config.yaml").is_file():
            return folder
    if is_run_id(run):
        folder = folder_of(run, tracking_uri, runs_dir)
        moved = runs_dir / folder.parent.name / folder.name
        found = next((place for place in (folder, moved) if (place / "config.yaml").is_file()), None)
        if found is None:
            raise BadInput(f"run={run}: its folder {folder} is gone; give the folder where it is now")
        return found
    folders = sorted(file.parent for file in runs_dir.glob("*/*/config.yaml"))
    meant = [folder for folder in folders if folder.name == run]
    meant = meant or [folder for folder in folders if folder.name.startswith(run)]
    if len(meant) == 1:
        return meant[0]
    if meant:
        names = ", ".join(str(folder.relative_to(runs_dir)) for folder in meant[:3])
        raise BadInput(f"run={run}: {len(meant)} runs are meant: {names}{', ...' * (len(meant) > 3)}")
    close = nearest(run, [folder.name for folder in folders])
    raise BadInput(
        f"run={run}: no such run in {runs_dir} ({len(folders)} there){close}; accepted: a run's folder, its name or "
        "the beginning of it, or MLflow's id"
    )
