"""A run of ours as a recording, in the schema of everybody's."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from deepracer_exp.deepracer import sim_trace
from deepracer_exp.deepracer.model_metadata import (
    Action,
    ModelMetadata,
    read_model_metadata,
)
from deepracer_exp.deepracer.recording import (
    EVALUATION_COLUMNS,
    METRICS_COLUMNS,
    STEP_COLUMNS,
    TRAINING,
    UPDATE_COLUMNS,
    LogProblem,
    Recording,
    typed_table,
)
from deepracer_exp.deepracer.recording_reader import read_recording
from deepracer_exp.deepracer.trace import EPISODE_STATUS
from deepracer_exp.errors import BadInput

from .files import CONFIG, METRICS, REWARD, SUMMARY, TRACE, is_run, read_config, read_object
from .result import IN_TRAINING, RunResult, read_result

LEARNING = {
    "batch_size": "batch_size",
    "num_epochs": "epochs",
    "lr": "lr",
    "beta_entropy": "entropy_coeff",
    "discount_factor": "discount",
    "loss_type": "loss_type",
    "num_episodes_between_training": "episodes_per_iteration",
}
"""The service's words for values of the group `algorithm`."""
_CONSTANT = {"stream": TRAINING, "worker": 0, "wall_clock": np.nan}
_WORDS = ("episode_status", "track")
_READ = [name for name in STEP_COLUMNS if name not in _CONSTANT]


def is_own_run(folder: Path) -> bool:
    """Tell whether a folder is that of a run of ours with its trace."""
    return is_run(folder) and (folder / TRACE).is_dir()


def read_log(path: Path) -> Recording:
    """Read a run of ours, or what the service or its relatives have recorded.

    Raises:
        BadInput: nothing is there, or nothing of it can be read.
    """
    return read_own_recording(path) if is_own_run(path) else read_recording(path)


def read_own_recording(folder: Path) -> Recording:
    """Read a run of ours.

    The rows are those of its trace in the order of iterations, the last `MOST_STEPS` of them; the rows of one episode
    may run on into the next iteration. What cannot be read of it is left out and listed.

    Args:
        folder: of the run, with `trace/`, `metrics.jsonl`, `config.yaml` and `reward_function.py`.

    Raises:
        BadInput: there is no trace, or nothing of it can be read.
    """
    problems: list[LogProblem] = []
    files: list[Path] = []
    steps = _steps(folder, problems, files)
    config = _config(folder, problems, files)
    updates, evaluated = _metrics(folder, problems, files)
    best = _best(folder, problems)
    return Recording(
        name=folder.resolve().name,
        steps=steps,
        updates=updates,
        metrics=typed_table(METRICS_COLUMNS),
        evaluations=evaluated,
        metadata=_metadata(folder, config, problems),
        hyperparameters=_hyperparameters(config),
        reward_source=_reward(folder, problems, files),
        track=_track(config),
        problems=tuple(problems),
        files=tuple(files),
        best=best,
        stopping=config.get("stopping"),
        decision=_decision(folder),
    )


def _steps(folder: Path, problems: list[LogProblem], files: list[Path]) -> pd.DataFrame:
    """Read the trace into arrays made once, so that there is never a second copy of the whole."""
    found = sorted(path for path in (folder / TRACE).glob("*-iteration.parquet") if path.name[0] != ".")
    if not found:
        raise BadInput(
            f"{folder / TRACE}: no *-iteration.parquet; accepted: the folder of a run with its trace"
        )
    counts = _last(found, [_count(path, problems) for path in found], problems)
    total = sum(counts)
    columns = {name: np.empty(total, STEP_COLUMNS[name][0]) for name in _READ if name not in _WORDS}
    codes = {name: np.zeros(total, np.int16) for name in _WORDS}
    words = {"episode_status": dict.fromkeys(EPISODE_STATUS), "track": dict[str, None]()}
    place = {name: {word: code for code, word in enumerate(known)} for name, known in words.items()}
    at = 0
    for path, count in zip(found, counts, strict=True):
        if not count:
            continue
        rows = slice(at, at + count)
        try:
            table = pq.ParquetFile(path).read(columns=_READ, use_threads=False)
            for name, column in columns.items():
                column[rows] = _numbers(table[name])
            for name in _WORDS:
                codes[name][rows] = _codes(table[name], place[name])
        except (OSError, pa.ArrowException, KeyError, ValueError) as error:
            problems.append(LogProblem(str(path), None, f"left out: {_one_line(error)}"))
            continue
        at += count
        files.append(path)
    if not files:
        raise BadInput(f"{problems[0]}; nothing of the trace can be read")
    whole: dict[str, Any] = {}
    for name in STEP_COLUMNS:
        if name in _CONSTANT:
            whole[name] = _constant(name, at)
        elif name in _WORDS:
            whole[name] = pd.Categorical.from_codes(codes[name][:at], list(place[name]))
        else:
            whole[name] = columns[name][:at]
    return pd.DataFrame(whole, copy=False)


def _last(found: Sequence[Path], counts: list[int], problems: list[LogProblem]) -> list[int]:
    """Return the rows to be read of each file: 0 of the first files where all together have too many."""
    so_far = np.cumsum(counts[::-1])[::-1]
    read = [
        count if after <= sim_trace.MOST_STEPS else 0
        for count, after in zip(counts, so_far.tolist(), strict=True)
    ]
    gone = sum(counts) - sum(read)
    if gone:
        reason = sim_trace.left_out_reason(gone)
        problems.append(LogProblem(str(found[0].parent), None, reason, lines=gone))
    return read


def _count(path: Path, problems: list[LogProblem]) -> int:
    """Return the rows of a file, 0 for one that cannot be read."""
    try:
        found = pq.read_metadata(path)
    except (OSError, pa.ArrowException) as error:
        problems.append(LogProblem(str(path), None, f"left out: {_one_line(error)}"))
        return 0
    missing = [name for name in _READ if name not in found.schema.to_arrow_schema().names]
    if missing:
        problems.append(LogProblem(str(path), None, f"left out: no column {', '.join(missing)}"))
        return 0
    return int(found.num_rows)


def _numbers(column: pa.ChunkedArray) -> np.ndarray:
    if column.null_count:  # the action of a policy that gives [steer, throttle] itself
        column = column.cast(pa.float64())
    return column.to_numpy()


def _codes(column: pa.ChunkedArray, place: dict[str, int]) -> np.ndarray:
    """Return the words as numbers; a word that is new gets the next one."""
    parts = []
    for chunk in column.chunks:
        chunk = chunk if pa.types.is_dictionary(chunk.type) else chunk.dictionary_encode()
        number = [place.setdefault(word, len(place)) for word in chunk.dictionary.to_pylist()]
        parts.append(np.array(number, np.int16)[chunk.indices.to_numpy()])
    return np.concatenate(parts)


def _constant(name: str, count: int) -> Any:
    if name == "stream":
        return pd.Categorical.from_codes(np.zeros(count, np.int8), [TRAINING])
    return np.full(count, _CONSTANT[name], STEP_COLUMNS[name][0])


def _config(folder: Path, problems: list[LogProblem], files: list[Path]) -> Mapping[str, Any]:
    file = folder / CONFIG
    try:
        config = read_config(file.parent)
    except BadInput as error:
        problems.append(LogProblem(str(file), None, str(error).removeprefix(f"{file}: ")))
        return {}
    files.append(file)
    return config


def _metrics(
    folder: Path, problems: list[LogProblem], files: list[Path]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return updates and evaluations."""
    file = folder / METRICS
    updates, evaluated = [], []
    for number, line in enumerate(_text(file, problems, files).splitlines(), start=1):
        try:
            row = json.loads(line)
            iteration = int(row["iteration"])
            losses = {
                name: _number(row.get(name)) for name in UPDATE_COLUMNS if name not in ("iteration", "epoch")
            }
            tried = {name: _number(row.get(f"eval_{name}")) for name in ("completion", "lap_time_s")}
            tried["held_out_completion"] = _number(row.get("held_out_completion"))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            problems.append(LogProblem(str(file), number, f"left out: {_one_line(error)}"))
            continue
        updates.append({"iteration": iteration, "epoch": 0, **losses})
        if np.isfinite(tried["completion"]):
            evaluated.append({"iteration": iteration, **tried})
    return typed_table(UPDATE_COLUMNS, updates), typed_table(EVALUATION_COLUMNS, evaluated)


def _decision(folder: Path) -> Mapping[str, Any] | None:
    """Return what the run's stopping rule decided, None if it did not or that cannot be read."""
    try:
        found = read_object(folder / SUMMARY).get("stopping")
    except BadInput:  # `_best` reports it
        return None
    return (
        found if isinstance(found, dict) and {"rule", "why", "values", "thresholds"} <= found.keys() else None
    )


def _best(folder: Path, problems: list[LogProblem]) -> RunResult:
    """Return what the run's summary says of its best checkpoint."""
    try:
        found = read_result(folder)
    except BadInput as error:
        file = folder / SUMMARY
        problems.append(LogProblem(str(file), None, str(error).removeprefix(f"{file}: ")))
        found = None
    return found or RunResult(measure=IN_TRAINING, rank=(0.0, -math.inf), completion=None, lap_time_s=None)


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def _metadata(folder: Path, config: Mapping[str, Any], problems: list[LogProblem]) -> ModelMetadata | None:
    """Return the action space; our policies have no camera, and the service's default stands in for it."""
    space = config.get("action_space")
    if space is None:
        return None
    try:
        if space.get("file") is not None:
            return read_model_metadata(space["file"])
        discrete = space["kind"] != "continuous"
        steering, speed = (space.get(name) for name in ("steering_angle", "speed"))
        return ModelMetadata(
            actions=_actions(space) if discrete else (),
            low=None if discrete else Action(float(steering["low"]), float(speed["low"])),
            high=None if discrete else Action(float(steering["high"]), float(speed["high"])),
        )
    except (BadInput, TypeError, ValueError, KeyError, AttributeError) as error:
        problems.append(
            LogProblem(str(folder / CONFIG), None, f"action_space is not told: {_one_line(error)}")
        )
        return None


def _actions(space: Mapping[str, Any]) -> tuple[Action, ...]:
    """Return the choices; a grid has every steering level with every speed level, steering in the outer loop."""
    if space["kind"] == "discrete":
        return tuple(Action(float(one["steering_angle"]), float(one["speed"])) for one in space["actions"])
    steering, speed = (
        np.linspace(space[name]["low"], space[name]["high"], space[levels]).tolist()
        for name, levels in (("steering_angle", "steering_levels"), ("speed", "speed_levels"))
    )
    return tuple(Action(angle, pace) for angle in steering for pace in speed)


def _hyperparameters(config: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return what the service has a word for."""
    own = config.get("algorithm")
    if not isinstance(own, Mapping):
        return None
    return {word: own[name] for word, name in LEARNING.items() if own.get(name) is not None}


def _track(config: Mapping[str, Any]) -> str | None:
    """Return the name of the course, None where there are several."""
    track = config.get("track")
    name = track.get("name") if isinstance(track, Mapping) else None
    return name if isinstance(name, str) else None


def _reward(folder: Path, problems: list[LogProblem], files: list[Path]) -> str | None:
    return _text(folder / REWARD, problems, files) or None


def _text(file: Path, problems: list[LogProblem], files: list[Path]) -> str:
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        problems.append(LogProblem(str(file), None, f"cannot be read: {_one_line(error)}"))
        return ""
    files.append(file)
    return text


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
