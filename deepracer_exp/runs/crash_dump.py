"""Crash dumps: the error of a failed run and its tensors, on disk."""

import contextlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from deepracer_exp.files import atomic_write, read_json

from .run_files import CRASH_DUMPS


def write_crash_dump(run_dir: Path, error: BaseException, worker: int | None = None) -> None:
    """Write the error's line, and its `params` and `arrays` if it has them, under `faults/` as JSON and .npz.

    On a full disk, parts that do not fit are left out, so that the error itself is not lost. `worker` is the number of
    the process, None for the training process.
    """
    folder = run_dir / CRASH_DUMPS
    stem = "training" if worker is None else f"worker-{worker}"
    report = {
        "error": type(error).__name__,
        "message": str(error),
        "worker": worker,
        "params": _plain(getattr(error, "params", None)),
    }
    with contextlib.suppress(OSError):
        folder.mkdir(exist_ok=True)
        atomic_write(folder / f"{stem}.json", json.dumps(report, indent=2) + "\n")
        arrays: dict[str, np.ndarray] = getattr(error, "arrays", {})
        if arrays:
            with (folder / f"{stem}.npz").open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_crash_dump(run_dir: Path, worker: int) -> str | None:
    """Return the error line of a worker, None if it wrote none."""
    path = run_dir / CRASH_DUMPS / f"worker-{worker}.json"
    return str(read_json(path, "what a worker writes there")["message"]) if path.exists() else None


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
