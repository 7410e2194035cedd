"""The files of a run folder: names and contents."""

import contextlib
import getpass
import json
import os
import socket
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from deepracer_exp.errors import BadInput, reading
from deepracer_exp.files import RECORD_BYTES, read_text, read_yaml

CONFIG = "config.yaml"
"""All values of the experiment. Written last at the start: it makes a folder a run."""
OVERRIDES = "overrides.yaml"
PROVENANCE = "provenance.json"
REWARD = "reward_function.py"
METRICS = "metrics.jsonl"
"""A row an iteration."""
SUMMARY = "summary.json"
"""Written when the run ends."""
LOG = "log.txt"
REPORT = "report.html"
BEST_LAP = "best_lap.png"
LEARNING = "learning.png"
TRACKING = "tracking.json"
"""The training's description of the run for trackers."""
MLFLOW = "mlflow.json"
"""The record's state in MLflow."""
MACHINE_USE = "machine.jsonl"
"""Use of cores and memory, a row an iteration."""
LABELS = "labels.json"
"""Name, note and tags that people gave the run."""
LINEAGE = "lineage.json"
"""File in a clone's folder."""
REWARD_PRINTS = "reward_prints.log"
RUNNING = ".running"
"""Lock file of the process that trains in the folder; removed when it ends."""
HEARTBEAT = ".heartbeat"
CHECKPOINTS, TRACE, EVALUATIONS, FILMS, CRASH_DUMPS = "checkpoints", "trace", "evaluations", "films", "faults"
EXPORTS, TENSORBOARD, WANDB = "export", "tensorboard", "wandb"
RIVAL = "rival"
REPLAY = "replay"
"""Folders within."""
BEST_OF_SWEEP = "best_of_sweep.json"
"""File beside the runs of a sweep."""
MLFLOW_DB = "mlflow.db"
"""Database in `runs_dir`."""
BEST = "best:"
"""Prefix of an experiment's name that means its best run."""
WRITTEN = "what a run writes there"
"""The accepted origin of a file in a run's folder, for messages."""
RUN = "a run's folder, its name or the beginning of it, MLflow's id, best:EXPERIMENT, MODEL@ALIAS or ALIAS"
"""The accepted forms of RUN in commands."""


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a run."""
    return (folder / CONFIG).is_file()


def run_folders(runs_dir: Path) -> list[Path]:
    """Return the folders of the runs of all experiments; a hidden one is being downloaded, or was cut off."""
    return sorted(file.parent for file in runs_dir.glob(f"*/[!.]*/{CONFIG}"))


def full_name(folder: Path) -> str:
    """Return EXPERIMENT/FOLDER, which names one run of `runs_dir`.

    The folder's name alone does not: runs of two experiments may begin in one second.
    """
    folder = folder.absolute()
    return f"{folder.parent.name}/{folder.name}"


def shortest_names(folders: Sequence[Path]) -> list[str]:
    """Return the shortest unambiguous name of each run folder."""
    number = Counter(folder.name for folder in folders)
    return [folder.name if number[folder.name] == 1 else full_name(folder) for folder in folders]


@dataclass(frozen=True)
class RunRecord:
    """The contents of a run's files."""

    path: Path
    config: dict[str, Any]
    """All values of the experiment, by group."""
    rows: list[dict[str, Any]]
    """metrics.jsonl, a row an iteration."""
    summary: dict[str, Any]
    """Empty while the run is running, or if it was killed."""
    provenance: dict[str, Any]
    """Origin of code and reward function."""

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name


def read_record(path: Path) -> RunRecord:
    """Read a run's folder.

    Raises:
        BadInput: a file is missing, cannot be read or does not hold what a training writes.
    """
    head = read_head(path)
    return replace(head, rows=read_metrics(path / METRICS))


def read_head(path: Path) -> RunRecord:
    """Read a run's folder without the rows of metrics.jsonl, which is long; raises as `read_record`."""
    return RunRecord(path, read_config(path), [], read_object(path / SUMMARY), read_object(path / PROVENANCE))


def read_config(path: Path) -> dict[str, Any]:
    """Read the config.yaml of a run's folder.

    Raises:
        BadInput: it cannot be read or holds no values.
    """
    file = path / CONFIG
    mapping = read_yaml(file, WRITTEN)
    if not isinstance(mapping, dict):
        raise BadInput(file, "holds no values; a run writes its experiment there")
    return {str(key): value for key, value in mapping.items()}


def who_and_where() -> dict[str, str]:
    """Return the user who runs this process, and the name of the machine, as `user` and `host`."""
    user = f"uid {os.getuid()}" if hasattr(os, "getuid") else "unknown"
    with contextlib.suppress(KeyError, OSError):  # containers often have a user id without a name
        user = getpass.getuser()
    return {"user": user, "host": socket.gethostname()}


def sees_pictures(config: Mapping[str, Any]) -> bool:
    """Return whether the policy of a run with this config.yaml sees through a camera."""
    return bool((config.get("observation") or {}).get("camera"))


def is_randomized(config: Mapping[str, Any]) -> bool:
    """Return whether a run's configuration varies the conditions of its training for all cars."""
    values = config.get("randomization") or {}
    varied = any(isinstance(bounds, list) and bounds[0] != bounds[-1] for bounds in values.values())
    return varied and values.get("car_share", 1) == 1


def read_object(file: Path) -> dict[str, Any]:
    """Read a JSON object of a run's folder; empty where there is no such file.

    Raises:
        BadInput: it cannot be read or holds something else.
    """
    return _object(file, _text(file)) if file.exists() else {}


def read_run_id(path: Path) -> str | None:
    """Return MLflow's id of a folder's run, None for one that is not recorded.

    Raises:
        BadInput: the file that has it cannot be read or holds something else.
    """
    # Version 0.1.0 kept it in tracking.json.
    file = path / MLFLOW if (path / MLFLOW).exists() else path / TRACKING
    run_id = read_object(file).get("run_id")
    if not isinstance(run_id, str | None):
        raise BadInput(file, f"run_id: {run_id!r} is not a string")
    return run_id


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Read metrics.jsonl; a last line without an end, cut off by a kill, is left out.

    Raises:
        BadInput: the file cannot be read, or a line is not a JSON object.
    """
    lines = _text(path).split("\n")
    return [_object(path, line, f" line {number}") for number, line in enumerate(lines[:-1], 1)]


def _text(path: Path) -> str:
    return read_text(path, WRITTEN, RECORD_BYTES)


def _object(path: Path, text: str, where: str = "") -> dict[str, Any]:
    with reading(f"{path}{where}", why="is not valid JSON"):
        value = json.loads(text)
    if not isinstance(value, dict):
        raise BadInput(f"{path}{where}", f"{text[:40]!r} is not a JSON object")
    return value
