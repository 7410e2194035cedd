"""Which run a name, an id, `best:EXPERIMENT` or a registered alias stands for."""

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from deepracer_exp.config import acting
from deepracer_exp.config.experiment import Experiment, safe_name
from deepracer_exp.config.stored import config_differences
from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.files import atomic_write, read_json_as
from deepracer_exp.tracking.registry import Registered, download_folder, fetch, is_alias, look_up
from deepracer_exp.tracking.store import folder_of, has_store, is_run_id

from .checkpoint_files import LINKS, checkpoint_sha256, restore_links, verify
from .files import BEST, BEST_OF_SWEEP, CHECKPOINTS, CONFIG, RUN, is_run, read_config, run_folders
from .labels import named_folders
from .result import RunResult, read_result

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
            raise BadInput(f"{self.path / CONFIG}: {error}; was the run made by another version?") from None

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
        raise BadInput(f"{run}: ambiguous: {len(matches)} runs match: {names}{', ...' * (len(matches) > 3)}")
    unknown = (
        f"{run}: no such run in {runs_dir} ({len(folders)} there){nearest(run, [f.name for f in folders])}"
    )
    if any(folder.parent.name == run for folder in folders):
        unknown += f"; {BEST}{run} is the best run of that experiment"
    if not is_alias(run) or not has_store(tracking_uri, runs_dir):
        raise BadInput(f"{unknown}; accepted: {RUN}")
    try:
        registered = look_up(run, tracking_uri, runs_dir)
    except BadInput as error:
        raise BadInput(f"{unknown}; {str(error).removeprefix(f'{run}: ')}") from None
    return _of_registered(run, registered, runs_dir, tracking_uri)


def best_of(experiment: str, runs_dir: Path) -> Path:
    """Return the folder of an experiment's best run.

    Of a sweep it is the run of its best trial, whatever else was trained under the same name. Otherwise runs whose
    best checkpoint was evaluated are ranked by that; where none was, by the share of complete exploring laps
    and the fastest of them. The newest of equals is taken, and a single run without results, such as an imported model.

    Raises:
        BadInput: there is no such experiment, none of its runs has a result, they cannot be ranked (another car,
            track, evaluation or measure), or the best run of a sweep is gone.
    """
    what = f"{BEST}{experiment}"
    try:
        folder = runs_dir / safe_name(experiment)
    except ValueError as error:
        raise BadInput(f"{what}: {error}") from None
    if (of_sweep := best_run_of_sweep(folder)) is not None:
        return of_sweep
    runs = sorted(file.parent for file in folder.glob(f"*/{CONFIG}"))
    if not runs:
        known = sorted({run.parent.name for run in run_folders(runs_dir)})
        raise BadInput(
            f"{what}: no such experiment in {runs_dir}{nearest(experiment, known)}; "
            f"experiments there: {', '.join(known[:10]) or 'none'}"
        )
    results = {run: result for run in runs if (result := _result(run)) is not None}
    results = {run: one for run, one in results.items() if one.evaluated} or results
    if not results:
        if len(runs) == 1 and (runs[0] / CHECKPOINTS / "best").is_dir():
            return runs[0]
        raise BadInput(
            f"{what}: none of its {len(runs)} runs has a result and a checkpoint `best`; give a run"
        )
    _check_comparable(what, results)
    return max(results, key=lambda run: (results[run].rank, run.name))


@dataclass(frozen=True, kw_only=True)
class BestOfSweep:
    """best_of_sweep.json, which a sweep keeps beside its runs: the best trial of a study and its run."""

    study: str
    trial: Annotated[int, Field(ge=0)]
    """Number of the trial in the study."""
    run_dir: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    """Name of the run's folder beside the file; a name and no path, so that it leads nowhere else."""
    values: dict[str, float]
    """The trial's values, by objective."""


_BEST_OF_SWEEP = TypeAdapter(BestOfSweep)


def write_best_of_sweep(folder: Path, best: BestOfSweep) -> Path:
    """Write the file atomically into the folder of a study's runs."""
    return atomic_write(folder / BEST_OF_SWEEP, json.dumps(asdict(best), indent=1) + "\n")


def read_best_of_sweep(folder: Path) -> BestOfSweep | None:
    """Return the best run of the sweep whose runs are in a folder, None if there is none.

    Raises:
        BadInput: the file cannot be read or holds something else.
    """
    return read_json_as(folder / BEST_OF_SWEEP, _BEST_OF_SWEEP, "a sweep")


def best_run_of_sweep(folder: Path) -> Path | None:
    """Return the folder of the best run of a sweep, None if no sweep has chosen one.

    Raises:
        BadInput: the file was not written by a sweep, or its run is gone or lies elsewhere.
    """
    best = read_best_of_sweep(folder)
    if best is None:
        return None
    run = folder / best.run_dir
    if not is_run(run):
        raise BadInput(
            f"{folder / BEST_OF_SWEEP}: run {best.run_dir} of trial {best.trial} is gone; give another run, "
            f"or delete this file"
        )
    if run.resolve().parent != folder.resolve():
        raise BadInput(f"{folder / BEST_OF_SWEEP}: run {best.run_dir} is a link that leads out of {folder}")
    return run


def _result(run: Path) -> RunResult | None:
    return read_result(run) if (run / CHECKPOINTS / "best").is_dir() else None


def _check_comparable(what: str, results: Mapping[Path, RunResult]) -> None:
    """Refuse runs whose ranks mean different things."""
    first, *others = results
    terms = {run: _terms(read_config(run), result) for run, result in results.items()}
    for run in others:
        for key, value in terms[first].items():
            one, other = value, terms[run][key]
            if one == other:
                continue
            if _short(one) == _short(other):  # of one name
                key, (one, other) = next(iter(config_differences([{key: one}, {key: other}]).items()))
            raise BadInput(
                f"{what}: its runs cannot be ranked: {key} is {_short(one)} in {first.name} and {_short(other)} in "
                f"{run.name}; name one of them, and train what differs under another name="
            )


def _terms(config: Mapping[str, Any], result: RunResult) -> dict[str, Any]:
    """Return what must be the same for ranks to compare."""
    evaluation = config.get("evaluation") or {}
    courses = evaluation.get("tracks") if result.evaluated else None
    return {
        "what they are ranked by": result.measure,
        "car": config.get("car"),
        **({"evaluation": evaluation} if result.evaluated else {}),
        **({} if courses else {"track": config.get("track")}),
    }


def _short(value: Any) -> str:
    """Return the name of an option that has one, else its beginning."""
    if isinstance(value, dict):
        value = value.get("name", value)
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:59]}…"


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
            f"{run}: {checkpoint} is not the checkpoint that was registered as {found}, version {found.version}: "
            "its hash differs; give the run and checkpoint= to use it anyway"
        )
    return StoredRun(path, found.checkpoint, str(found))


def _present(run: str, folder: Path, runs_dir: Path) -> Path:
    """Return the folder of a recorded run, where it is or where all runs have moved to."""
    moved = runs_dir / folder.parent.name / folder.name
    found = next((place for place in (folder, moved) if is_run(place)), None)
    if found is None:
        raise BadInput(f"{run}: its folder {folder} is gone; give the folder where it is now")
    return found
