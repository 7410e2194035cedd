"""Whether two runs are the same, bit for bit, except for times."""

import json
import math
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint

from deepracer_exp.runs.trace import read_trace
from deepracer_exp.tracking.mlflow_metrics import BEST, MACHINE, metric_name
from deepracer_exp.training.metrics import TIMES

Row = Mapping[str, Any]
History = Mapping[str, Sequence[tuple[int, float]]]
"""(step, value) of a metric's points, by its name."""


def different_rows(one: Sequence[Row], other: Sequence[Row]) -> str | None:
    """Return where two runs' metrics first differ, None if they are the same."""
    for number, (left, right) in enumerate(zip(one, other, strict=False), 1):
        for key in {**left, **right}:
            # JSON text keeps every bit of a number, and NaN equals NaN.
            if key not in TIMES and json.dumps(left.get(key)) != json.dumps(right.get(key)):
                return f"row {number}: {key} is {left.get(key)} and {right.get(key)}"
    return None if len(one) == len(other) else f"{len(one)} and {len(other)} rows"


def different_tensors(one: Path, other: Path) -> str | None:
    """Return which tensor of two checkpoints' agents (networks, optimizer, schedule) differs first.

    Args:
        one, other: folders of checkpoints.
    """
    left, right = (_agent(folder) for folder in (one, other))
    for name in {**left, **right}:
        if left.get(name) != right.get(name):
            return f"agent/{name}"
    return None


def different_traces(one: Path, other: Path) -> str | None:
    """Return which column of two runs' traces differs first."""
    left, right = (read_trace(run / "trace") for run in (one, other))
    if len(left) != len(right):
        return f"{len(left)} and {len(right)} rows"
    return next((name for name in left if not left[name].equals(right[name])), None)


def different_points(rows: Sequence[Row], history: History) -> str | None:
    """Return what MLflow lacks of a run's metrics, or has twice.

    Of times only the steps are compared: a repeated iteration takes another time.
    """
    wanted: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        for key, value in row.items():
            if key != "env_steps" and value is not None and math.isfinite(value):
                wanted.setdefault(metric_name(key), []).append((row["env_steps"], float(value)))
    # The evaluation of the best checkpoint, recorded at the end, is in no row, and the use of the machine neither.
    for key in {key for key in {**wanted, **history} if not key.startswith((BEST, MACHINE))}:
        expected, found = (_points(key, of.get(key, ())) for of in (wanted, history))
        if expected != found:
            lacking, more = (sorted(points)[:3] for points in (expected - found, found - expected))
            return f"{key}: lacks {lacking}, has besides {more}"
    return None


def _points(key: str, points: Sequence[tuple[int, float]]) -> "Counter[Any]":
    return Counter(step for step, _ in points) if key in map(metric_name, TIMES) else Counter(points)


def _agent(folder: Path) -> dict[str, bytes]:
    """Return the contents of an agent's files; of archives, which have dates, those of their members."""
    contents: dict[str, bytes] = {}
    place = Checkpoint.manifest(folder)["components"]["agent"]["path"]
    for file in sorted(path for path in (folder / place).iterdir() if path.is_file()):
        if zipfile.is_zipfile(file):
            with zipfile.ZipFile(file) as archive:
                contents |= {f"{file.name}/{name}": archive.read(name) for name in archive.namelist()}
        else:
            contents[file.name] = file.read_bytes()
    return contents
