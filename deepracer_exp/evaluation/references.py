"""What a racer calls a run by, turned into the run's folder."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepracer_exp.config.experiment import safe_name
from deepracer_exp.errors import BadInput, nearest, reading
from deepracer_exp.formats.best_of_sweep import run_of_sweep
from deepracer_exp.formats.checkpoint_files import checkpoint_sha256, verify
from deepracer_exp.formats.run_files import read_config
from deepracer_exp.formats.run_result import RunResult, read_result
from deepracer_exp.tracking.lookup import folder_of, has_store, is_run_id
from deepracer_exp.tracking.registry import Registered, is_alias, look_up

BEST = "best:"
ACCEPTED = (
    "a run's folder, its name or the beginning of it, MLflow's id, best:EXPERIMENT, MODEL@ALIAS or ALIAS"
)


@dataclass(frozen=True)
class Reference:
    """A run that is meant."""

    path: Path
    checkpoint: str | None = None
    """Name of the checkpoint that is meant, if it was given by a registered model's alias."""
    registered: str | None = None
    """That alias, as MODEL@ALIAS."""


def resolve(run: str, runs_dir: Path, tracking_uri: str | None) -> Reference:
    """Return the run that is meant.

    Args:
        run: its folder, the folder's name or the beginning of it; MLflow's id; `best:EXPERIMENT`; or the alias of a
            registered model, `MODEL@ALIAS` or, where exactly one model has it, `ALIAS`.
        runs_dir: where runs are.
        tracking_uri: where ids and aliases are looked up; None: in `runs_dir`.

    Raises:
        BadInput: no run, or several, are meant, or a registered checkpoint is not what it was.
    """
    if run.startswith(BEST):
        return Reference(best_of(run.removeprefix(BEST), runs_dir))
    with reading(f"run={run}", ACCEPTED):
        for folder in (Path(run).expanduser(), runs_dir / run):
            if (folder / "config.yaml").is_file():
                return Reference(folder)
    if is_run_id(run):
        return Reference(_present(run, folder_of(run, tracking_uri, runs_dir), runs_dir))
    if "@" in run and "/" not in run:
        return _of_registered(run, look_up(run, tracking_uri, runs_dir), runs_dir)
    folders = sorted(file.parent for file in runs_dir.glob("*/*/config.yaml"))
    meant = [folder for folder in folders if folder.name == run]
    meant = meant or [folder for folder in folders if folder.name.startswith(run)]
    if len(meant) == 1:
        return Reference(meant[0])
    if meant:
        names = ", ".join(str(folder.relative_to(runs_dir)) for folder in meant[:3])
        raise BadInput(f"run={run}: {len(meant)} runs are meant: {names}{', ...' * (len(meant) > 3)}")
    unknown = f"run={run}: no such run in {runs_dir} ({len(folders)} there){nearest(run, [f.name for f in folders])}"
    if not is_alias(run) or not has_store(tracking_uri, runs_dir):
        raise BadInput(f"{unknown}; accepted: {ACCEPTED}")
    try:
        registered = look_up(run, tracking_uri, runs_dir)
    except BadInput as error:
        raise BadInput(f"{unknown}; {str(error).removeprefix(f'run={run}: ')}") from None
    return _of_registered(run, registered, runs_dir)


def best_of(experiment: str, runs_dir: Path) -> Path:
    """Return the folder of an experiment's best run.

    Of a sweep it is the run of its best trial, whatever else was trained under the same name. Otherwise runs whose
    best checkpoint was evaluated are ranked by that; where none was, by the share of complete laps and the fastest lap
    of their training. The newest of equals is taken.

    Raises:
        BadInput: there is no such experiment, no run of it tells how good it is, they do not compare (another car,
            course, evaluation or measure), or the best of a sweep is gone.
    """
    what = f"run={BEST}{experiment}"
    try:
        folder = runs_dir / safe_name(experiment)
    except ValueError as error:
        raise BadInput(f"{what}: {error}") from None
    if (of_sweep := run_of_sweep(folder)) is not None:
        return of_sweep
    runs = sorted(file.parent for file in folder.glob("*/config.yaml"))
    if not runs:
        known = sorted({file.parents[1].name for file in runs_dir.glob("*/*/config.yaml")})
        raise BadInput(
            f"{what}: no run of such an experiment in {runs_dir}{nearest(experiment, known)}; "
            f"experiments there: {', '.join(known[:10]) or 'none'}"
        )
    results = {run: result for run in runs if (result := _result(run)) is not None}
    results = {run: one for run, one in results.items() if one.evaluated} or results
    if not results:
        raise BadInput(
            f"{what}: none of its {len(runs)} runs has a result and a checkpoint `best`; give a run"
        )
    _check_comparable(what, results)
    return max(results, key=lambda run: (results[run].rank, run.name))


def _result(run: Path) -> RunResult | None:
    return read_result(run) if (run / "checkpoints" / "best").is_dir() else None


def _check_comparable(what: str, results: Mapping[Path, RunResult]) -> None:
    """Refuse runs whose ranks mean different things."""
    first, *others = results
    terms = {run: _terms(read_config(run), result) for run, result in results.items()}
    for run in others:
        for key, value in terms[first].items():
            if terms[run][key] != value:
                raise BadInput(
                    f"{what}: its runs do not compare: {key} is {_short(value)} in {first.name} and "
                    f"{_short(terms[run][key])} in {run.name}; give a run, and other experiments another name="
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


def _of_registered(run: str, found: Registered, runs_dir: Path) -> Reference:
    """Return the run of a registered checkpoint, which must be as it was."""
    path = _present(run, found.run_dir, runs_dir)
    checkpoint = path / "checkpoints" / found.checkpoint
    if not checkpoint.is_dir():
        raise BadInput(f"run={run}: {found} is {checkpoint}, which is gone; promote another checkpoint")
    verify(checkpoint)
    if checkpoint_sha256(checkpoint) != found.sha256:
        raise BadInput(
            f"run={run}: {checkpoint} is not the checkpoint that was registered as {found}, version {found.version}: "
            "its hash is another one; give the run and checkpoint= if it is meant all the same"
        )
    return Reference(path, found.checkpoint, str(found))


def _present(run: str, folder: Path, runs_dir: Path) -> Path:
    """Return the folder of a recorded run, where it is or where all runs have moved to."""
    moved = runs_dir / folder.parent.name / folder.name
    found = next((place for place in (folder, moved) if (place / "config.yaml").is_file()), None)
    if found is None:
        raise BadInput(f"run={run}: its folder {folder} is gone; give the folder where it is now")
    return found
