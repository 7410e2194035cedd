"""best_of_sweep.json, which a sweep keeps in the folder of its runs: which of them is the best."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter

from deepracer_exp.errors import BadInput

from .typed_file import read_typed
from .whole_file import write_whole

BEST_OF_SWEEP = "best_of_sweep.json"


@dataclass(frozen=True, kw_only=True)
class BestOfSweep:
    """The best trial of a study, and its run."""

    study: str
    trial: Annotated[int, Field(ge=0)]
    """Number of the trial in the study."""
    run_dir: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    """Name of the run's folder beside the file; a name and no path, so that it leads nowhere else."""
    values: dict[str, float]
    """What the trial came to, by objective."""


_ADAPTER = TypeAdapter(BestOfSweep)


def write_best_of_sweep(folder: Path, best: BestOfSweep) -> Path:
    """Write the file into the folder of a study's runs, whole or not at all."""
    return write_whole(folder / BEST_OF_SWEEP, json.dumps(asdict(best), indent=1) + "\n")


def read_best_of_sweep(folder: Path) -> BestOfSweep | None:
    """Return the best of the sweep whose runs are in a folder, None where no sweep has told one.

    Raises:
        BadInput: the file cannot be read or holds something else.
    """
    return read_typed(folder / BEST_OF_SWEEP, _ADAPTER, "a sweep")


def run_of_sweep(folder: Path) -> Path | None:
    """Return the folder of the best run of a sweep, None where no sweep has told one.

    Args:
        folder: of the study's runs.

    Raises:
        BadInput: the file is not what a sweep writes, or the run it tells is gone or lies elsewhere.
    """
    best = read_best_of_sweep(folder)
    if best is None:
        return None
    run = folder / best.run_dir
    if not (run / "config.yaml").is_file():
        raise BadInput(
            f"{folder / BEST_OF_SWEEP}: run {best.run_dir} of trial {best.trial} is gone; give another run, "
            f"or delete this file"
        )
    if run.resolve().parent != folder.resolve():
        raise BadInput(f"{folder / BEST_OF_SWEEP}: run {best.run_dir} is a link that leads out of {folder}")
    return run
