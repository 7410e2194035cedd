"""Resolve a name, an id, `best:EXPERIMENT` or a registered alias to a run and its checkpoint."""

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.config import acting
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.own_class import OF_POLICY
from deepracer_exp.config.parse import import_own_classes, parse_experiment
from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.runs.checkpoint_files import (
    checkpoint_sha256,
    find_checkpoint,
    restore_links,
    verify,
)
from deepracer_exp.runs.files import (
    BEST,
    CHECKPOINTS,
    CONFIG,
    RUN,
    is_run,
    read_config,
    read_run_id,
    run_folders,
    shortest_names,
)
from deepracer_exp.runs.labels import named_folders
from deepracer_exp.tracking.registry import Registered, download_folder, fetch, is_alias, look_up
from deepracer_exp.tracking.store import has_store, is_run_id, open_client

from .best import best_of

if TYPE_CHECKING:
    from deepracer_exp.runs.checkpoints import StoredPolicy

logger = logging.getLogger("deepracer_exp")


@dataclass(frozen=True)
class StoredRun:
    """A run found on disk."""

    path: Path
    checkpoint: str | None = None
    """Name of the chosen checkpoint: `best`, `last`, `fastest` or an iteration; None: not chosen."""
    was_never_evaluated: bool = False
    """Whether the checkpoint is `last` only because the run ended before it had a best one."""
    registered: str | None = None
    """The registered alias of the checkpoint, as MODEL@ALIAS."""

    @cached_property
    def experiment(self) -> Experiment:
        """Configuration of the run, without values that act and are not the user's own (`config.acting`).

        Raises:
            BadInput: it cannot be read, or was written by another version.
        """
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

    def with_checkpoint(self, name: str | None = None) -> "StoredRun":
        """Return the run with the checkpoint to use.

        `name` is `best`, `last`, `fastest` or an iteration; None: the alias's, or the best. A run that ended before its
        first evaluation has no best: its last is used, with a warning when it is read.

        Raises:
            BadInput: there is no such checkpoint.
        """
        folder, name = self.checkpoints, name or self.checkpoint
        best, last = folder / "best", folder / "last"
        only_last = name is None and not (best.is_symlink() or best.exists()) and last.exists()
        name = "last" if only_last else name or "best"
        find_checkpoint(folder, name)
        return replace(self, checkpoint=name, was_never_evaluated=only_last)

    def with_policy(self, checkpoint: str | None = None) -> "StoredRun":
        """Return the run as `with_checkpoint` does; import the classes of the user's own that its policy needs.

        Raises:
            BadInput: there is no such checkpoint, another version wrote the configuration, or a class is not named
                again or cannot be imported.
        """
        chosen = self.with_checkpoint(checkpoint)
        import_own_classes(chosen.experiment, OF_POLICY)
        return chosen

    def read_policy(self) -> "StoredPolicy":
        """Read the networks of the chosen checkpoint, or of the newest intact one if `best` or `last` is corrupt.

        Raises:
            BadInput: the checkpoint is corrupt or does not fit the configuration.
        """
        from deepracer_exp.runs.checkpoints import read_checkpoint  # imports PyTorch

        if self.was_never_evaluated:
            logger.warning(
                "%s: ended before its policy was evaluated, so checkpoint=last is used", self.path.name
            )
        assert self.checkpoint is not None
        return read_checkpoint(self.experiment, self.checkpoints, self.checkpoint)


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
    if not run.strip():
        raise BadInput(repr(run), "names nothing", RUN)
    if run.startswith(BEST):
        return StoredRun(best_of(run.removeprefix(BEST), runs_dir))
    with reading(run, RUN):
        for folder in (Path(run).expanduser(), runs_dir / run):
            if is_run(folder):
                return StoredRun(folder)
    if is_run_id(run):
        return StoredRun(_recorded(run, runs_dir, tracking_uri))
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
    unknown = f"no such run in {runs_dir} ({len(folders)} there){nearest(run, shortest_names(folders))}"
    if any(folder.parent.name == run for folder in folders):
        unknown += f"; {BEST}{run} is the best run of that experiment"
    if not is_alias(run) or not has_store(tracking_uri, runs_dir):
        raise BadInput(run, unknown, RUN)
    try:
        registered = look_up(run, tracking_uri, runs_dir)
    except BadInput as error:
        raise BadInput(run, f"{unknown}; {error.without(run)}") from None
    return _of_registered(run, registered, runs_dir, tracking_uri)


def _of_registered(run: str, registered: Registered, runs_dir: Path, tracking_uri: str | None) -> StoredRun:
    """Return the run of a registered checkpoint, which must be as it was; it is downloaded where it is not."""
    places = registered.run_dir, download_folder(registered.run_dir, runs_dir)
    path = next((place for place in places if (place / CHECKPOINTS / registered.checkpoint).is_dir()), None)
    if path is None:
        path = fetch(registered, tracking_uri, runs_dir)
        logger.warning("%s was downloaded from MLflow to %s", registered, path)
    checkpoint = path / CHECKPOINTS / registered.checkpoint
    verify(checkpoint)
    if checkpoint_sha256(checkpoint) != registered.sha256:
        raise BadInput(
            run,
            f"{checkpoint} is not the checkpoint that was registered as {registered}, version {registered.version}: "
            "its hash differs; give the run and checkpoint= to use it anyway",
        )
    return StoredRun(path, registered.checkpoint, registered=str(registered))


def _recorded(run: str, runs_dir: Path, tracking_uri: str | None) -> Path:
    """Return the folder of the run with an id, where it was recorded or where all runs have moved to."""
    with open_client(run, tracking_uri, runs_dir) as client:
        recorded = client.get_run(run)
    if recorded.info.lifecycle_stage != "active":
        raise BadInput(run, "was deleted in MLflow; restore it there")
    if "run_dir" not in recorded.data.tags:
        raise BadInput(run, "has no tag run_dir, so it is not a run of deepracer-exp")
    folder = Path(recorded.data.tags["run_dir"])
    for place in (folder, runs_dir / folder.parent.name / folder.name):
        # Another machine may have made a run of the same path.
        if is_run(place) and read_run_id(place) in (None, run):
            return place
    raise BadInput(run, f"its folder {folder} is gone, or another run's; give the folder where it is now")
