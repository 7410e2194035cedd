"""The files of a recording, each read by itself."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from deepracer_exp.errors import BadInput
from deepracer_exp.files import SETTINGS_BYTES, read_yaml

from . import sim_trace
from .hyperparameters import read_hyperparameters
from .log_archive import LOG, READ_ERRORS, LogFile, log_files, natural, place_of, reason_of
from .model_metadata import ModelMetadata, read_model_metadata
from .recording import TRAINING, LogProblem
from .sim_trace import Refused, StepTables, read_trace_csv
from .training_log import MARKER, TrainingLog, read_training_log

MOST_LISTED = 20
"""Lines of one file that are listed one by one; the rest is counted."""
_NUMBER = re.compile(r"(\d{1,9})-iteration")
_METADATA = re.compile(r"model_metadata.*\.json")
_HYPERPARAMETERS = re.compile(r"hyper_?parameters.*?(?:\.json)?")
_PARAMS = re.compile(r"(training|evaluation)_params.*\.ya?ml")
# What lies beside the logs of a model and has no data of a recording.
_BESIDE = re.compile(
    r".*\.(?:pb|ckpt.*|meta|index|data-.*|mp4|png|jpg|py|ya?ml|lock|ready|done|finished|pbtxt)|\..*|done|checkpoint"
    r"|ip\.json|deepracer_checkpoints\.json|.*[cC]heckpoint.*\.json|.*(?:model|carfile).*\.tar\.gz"
)
_MOST_NAMED = 3
_MOST_METRICS_BYTES = 2**26
_LARGEST = 2**31 - 1

MetricsRows = list[dict[str, Any]]
"""Episodes: `episode` (from 0), `trial`, `phase`, `reward`, `completion`, `time_s`, `episode_status`, `resets`."""


@dataclass
class Parts:
    """The content of all files."""

    traces: list[tuple[LogFile, StepTables]] = field(default_factory=list)
    logs: list[tuple[LogFile, TrainingLog]] = field(default_factory=list)
    metrics: list[tuple[LogFile, MetricsRows]] = field(default_factory=list)
    metadata: list[tuple[LogFile, ModelMetadata]] = field(default_factory=list)
    hyperparameters: list[tuple[LogFile, dict[str, Any]]] = field(default_factory=list)
    reward: list[tuple[LogFile, str]] = field(default_factory=list)
    worlds: dict[str, str] = field(default_factory=dict)
    """Course by kind of job, from the files that start it."""
    files: list[Path] = field(default_factory=list)
    problems: list[LogProblem] = field(default_factory=list)

    def steps(self) -> list[tuple[LogFile, StepTables]]:
        """Return the steps of all files."""
        return [*self.traces, *((file, log.steps) for file, log in self.logs)]

    def drop_excess(self) -> None:
        """Drop the first steps of all files while there are too many in memory: the training's earliest, of logs first.

        Those of CSVs have more digits.
        """

        def order(one: tuple[LogFile, StepTables]) -> tuple[Any, ...]:
            file, place = one[0], place_of(one[0].parts)
            is_csv = file.name.lower().endswith(".csv")
            age = iteration_in_name(file) or 0 if is_csv else file.piece[1]
            root = natural("/".join(place.root))
            return place.kind != TRAINING, is_csv, root, age, place.worker, file.order

        excess = sum(steps.rows for _, steps in self.steps()) - sim_trace.MOST_STEPS
        for _, steps in sorted(self.steps(), key=order) if excess > 0 else ():
            while excess > 0 and steps.rows:
                before = steps.rows
                steps.drop_first()
                excess -= before - steps.rows

    def refuse(self, file: LogFile, refused: Refused) -> None:
        """List what of a file cannot be read."""
        rest = refused[MOST_LISTED:] if len(refused) > MOST_LISTED + 1 else []
        for line, reason in refused[: len(refused) - len(rest)]:
            self.problems.append(LogProblem(str(file.path), line, reason))
        if rest:
            lines = [line for line, _ in rest if line is not None]
            last = f", the last one in line {lines[-1]}" if lines else ""
            reason = f"and {len(rest)} more that cannot be read{last}"
            self.problems.append(LogProblem(str(file.path), rest[0][0], reason, lines=len(rest)))


def iteration_in_name(file: LogFile) -> int | None:
    """Return the iteration that a CSV is named after."""
    number = _NUMBER.search(file.name)
    return int(number[1]) if number else None


def read_parts(path: Path) -> Parts:
    """Read every file of a folder or an archive that may hold data, each by itself."""
    parts = Parts()
    others: list[LogFile] = []
    for file in log_files(path, parts.problems):
        try:
            if _read(parts, file, alone=file.path == path):
                parts.files.append(file.path)
                parts.drop_excess()
            elif not _BESIDE.fullmatch(file.name):
                others.append(file)
        except (ValueError, *READ_ERRORS) as error:  # BadInput is a ValueError
            reason = reason_of(error).removeprefix(f"{file.path}: ")
            parts.problems.append(LogProblem(str(file.path), None, reason))
    for file, steps in parts.steps():
        if steps.left_out:
            reason = sim_trace.left_out_reason(steps.left_out)
            parts.problems.append(LogProblem(str(file.path), None, reason, lines=steps.left_out))
    if others:
        named = ", ".join("/".join(file.parts[-2:]) for file in others[:_MOST_NAMED])
        more = ", …" if len(others) > _MOST_NAMED else ""
        reason = f"not logs of the service: {named}{more}"
        parts.problems.append(LogProblem(f"{len(others)} other files", None, reason))
    return parts


def _read(parts: Parts, file: LogFile, alone: bool) -> bool:
    """Read one file; return whether it was recognised."""
    name = file.name
    if name.lower().endswith(".csv"):
        with file.open() as stream:
            steps, refused = read_trace_csv(stream)
        parts.traces.append((file, steps))
        parts.refuse(file, refused)
    elif _METADATA.fullmatch(name):
        parts.metadata.append((file, read_model_metadata(file.path, _content(file))))
    elif _HYPERPARAMETERS.fullmatch(name):
        _read_hyperparameters(parts, file, _content(file))
    elif name.endswith(".json") and not _BESIDE.fullmatch(name):
        with file.open() as stream:
            rows, refused = read_metrics_json(stream)
        parts.metrics.append((file, rows))
        parts.refuse(file, refused)
    elif name.startswith("reward_function") and name.endswith(".py"):
        parts.reward.append((file, _content(file)[:SETTINGS_BYTES].decode("utf-8", "replace")))
    elif params := _PARAMS.fullmatch(name):
        data = read_yaml(file.path, "a job's parameters", raw=_content(file))
        world = data.get("WORLD_NAME") if isinstance(data, Mapping) else None
        world = world[0] if isinstance(world, list) and world else world  # the first of several
        if isinstance(world, str):
            parts.worlds[params[1]] = world
    elif alone or LOG.search(name):
        _read_log(parts, file)
    else:
        return False
    return True


def _content(file: LogFile) -> bytes:
    with file.open() as stream:
        return stream.read(SETTINGS_BYTES + 1)


def _read_log(parts: Parts, file: LogFile) -> None:
    with file.open() as stream:
        log = read_training_log(stream)
    parts.refuse(file, log.refused)
    if not log.recognised and not log.refused:
        raise BadInput(f"no {MARKER.decode()} line and no policy update; accepted: a log of the service")
    parts.logs.append((file, log))
    if log.metadata is not None:
        try:
            raw = json.dumps(log.metadata).encode()
            parts.metadata.append((file, read_model_metadata(file.path, raw)))
        except BadInput as error:
            parts.refuse(file, [(None, f"action space: {str(error).removeprefix(f'{file.path}: ')}")])
    if log.hyperparameters is not None:
        _read_hyperparameters(parts, file, json.dumps(log.hyperparameters).encode())


def _read_hyperparameters(parts: Parts, file: LogFile, raw: bytes) -> None:
    """Add the values that the file itself gives; one that cannot be used is listed, the others stay."""
    refused: list[str] = []
    known = read_hyperparameters(file.path, raw, refused)
    values = {key: getattr(known, key) for key in known.given if hasattr(known, key)}
    parts.hyperparameters.append((file, values))
    parts.refuse(file, [(None, f"hyperparameters: {reason}") for reason in refused])


def read_metrics_json(stream: IO[bytes]) -> tuple[MetricsRows, Refused]:
    """Read the metrics of a training or of an evaluation.

    Returns:
        Its episodes, and the reasons of those that cannot be read.

    Raises:
        ValueError: it holds no list of metrics, or is not JSON; the message gives the reason.
    """
    raw = stream.read(_MOST_METRICS_BYTES + 1)
    if len(raw) > _MOST_METRICS_BYTES:
        raise ValueError(f"larger than {_MOST_METRICS_BYTES // 2**20} MiB")
    try:
        data = json.loads(raw.decode("utf-8-sig", "replace"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON ({reason_of(error)})") from error
    items = data.get("metrics") if isinstance(data, dict) else None
    if not isinstance(items, list):
        raise ValueError('no metrics; accepted: {"metrics": [...]}')
    rows: MetricsRows = []
    refused: Refused = []
    for number, item in enumerate(items):
        try:
            rows.append(_episode_row(number, item))
        except (ValueError, TypeError, KeyError, OverflowError, AttributeError) as error:
            reason = f"{type(error).__name__}: {reason_of(error)}"
            refused.append((None, f"metrics[{number}] is not an episode ({reason})"))
    return rows, refused


def _episode_row(number: int, item: dict[str, Any]) -> dict[str, Any]:
    trial = _count(item.get("trial", number + 1))
    return {
        "episode": _count(item["episode"] - 1 if "episode" in item else trial - 1),
        "trial": trial,
        "phase": "training" if str(item.get("phase", "evaluation")) == "training" else "evaluation",
        "reward": float(item.get("reward_score", math.nan)),
        "completion": float(item["completion_percentage"]),
        "time_s": float(item["elapsed_time_in_milliseconds"]) / 1000.0,
        "episode_status": str(item.get("episode_status", "")).strip().lower().replace(" ", "_"),
        "resets": float(item.get("reset_count", math.nan)),
    }


def _count(value: float) -> int:
    whole = int(value)
    if not 0 <= whole <= _LARGEST:
        raise ValueError(f"{whole} is not a count")
    return whole
