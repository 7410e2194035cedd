"""Resolve a name, an id, `best:EXPERIMENT` or a registered alias to a run and its checkpoint."""

import logging
from pathlib import Path

from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.runs.best_run import best_of
from deepracer_exp.runs.checkpoint_files import (
    checkpoint_sha256,
    verify,
)
from deepracer_exp.runs.labels import named_folders
from deepracer_exp.runs.run_files import (
    BEST,
    CHECKPOINTS,
    RUN,
    is_run,
    read_run_id,
    run_folders,
    shortest_names,
)
from deepracer_exp.runs.stored_run import StoredRun

from .registry import Registered, download_folder, fetch, is_alias, look_up
from .store import has_store, is_run_id, open_client

logger = logging.getLogger("deepracer_exp")


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
        path = Path(run).expanduser()
        if len(path.parts) < 2 or ".." in path.parts:
            path = path.resolve()  # the folders above it are its experiment and runs_dir
        for folder in (path, runs_dir / run):
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
    recorded = registered.run_dir
    # In runs that were copied as a whole, not in those they were copied from.
    here = runs_dir / recorded.parent.name / recorded.name
    places = here, recorded, download_folder(recorded, runs_dir)
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
    # In runs that were copied as a whole, not in those they were copied from.
    for place in (runs_dir / folder.parent.name / folder.name, folder):
        # Another machine may have made a run of the same path.
        if is_run(place) and read_run_id(place) in (None, run):
            return place
    raise BadInput(run, f"its folder {folder} is gone, or another run's; give the folder where it is now")
