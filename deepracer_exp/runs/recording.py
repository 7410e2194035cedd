"""The recording of a run of ours: the schema that all logs share, and the data that only a run has."""

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from deepracer_exp.aws.logs import sim_trace
from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.recorded import (
    METRICS_COLUMNS,
    STEP_COLUMNS,
    TRAINING,
    UPDATE_COLUMNS,
    LogProblem,
    Recording,
    typed_table,
)
from deepracer_exp.aws.models.model_metadata import ModelMetadata
from deepracer_exp.config.custom_files.model_files import SAC_TAKEN, TAKEN
from deepracer_exp.config.driving import OFF, ActionSpaceConfig
from deepracer_exp.config.learning import SACConfig, algorithm_kind
from deepracer_exp.config.racing import RaceConfig
from deepracer_exp.env.action_space import build_action_space, metadata_of
from deepracer_exp.env.others.placement import PlacedOthers, read_placements
from deepracer_exp.env.trace_columns import EPISODE_STATUS, SCHEMA
from deepracer_exp.errors import BadInput
from deepracer_exp.files import RECORD_BYTES, read_text

from .run_files import (
    CONFIG,
    METRICS,
    REWARD,
    SUMMARY,
    TRACE,
    WRITTEN,
    is_randomized,
    is_run,
    read_config,
    read_object,
)
from .run_result import IN_TRAINING, RunResult, read_result
from .trace import (
    UNREADABLE,
    join_stored,
    missing_trace,
    open_trace_file,
    read_evaluation_others,
    read_others,
    stored_column,
    stored_values,
    trace_files,
)

CONTROL_PERIOD_S = 1 / 15
"""The service's simulated seconds of a control step."""
EVALUATION_COLUMNS: Mapping[str, tuple[str, str]] = {
    "iteration": ("int32", "policy update after which the policy was evaluated, counted as in the steps"),
    "completion": ("float64", "per cent of the lap, mean over the trials"),
    "held_out_completion": ("float64", "the same on held-out conditions; NaN where not evaluated"),
    "lap_share": ("float64", "complete laps as a share of those tried; NaN where not known"),
    "laps": ("float64", "complete laps; NaN where not known"),
    "laps_tried": ("float64", "laps tried; NaN where not known"),
    "lap_time_s": ("float64", "s, mean of the complete laps; NaN without one"),
    "crash_free": (
        "float64",
        "complete laps without a crash as a share of those tried; NaN alone on the track",
    ),
    "zigzag_per_m": ("float64", "changes of steering a metre of straight; NaN where not measured"),
    "zigzag_deg": ("float64", "degrees to either side in these changes; NaN without one"),
    "zigzag_lost_s": ("float64", "s a lap lost in these; NaN where not measured"),
}
"""Columns of `Recording.evaluations`: type and meaning with unit."""
COUNTED_COLUMNS: Mapping[str, tuple[str, str]] = {
    "iteration": ("int32", "policy update that used the steps"),
    "steps": ("int64", "control steps of the training"),
    "episodes": ("int64", "that ended in it"),
    "complete": ("int64", "episodes that completed the lap"),
    "completion_mean": ("float64", "per cent of the lap, mean over episodes; NaN where none ended"),
    "lap_share": ("float64", "share of episodes that completed the lap, 0 to 1"),
    "reward_mean": ("float64", "mean of the episodes' sums"),
}
"""Columns of `RunRecording.counted`: type and meaning with unit."""
LAPS_ONLY = (
    "trace=laps: has complete laps only; figures of places, actions and rewards leave out all other episodes"
)

_UNUSED = {"worker": 0, "pause_duration": 0.0, "obstacle_crash_counter": 0.0}
"""Columns that have one value in all our trainings: there are no penalties, and a crash ends an episode."""
_READ = [name for name in STEP_COLUMNS if name in SCHEMA.names and name not in _UNUSED]
_RACE: TypeAdapter[RaceConfig] = TypeAdapter(RaceConfig)
_ACTION_SPACE: TypeAdapter[ActionSpaceConfig] = TypeAdapter(ActionSpaceConfig)


@dataclass(frozen=True, kw_only=True, eq=False)
class RunRecording:
    """The recording of a run of ours, with data that no log of the service has."""

    recording: Recording
    best: RunResult
    """The run's best checkpoint, as its summary names it."""
    evaluations: pd.DataFrame = field(default_factory=lambda: typed_table(EVALUATION_COLUMNS))
    """One row an evaluation between the iterations, `EVALUATION_COLUMNS`; the service logs the episodes of its
    evaluations in `Recording.metrics`."""
    stopping: Mapping[str, Any] | None = None
    """The run's group `stopping`; None where its configuration cannot be read."""
    decision: Mapping[str, Any] | None = None
    """The decision of the stopping rule that ended the run, as in summary.json; None if no rule did."""
    randomized: bool = False
    """Whether its training varied the conditions for all cars (`randomization`)."""
    usual_episodes: NDArray[np.int64] | None = None
    """Episodes on usual conditions, where only a share of the cars differed from them; None: all were alike."""
    counted: pd.DataFrame | None = None
    """All steps and episodes by iteration, `COUNTED_COLUMNS`, where the trace lacks some; None on several tracks."""
    laps_only: bool = False
    """Whether the trace has complete laps only."""
    others: PlacedOthers | None = None
    """The others on the road; None where the car was alone, or they are not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EvaluationRecording:
    """The control steps of an evaluation of ours among others (`evaluate --trace`)."""

    recording: Recording
    others: PlacedOthers


def is_traced_run(folder: Path) -> bool:
    """Return whether a folder is that of a run of ours with its trace."""
    return is_run(folder) and (folder / TRACE).is_dir()


def read_log(path: Path) -> Recording | RunRecording | EvaluationRecording:
    """Read a run or an evaluation of ours, or a recording of the service or its relatives.

    Raises:
        BadInput: nothing is there, or nothing of it can be read.
    """
    if is_run(path) and not (path / TRACE).is_dir():
        raise BadInput(path, missing_trace(path), "a run with its trace, or logs of the service")
    if is_traced_run(path):
        return read_run_recording(path)
    others = read_evaluation_others(path)
    recording = read_recording(path)
    return recording if others is None else EvaluationRecording(recording=recording, others=others)


def read_run_recording(folder: Path) -> RunRecording:
    """Read a run of ours.

    The rows are those of the last iterations of its trace, no more than `MOST_STEPS`, by episode and step. Unreadable
    parts are left out and listed. `folder` has `trace/`, `metrics.jsonl`, `config.yaml` and `reward_function.py`.

    Raises:
        BadInput: there is no trace, or nothing of it can be read.
    """
    problems: list[LogProblem] = []
    files: list[Path] = []
    steps = _steps(folder, problems, files)
    traces = tuple(files)
    config = _config(folder, problems, files)
    updates, evaluated, counted = _metrics(folder, problems, files)
    if laps_only := config.get("trace") == "laps":
        problems.append(LogProblem(str(folder / TRACE), None, LAPS_ONLY))
    best = _best(folder, problems)
    recording = Recording(
        name=folder.resolve().name,
        steps=steps,
        updates=updates,
        metrics=typed_table(METRICS_COLUMNS),
        metadata=_metadata(folder, config, problems),
        hyperparameters=_hyperparameters(config),
        reward_source=_text(folder / REWARD, problems, files) or None,
        track=_track(config),
        problems=tuple(problems),
        files=tuple(files),
    )
    return RunRecording(
        recording=recording,
        best=best,
        evaluations=evaluated,
        stopping=config.get("stopping"),
        decision=_decision(folder),
        randomized=is_randomized(config),
        usual_episodes=_usual_episodes(traces, config, problems),
        counted=counted if _track(config) is not None and counted["steps"].sum() > len(steps) else None,
        laps_only=laps_only,
        others=_others(folder, config, problems),
    )


def _steps(folder: Path, problems: list[LogProblem], files: list[Path]) -> pd.DataFrame:
    """Read the newest iterations that together have no more than `MOST_STEPS` rows, by episode and step."""
    opened: dict[Path, tuple[pq.ParquetFile, int]] = {}
    room, left_out = sim_trace.MOST_STEPS, 0
    with contextlib.ExitStack() as stack:
        for path in reversed(trace_files(folder / TRACE)):
            try:
                file = stack.enter_context(open_trace_file(path))
                count = skipped = file.metadata.num_rows
                if room:
                    skipped = _rows_to_drop(file, room)
                    if skipped < count:
                        opened[path] = file, skipped
            except UNREADABLE as error:
                problems.append(LogProblem(str(path), None, f"left out: {_one_line(error)}"))
                continue
            left_out += skipped
            room = 0 if skipped else room - count
        if left_out:
            reason = sim_trace.left_out_reason(left_out)
            problems.append(LogProblem(str(folder / TRACE), None, reason, lines=left_out))
        columns = None
        while opened and columns is None:
            columns = _columns(dict(sorted(opened.items())), opened, problems)
    if columns is None:
        raise BadInput(f"{problems[0]}; nothing of the trace can be read")
    files += sorted(opened)
    return pd.DataFrame(columns, copy=False)


def _columns(
    opened: Mapping[Path, tuple[pq.ParquetFile, int]],
    left: dict[Path, tuple[pq.ParquetFile, int]],
    problems: list[LogProblem],
) -> dict[str, Any] | None:
    """Return the columns of opened files, each from its first wanted row; None: one is unreadable, and out of `left`.

    A column is read from all files before the next: the memory that it was unpacked in is used again.
    """
    columns: dict[str, Any] = {}
    by_episode = None
    for name in ("episode", *(name for name in _READ if name != "episode")):
        parts = []
        for path, (file, skipped) in opened.items():
            try:
                parts.append(stored_column(file, name).slice(skipped))
            except UNREADABLE as error:
                problems.append(LogProblem(str(path), None, f"left out: {_one_line(error)}"))
                del left[path]
                return None
        column = join_stored(name, parts)
        if name == "episode":
            episode = stored_values(column)
            # Sorted while they are unpacked: to sort all columns later takes as long as to read them.
            by_episode = None if (np.diff(episode) >= 0).all() else np.argsort(episode, kind="stable")
        kind, values = STEP_COLUMNS[name][0], stored_values(column, by_episode)
        columns[name] = values if kind == "category" else values.astype(kind, copy=False)
    rows = len(columns["episode"])
    columns["stream"] = pd.Categorical.from_codes(np.zeros(rows, np.int8), [TRAINING])
    words = columns["episode_status"]
    others = [word for word in words.categories if word not in EPISODE_STATUS]
    columns["episode_status"] = words.set_categories([*EPISODE_STATUS, *others])
    for name, (kind, _) in STEP_COLUMNS.items():
        if name not in columns:  # of the service's logs alone: one number in memory for all rows
            columns[name] = np.broadcast_to(np.full(1, _UNUSED.get(name, np.nan), kind), rows)
    return {name: columns[name] for name in STEP_COLUMNS}


def _rows_to_drop(file: pq.ParquetFile, room: int) -> int:
    """Return the number of first rows to drop, so that at most `room` rows of whole iterations are left."""
    if file.metadata.num_rows <= room:
        return 0
    iterations = stored_values(stored_column(file, "iteration"))
    return int(np.searchsorted(iterations, iterations[-room - 1], side="right"))


def _config(folder: Path, problems: list[LogProblem], files: list[Path]) -> Mapping[str, Any]:
    file = folder / CONFIG
    try:
        config = read_config(file.parent)
    except BadInput as error:
        problems.append(LogProblem(str(file), None, error.without(file)))
        return {}
    files.append(file)
    return config


def _usual_episodes(
    traces: Sequence[Path], config: Mapping[str, Any], problems: list[LogProblem]
) -> NDArray[np.int64] | None:
    """Return the episodes of the cars that `car_share` leaves as they are; None: there are none, or no others."""
    randomization = config.get("randomization") or {}
    varied = [name for name, off in OFF.items() if randomization.get(name, [off, off]) != [off, off]]
    if randomization.get("car_share", 1) in (0, 1) or not varied:
        return None
    # A quantity with whole numbers may be drawn as if it were off.
    quantity = min(varied, key=lambda name: name == "action_delay_steps")
    usual: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
    for path in traces:
        try:
            with open_trace_file(path) as file:
                episode, drawn = (stored_values(stored_column(file, name)) for name in ("episode", quantity))
        except UNREADABLE as error:
            problems.append(LogProblem(str(path), None, f"{quantity} left out: {_one_line(error)}"))
            continue
        usual.append(np.unique(episode[drawn == OFF[quantity]]))
    return np.concatenate(usual)


def _metrics(
    folder: Path, problems: list[LogProblem], files: list[Path]
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Return updates, evaluations, and the results of the episodes (`COUNTED_COLUMNS`)."""
    file = folder / METRICS
    updates, evaluated, counted = [], [], []
    steps = episodes = laps = 0
    for number, line in enumerate(_text(file, problems, files).splitlines(), start=1):
        try:
            row = json.loads(line)
            iteration = int(row["iteration"])
            losses = {
                name: _number(row.get(name)) for name in UPDATE_COLUMNS if name not in ("iteration", "epoch")
            }
            names = [name for name in EVALUATION_COLUMNS if name not in ("iteration", "held_out_completion")]
            tried = {name: _number(row.get(f"eval_{name}")) for name in names}
            tried["held_out_completion"] = _number(row.get("held_out_completion"))
            ended, complete = int(row["episodes"]) - episodes, int(row["laps"]) - laps
            driven = int(row["env_steps"]) - steps
            steps, episodes, laps = int(row["env_steps"]), int(row["episodes"]), int(row["laps"])
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            problems.append(LogProblem(str(file), number, f"left out: {_one_line(error)}"))
            continue
        updates.append({"iteration": iteration, "epoch": 0, **losses})
        counted.append(
            {
                **{"iteration": iteration, "steps": driven, "episodes": ended, "complete": complete},
                "completion_mean": _number(row.get("completion")),
                "lap_share": complete / ended if ended else math.nan,
                "reward_mean": _number(row.get("mean_return")),
            }
        )
        if np.isfinite(tried["completion"]):
            evaluated.append({"iteration": iteration, **tried})
    return (
        typed_table(UPDATE_COLUMNS, updates),
        typed_table(EVALUATION_COLUMNS, evaluated),
        typed_table(COUNTED_COLUMNS, counted),
    )


def _others(folder: Path, config: Mapping[str, Any], problems: list[LogProblem]) -> PlacedOthers | None:
    if config.get("race") is None:
        return None
    try:
        race = _RACE.validate_python(config["race"])
        table = read_others(folder / TRACE)
    except (BadInput, ValidationError) as error:
        problems.append(LogProblem(str(folder), None, f"without boxes and bots: {_one_line(error)}"))
        return None
    if table is None:
        return None
    period_s = 1 / config["car"]["control_hz"]
    return PlacedOthers(race=race, episodes=read_placements(table), period_s=period_s)


def _decision(folder: Path) -> Mapping[str, Any] | None:
    """Return the decision of the run's stopping rule, None if there is none or it cannot be read."""
    try:
        decision = read_object(folder / SUMMARY).get("stopping")
    except BadInput:  # `_best` reports it
        return None
    return (
        decision
        if isinstance(decision, dict) and {"rule", "why", "values", "thresholds"} <= decision.keys()
        else None
    )


def _best(folder: Path, problems: list[LogProblem]) -> RunResult:
    """Return the result of the best checkpoint in the run's summary."""
    try:
        result = read_result(folder)
    except BadInput as error:
        file = folder / SUMMARY
        problems.append(LogProblem(str(file), None, error.without(file)))
        result = None
    return result or RunResult(measure=IN_TRAINING, rank=(0.0, -math.inf), completion=None, lap_time_s=None)


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def _metadata(folder: Path, config: Mapping[str, Any], problems: list[LogProblem]) -> ModelMetadata | None:
    """Return the action space; the sensors are the service's default, whatever the policy sees."""
    if config.get("action_space") is None:
        return None
    try:
        return metadata_of(build_action_space(_ACTION_SPACE.validate_python(config["action_space"])))
    except (BadInput, ValidationError) as error:
        problems.append(LogProblem(str(folder / CONFIG), None, f"action_space: {_one_line(error)}"))
        return None


def _hyperparameters(config: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the hyperparameters that the service has, too, by its names."""
    algorithm = config.get("algorithm")
    if not isinstance(algorithm, Mapping):
        return None
    taken = SAC_TAKEN if algorithm_kind(algorithm) is SACConfig else TAKEN
    keys = {word: key.removeprefix("algorithm.") for word, key in taken.items()}
    return {word: algorithm[key] for word, key in keys.items() if algorithm.get(key) is not None}


def _track(config: Mapping[str, Any]) -> str | None:
    """Return the name of the course, None where there are several."""
    track = config.get("track")
    name = track.get("name") if isinstance(track, Mapping) else None
    return name if isinstance(name, str) else None


def _text(file: Path, problems: list[LogProblem], files: list[Path]) -> str:
    try:
        text = read_text(file, WRITTEN, RECORD_BYTES)
    except BadInput as error:
        problems.append(LogProblem(str(file), None, error.without(file)))
        return ""
    files.append(file)
    return text


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
