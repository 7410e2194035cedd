"""The files of a recording, each read by itself."""

import bisect
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import IO, Any

from deepracer_exp.aws.archives import READ_ERRORS, natural, reason_of
from deepracer_exp.aws.models.archive import CHECKPOINTS, checkpoint_names
from deepracer_exp.aws.models.hyperparameters import read_hyperparameters
from deepracer_exp.aws.models.job_settings import race_values
from deepracer_exp.aws.models.model_metadata import ModelMetadata, read_model_metadata
from deepracer_exp.errors import BadInput
from deepracer_exp.files import SETTINGS_BYTES, read_yaml

from . import sim_trace
from .log_files import LOG, LogFile, LogFolder, Place, place_of
from .recorded import CHECKPOINT, TRAINING, LogProblem
from .sim_trace import StepTables, read_trace_csv
from .text_log import MARKER, TrainingLog, piece_of, read_training_logs

MOST_LISTED = 20
"""Lines of one file that are listed one by one; the rest is counted."""
_NUMBER = re.compile(r"(?<!\d)(\d{1,6})-iteration")
_METADATA = re.compile(r"model_metadata.*\.json")
_HYPERPARAMETERS = re.compile(r"hyper_?parameters.*?(?:\.json)?")
_PARAMS = re.compile(r"(training|evaluation|eval)_params(?:_(\d{1,3}))?.*\.ya?ml")
# Files that lie beside the logs of a model and hold no data of a recording.
_BESIDE = re.compile(
    r".*\.(?:pb|ckpt.*|meta|index|data-.*|mp4|png|jpg|py|parquet|ya?ml|lock|ready|done|finished|pbtxt)|\..*|done|checkpoint"
    r"|worker_\d+\..*\.csv|ip\.json|.*[cC]heckpoint.*\.json|.*(?:model|carfile).*\.tar\.gz"
)
_MOST_NAMED = 3
_MOST_METRICS_BYTES = 2**26
_LARGEST = 2**31 - 1


@dataclass
class TraceFile:
    """One CSV trace."""

    file: LogFile
    place: Place
    number: int | None
    """The iteration in its name."""
    steps: StepTables


@dataclass
class Parts:
    """The content of all files."""

    traces: list[TraceFile] = field(default_factory=list)
    logs: list[tuple[LogFile, TrainingLog]] = field(default_factory=list)
    metrics: list[tuple[LogFile, list[dict[str, Any]]]] = field(default_factory=list)
    """Rows of `read_metrics_json`."""
    metadata: list[tuple[LogFile, ModelMetadata]] = field(default_factory=list)
    hyperparameters: list[tuple[LogFile, dict[str, Any]]] = field(default_factory=list)
    reward: list[tuple[LogFile, str]] = field(default_factory=list)
    races: dict[str, dict[str, str]] = field(default_factory=dict)
    """Parameters about boxes and bots by kind of job (`job_settings.race_values`)."""
    model_checkpoints: list[tuple[LogFile, dict[str, str]]] = field(default_factory=list)
    """Names of the best and the last checkpoint in the folder of a model, by the keys of `checkpoint_names`."""
    worlds: dict[tuple[str, int], str] = field(default_factory=dict)
    """Course by kind of job and worker, from the files that start it; a file for all workers counts as the first's."""
    files: list[LogFile] = field(default_factory=list)
    problems: list[LogProblem] = field(default_factory=list)
    steps: list[tuple[Any, LogFile, StepTables]] = field(default_factory=list)
    """The steps of all files, in the order in which they are dropped if there are too many."""

    @property
    def left_out(self) -> bool:
        """Whether steps were left out because there were too many."""
        return any(steps.left_out for _, _, steps in self.steps)

    def add_steps(self, file: LogFile, place: Place, is_csv: bool, age: int, steps: StepTables) -> None:
        """Add the steps of a file; `age` sorts the files of one worker."""
        # Those of logs precede those of CSVs, which have more digits.
        key = (place.kind != TRAINING, is_csv, natural("/".join(place.root)), age, place.worker, file.order)
        bisect.insort(self.steps, (key, file, steps), key=lambda entry: entry[0])

    def drop_first_steps(self) -> None:
        """Drop the first steps of all files while there are too many."""
        rows = sum(steps.rows for _, _, steps in self.steps)
        for _, _, steps in self.steps:
            while steps.rows and rows > sim_trace.MOST_STEPS:
                rows -= steps.drop_first()

    def world(self, kind: str, worker: int) -> str:
        """Return the course of a worker's job, or that of the first where no file names one; "" where none does."""
        return self.worlds.get((kind, worker)) or self.worlds.get((kind, 0), "")

    def refuse(self, file: LogFile, refused: list[tuple[int | None, str]]) -> None:
        """Add the unreadable parts of a file to the problems."""
        rest = refused[MOST_LISTED:] if len(refused) > MOST_LISTED + 1 else []
        for line, reason in refused[: len(refused) - len(rest)]:
            self.problems.append(LogProblem(str(file.path), line, reason))
        if rest:
            lines = [line for line, _ in rest if line is not None]
            last = f", the last one in line {lines[-1]}" if lines else ""
            reason = f"and {len(rest)} more that cannot be read{last}"
            self.problems.append(LogProblem(str(file.path), rest[0][0], reason, lines=len(rest)))


def read_parts(folder: LogFolder) -> Parts:
    """Read every file that may hold data, each by itself."""
    alone = len(folder.files) == 1
    parts = Parts(problems=list(folder.problems))
    others: list[LogFile] = []
    for file in folder.files:
        listed = len(parts.problems)
        try:
            recognised = _read(parts, file, alone)
        except (ValueError, *READ_ERRORS) as error:
            recognised = False
            reason = error.without(file.path) if isinstance(error, BadInput) else reason_of(error)
            if isinstance(error, READ_ERRORS):
                reason = f"cannot be read ({reason})"
            parts.problems.append(LogProblem(str(file.path), None, reason))
        parts.drop_first_steps()
        if recognised:
            parts.files.append(file)
        elif len(parts.problems) == listed and not _BESIDE.fullmatch(file.name):
            others.append(file)
    parts.problems += [
        LogProblem(str(file.path), None, sim_trace.left_out_reason(steps.left_out), lines=steps.left_out)
        for _, file, steps in parts.steps
        if steps.left_out
    ]
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
        return not _BESIDE.fullmatch(name) and _read_csv(parts, file)
    if _METADATA.fullmatch(name):
        parts.metadata.append((file, read_model_metadata(file.path, file.head(SETTINGS_BYTES + 1))))
        return True
    if _HYPERPARAMETERS.fullmatch(name):
        _read_hyperparameters(parts, file, file.head(SETTINGS_BYTES + 1))
        return True
    if name == CHECKPOINTS:
        names = checkpoint_names(str(file.path), file.head(SETTINGS_BYTES))
        parts.model_checkpoints.append((file, {key: _checkpoint(name) for key, name in names.items()}))
        return True
    if name.endswith(".json") and not _BESIDE.fullmatch(name):
        with file.open() as stream:
            rows, refused = read_metrics_json(stream)
        parts.metrics.append((file, rows))
        parts.refuse(file, [(None, reason) for reason in refused])
        return True
    if name.startswith("reward_function") and name.endswith(".py"):
        parts.reward.append((file, file.head(SETTINGS_BYTES).decode("utf-8", "replace")))
        return True
    params = _PARAMS.fullmatch(name)
    if params is not None:
        job = read_yaml(file.path, "a job's parameters", raw=file.head(SETTINGS_BYTES + 1))
        kind = "evaluation" if params[1] == "eval" else params[1]
        # With a configuration for each worker, deepracer-for-cloud counts the files from 1.
        worker = max(0, int(params[2] or 1) - 1)
        if world := _world(job):
            parts.worlds[kind, worker] = world
        if isinstance(job, Mapping) and not worker:
            parts.races[kind] = race_values(job)
        return True
    return _read_log(parts, file) if alone or LOG.search(name) else False


def _read_csv(parts: Parts, file: LogFile) -> bool:
    with file.open() as stream:
        try:
            steps, refused = read_trace_csv(stream)
        except ValueError as error:
            reason, is_empty = str(error), not file.head(SETTINGS_BYTES).strip()
        else:
            match = _NUMBER.search(file.name)
            number, place = int(match[1]) if match else None, place_of(file.parts)
            parts.traces.append(TraceFile(file, place, number, steps))
            parts.add_steps(file, place, True, number or 0, steps)
            parts.refuse(file, refused)
            return True
    # CloudWatch exports logs as CSV too.
    if not is_empty and _read_log(parts, file):
        return True
    raise BadInput(reason, accepted="a trace of the service")


def _read_log(parts: Parts, file: LogFile) -> bool:
    with file.open() as stream:
        logs = read_training_logs(stream)
    name, age = piece_of(file.name)
    for log in logs:
        parts.refuse(file, log.refused)
        if not log.recognised and not log.refused:
            raise BadInput(f"no {MARKER.decode()} line and no policy update", accepted="a log of the service")
        parts.logs.append((file, log))
        parts.add_steps(file, place_of((*file.parts[:-1], name)), False, age, log.steps)
    log = logs[0]  # all workers print the same settings
    if log.metadata is not None:
        try:
            raw = json.dumps(log.metadata).encode()
            parts.metadata.append((file, read_model_metadata(file.path, raw)))
        except BadInput as error:
            parts.refuse(file, [(None, f"action space: {error.without(file.path)}")])
    if log.hyperparameters is not None:
        _read_hyperparameters(parts, file, json.dumps(log.hyperparameters).encode())
    return True


def _read_hyperparameters(parts: Parts, file: LogFile, raw: bytes) -> None:
    """Add the values that the file gives; those that cannot be used are listed as problems."""
    refused: list[str] = []
    settings = read_hyperparameters(file.path, raw, refused)
    parts.hyperparameters.append(
        (file, {key: getattr(settings, key) for key in settings.set_keys if hasattr(settings, key)})
    )
    parts.refuse(file, [(None, f"hyperparameters: {reason}") for reason in refused])


def _checkpoint(name: str) -> str:
    """Return the name of a checkpoint without its ending, `25_Step-33002`.

    Raises:
        ValueError: it is no such name.
    """
    match = CHECKPOINT.match(name)
    if match is None:
        raise ValueError(f"{name!r} is no name of a checkpoint; accepted: 25_Step-33002.ckpt")
    return match[0]


def _world(data: object) -> str:
    """Return the course named by a job's parameters, the first of several."""
    world = data.get("WORLD_NAME") if isinstance(data, Mapping) else None
    world = world[0] if isinstance(world, list) and world else world
    return world if isinstance(world, str) else ""


def read_metrics_json(stream: IO[bytes]) -> tuple[list[dict[str, Any]], list[str]]:
    """Read the metrics of a training or of an evaluation.

    Returns:
        A row an episode, with the keys `episode` (from 0), `trial`, `phase`, `reward`, `completion`, `time_s`,
        `episode_status`, `resets`; and the reasons why other items are not episodes.

    Raises:
        ValueError: it holds no list of metrics; the message gives the reason.
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
    rows, refused = [], []
    for number, item in enumerate(items):
        try:
            rows.append(_episode_row(number, item))
        except (ValueError, TypeError, KeyError, OverflowError, AttributeError) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            refused.append(f"metrics[{number}] is not an episode ({reason})")
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
