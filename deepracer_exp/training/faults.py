"""What failed and in which state, on disk."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from deepracer_exp.env.race import Race
from deepracer_exp.errors import RunFailed

FAULTS_DIR = "faults"


def write_fault(run_dir: Path, error: RunFailed, race: Race | None, worker: int | None = None) -> Path:
    """Write the error's line, the params of a reward call and the cars' state under `faults/`.

    Args:
        run_dir: folder of the run.
        error: what happened; its `arrays` and `params` are kept where it has them.
        race: the cars, None where no car is to blame.
        worker: number of the process, None for the training process.

    Returns:
        The JSON file; an .npz of arrays stands beside it.
    """
    folder = run_dir / FAULTS_DIR
    folder.mkdir(exist_ok=True)
    stem = "training" if worker is None else f"worker-{worker}"
    arrays: dict[str, np.ndarray] = dict(getattr(error, "arrays", {}))
    if race is not None and not arrays:
        arrays = race.state_arrays()
    if arrays:
        with (folder / f"{stem}.npz").open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    report = {
        "error": type(error).__name__,
        "message": str(error),
        "worker": worker,
        "params": _plain(getattr(error, "params", None)),
    }
    path = folder / f"{stem}.json"
    path.write_text(json.dumps(report, indent=2), encoding="utf-8")
    return path


def read_fault(run_dir: Path, worker: int) -> str | None:
    """Return the line a worker left behind, None where it left none."""
    path = run_dir / FAULTS_DIR / f"worker-{worker}.json"
    if not path.is_file():
        return None
    return str(json.loads(path.read_text(encoding="utf-8"))["message"])


def _plain(value: Any) -> Any:
    """Return the value in JSON's types; NaN and infinities as text."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return repr(value)
