"""Which run a name, an id, `best:EXPERIMENT` or a registered alias stands for."""

import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from deepracer_exp.config import acting
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.runs.checkpoint_files import LINKS, checkpoint_sha256, restore_links, verify
from deepracer_exp.runs.files import BEST, CHECKPOINTS, CONFIG, RUN, is_run, read_config, run_folders
from deepracer_exp.runs.labels import named_folders
from deepracer_exp.tracking.registry import Registered, download_folder, fetch, is_alias, look_up
from deepracer_exp.tracking.store import has_store, is_run_id, open_client

from .best import best_of

logger = logging.getLogger("deepracer_exp")


@dataclass(frozen=True)
class StoredRun:
    """A run found on disk."""

    path: Path
    checkpoint: str | None = None
    """Name of the checkpoint, if the run was given by a registered model's alias."""
    registered: str | None = None
    """That alias, as MODEL@ALIAS."""

    @cached_property
    def experiment(self) -> Experiment:
        """Configuration of the run, without values that act and are not the user's own (`config.acting`).

        Raises:
            BadInput: it cannot be read, or was written by another version.
        """
        from deepracer_exp.config.parse import parse_experiment

        mapping = read_config(self.path)
        acting.leave_out_foreign(mapping, self.path.name)
        try:
            return parse_experiment(mapping)
        except BadInput as error:
            raise BadInput(self.path / CONFIG, f"{error}; was the run made by another version?") from None

    @property
    def checkpoints(self) -> Path:
        """The folder of its checkpoints."""
        restore_links(self.path / CHECKPOINTS)
        return self.path / CHECKPOINTS

    def choose_checkpoint(self, given: str | None) -> str:
        """Return the name of the checkpoint to use.

        `given` is `best`, `last` or an iteration; None: the alias's, or the best. A run that ended before its first
        evaluation has no best: its last is used, with a warning.
        """
        name = given or self.checkpoint
        best, last = (self.checkpoints / link for link in LINKS)
        if name is None and not (best.is_symlink() or best.exists()) and last.exists():
            logger.warning(
                "%s: ended before its policy was evaluated, so checkpoint=last is used", self.path.name
            )
            return "last"
        return name or "best"


def resolve(run: str, runs_dir: Path, tracking_uri: str | None) -> StoredRun:
    """Find a run.

    Args:
        run: its folder, the folder's name or the beginning of it; MLflow's id; `best:EXPERIMENT`; or the alias of a
            registered model, `MODEL@ALIAS` or, where exactly one model has it, `ALIAS`.
        runs_dir: where runs are.
        tracking_uri: where ids and aliases are looked up; None: in `runs_dir`.

    Raises:
        BadInput: no run or several match, or a registered checkpoint has changed since.
    """
    if run.startswith(BEST):
        return StoredRun(best_of(run.removeprefix(BEST), runs_dir))
    with reading(run, RUN):
        for folder in (Path(run).expanduser(), runs_dir / run):
            if is_run(folder):
                return StoredRun(folder)
    if is_run_id(run):
        return StoredRun(_present(run, folder_of(run, tracking_uri, runs_dir), runs_dir))
    if "@" in run and "/" not in run:
        return _of_registered(run, look_up(run, tracking_uri, runs_dir), runs_dir, tracking_uri)
    folders = run_folders(runs_dir)
    matches = [folder for folder in folders if folder.name == run]
    matches = matches or [folder for folder in folders if folder.name.startswith(run)]
    matches = matches or named_folders(folders, run)
    if len(matches) == 1:
        return StoredRun(matches[0])
    if matches:
        names = ", ".join(str(folder.relative_to(runs_dir)) for folder in matches[:3])
        raise BadInput(run, f"ambiguous: {len(matches)} runs match: {names}{', ...' * (len(matches) > 3)}")
    unknown = f"no such run in {runs_dir} ({len(folders)} there){nearest(run, [f.name for f in folders])}"
    if any(folder.parent.name == run for folder in folders):
        unknown += f"; {BEST}{run} is the best run of that experiment"
    if not is_alias(run) or not has_store(tracking_uri, runs_dir):
        raise BadInput(run, unknown, RUN)
    try:
        registered = look_up(run, tracking_uri, runs_dir)
    except BadInput as error:
        raise BadInput(run, f"{unknown}; {error.without(run)}") from None
    return _of_registered(run, registered, runs_dir, tracking_uri)


def _of_registered(run: str, found: Registered, runs_dir: Path, tracking_uri: str | None) -> StoredRun:
    """Return the run of a registered checkpoint, which must be as it was; it is downloaded where it is not."""
    places = found.run_dir, download_folder(found.run_dir, runs_dir)
    path = next((one for one in places if (one / CHECKPOINTS / found.checkpoint).is_dir()), None)
    if path is None:
        path = fetch(found, tracking_uri, runs_dir)
        logger.warning("%s was downloaded from MLflow to %s", found, path)
    checkpoint = path / CHECKPOINTS / found.checkpoint
    verify(checkpoint)
    if checkpoint_sha256(checkpoint) != found.sha256:
        raise BadInput(
            run,
            f"{checkpoint} is not the checkpoint that was registered as {found}, version {found.version}: its hash "
            "differs; give the run and checkpoint= to use it anyway",
        )
    return StoredRun(path, found.checkpoint, str(found))


def _present(run: str, folder: Path, runs_dir: Path) -> Path:
    """Return the folder of a recorded run, where it is or where all runs have moved to."""
    moved = runs_dir / folder.parent.name / folder.name
    found = next((place for place in (folder, moved) if is_run(place)), None)
    if found is None:
        raise BadInput(run, f"its folder {folder} is gone; give the folder where it is now")
    return found


def folder_of(run_id: str, uri: str | None, runs_dir: Path) -> Path:
    """Return the folder of a recorded run in a store as of `open_client`.

    Raises:
        BadInput: the store has no such run, it was deleted there, or the store does not answer.
    """
    with open_client(run_id, uri, runs_dir) as client:
        run = client.get_run(run_id)
    if run.info.lifecycle_stage != "active":
        raise BadInput(run_id, "was deleted in MLflow; restore it there")
    if "run_dir" not in run.data.tags:
        raise BadInput(run_id, "has no tag run_dir, so it is not a run of deepracer-exp")
    return Path(run.data.tags["run_dir"])
