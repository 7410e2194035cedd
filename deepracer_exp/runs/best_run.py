"""The best run of an experiment, and best_of_sweep.json, which names the best run of a sweep."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from deepracer_exp.config.experiment import safe_name
from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.files import atomic_write, read_json_as

from .run_files import BEST, BEST_OF_SWEEP, CHECKPOINTS, CONFIG, is_run, read_config, run_folders
from .run_result import RunResult, read_result


def best_of(experiment: str, runs_dir: Path) -> Path:
    """Return the folder of an experiment's best run.

    For a sweep it is the run of the best trial, whatever else was trained under the same name. Otherwise runs whose
    best checkpoint was evaluated are ranked by that; where none was, by the share of complete exploring laps and the
    fastest of them. The newest of equals is taken. A single run needs no result, such as an imported model.

    Raises:
        BadInput: there is no such experiment, none of its runs has a result, they cannot be ranked (another car,
            track, evaluation or measure), or the best run of a sweep is gone.
    """
    what = f"{BEST}{experiment}"
    try:
        folder = runs_dir / safe_name(experiment)
    except ValueError as error:
        raise BadInput(what, error) from None
    if (of_sweep := best_run_of_sweep(folder)) is not None:
        return of_sweep
    runs = sorted(file.parent for file in folder.glob(f"*/{CONFIG}"))
    if not runs:
        experiments = sorted({run.parent.name for run in run_folders(runs_dir)})
        raise BadInput(
            what,
            f"no such experiment in {runs_dir}{nearest(experiment, experiments)}; experiments there: "
            f"{', '.join(experiments[:10]) or 'none'}",
        )
    with_best = [run for run in runs if (run / CHECKPOINTS / "best").is_dir()]
    results = {run: result for run in with_best if (result := read_result(run)) is not None}
    results = {run: result for run, result in results.items() if result.evaluated} or results
    if not results:
        if len(runs) == 1 and with_best:
            return runs[0]
        raise BadInput(what, f"none of its {len(runs)} runs has a result and a checkpoint `best`; give a run")
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
            folder / BEST_OF_SWEEP,
            f"run {best.run_dir} of trial {best.trial} is gone; give another run, or delete this file",
        )
    if run.resolve().parent != folder.resolve():
        raise BadInput(folder / BEST_OF_SWEEP, f"run {best.run_dir} is a link that leads out of {folder}")
    return run


def _check_comparable(what: str, results: Mapping[Path, RunResult]) -> None:
    """Refuse runs whose ranks mean different things."""
    first, *others = results
    terms = {run: _terms(read_config(run), result) for run, result in results.items()}
    for run in others:
        for key, value in terms[first].items():
            mine, other = value, terms[run][key]
            if mine == other:
                continue
            if _short(mine) == _short(other):  # of one name
                # Imported here: it takes Hydra, which no page needs.
                from deepracer_exp.config.stored import config_differences

                key, (mine, other) = next(iter(config_differences([{key: mine}, {key: other}]).items()))
            raise BadInput(
                what,
                f"its runs cannot be ranked: {key} is {_short(mine)} in {first.name} and {_short(other)} in "
                f"{run.name}; name one of them, and train what differs under another name=",
            )


def _terms(config: Mapping[str, Any], result: RunResult) -> dict[str, Any]:
    """Return the values that must be equal for ranks to be comparable."""
    evaluation = config.get("evaluation") or {}
    courses = evaluation.get("tracks") if result.evaluated else None
    return {
        "what they are ranked by": result.measure,
        "car": config.get("car"),
        **({"evaluation": evaluation} if result.evaluated else {}),
        # An evaluation without a race of its own has that of the training.
        **({"race": config.get("race")} if result.evaluated and evaluation.get("race") is None else {}),
        **({} if courses else {"track": config.get("track")}),
    }


def _short(value: Any) -> str:
    """Return the name of an option that has one, else its beginning."""
    if isinstance(value, dict):
        value = value.get("name", value)
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:59]}…"
