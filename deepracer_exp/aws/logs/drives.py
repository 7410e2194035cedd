"""The drives of a recording: iterations, duplicates and episode numbers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from .log_files import Place
from .recorded import STEP_COLUMNS, typed_table
from .sim_trace import COMMON, step_keys
from .text_log import TrainingLog

EPISODES_PER_ITERATION = 20
"""The service's default."""
_NEAR_S, _NEAR_M = 0.03, 0.001
_LARGEST_RAD_OF_YAW, _LARGEST_RAD_OF_STEER = 2 * math.pi, math.pi / 3

Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(eq=False)
class Drives:
    """The steps of one worker in one training, or of the car of one evaluation."""

    place: Place
    table: pa.Table
    """Columns of `sim_trace.SCHEMA`, in chronological order."""
    iteration: Ints
    world: str = ""
    names: list[str] = field(default_factory=list)
    """Names of its folder and of the logs with the same steps."""

    @cached_property
    def key(self) -> Ints:
        """`step_keys` of the rows."""
        return step_keys(self.table)

    def choose(self, rows: Flags) -> "Drives":
        """Return some of the rows."""
        return Drives(self.place, self.table.filter(rows), self.iteration[rows], self.world, self.names)


def in_degrees(table: pa.Table) -> pa.Table:
    """Convert the radians of 2019 to degrees; the rows must be those of one file.

    Only lines of 15 values can have radians; they are recognised by their small values.
    """
    old = table["values"].to_numpy() == len(COMMON)
    if not old.any():
        return table
    yaw, steer = (table[name].to_numpy()[old] for name in ("yaw", "steer"))
    if np.abs(yaw).max() > _LARGEST_RAD_OF_YAW or np.abs(steer).max() > _LARGEST_RAD_OF_STEER:
        return table
    for name in ("yaw", "steer"):
        values = table[name].to_numpy()
        turned = np.where(old, np.degrees(values), values)
        table = table.set_column(table.schema.get_field_index(name), name, pa.array(turned))
    return table


def iterations_of(table: pa.Table, log: TrainingLog, episodes_per_iteration: int) -> Ints:
    """Return the iteration of each row of a text log: as logged, or by counting episodes."""
    episode = table["episode"].to_numpy().astype(np.int64)
    driven = [(first, logged_number(name)) for first, name in log.checkpoints if first is not None]
    if driven:
        starts, number = np.array(sorted(driven), np.int64).T
        return number[np.maximum(np.searchsorted(starts, episode, side="right") - 1, 0)] - first_checkpoint(
            log
        )
    if not any(log.iteration_of.values()):
        return episode // _episodes_between(log, episodes_per_iteration)
    logged_episodes = np.array(sorted(log.iteration_of))
    logged = np.array([log.iteration_of[number] for number in logged_episodes.tolist()], np.int64)
    place = np.searchsorted(logged_episodes, episode)
    # Episodes after the last logged one were not finished when the log ended.
    counts = np.unique(logged, return_counts=True)[1]
    usual = int(counts[:-1].max()) if len(counts) > 1 else episodes_per_iteration
    behind = episode - logged_episodes[-1] - (usual - int(counts[-1]))
    beyond = logged[-1] + np.where(behind > 0, 1 + (behind - 1) // usual, 0)
    return np.where(place < len(logged_episodes), logged[np.minimum(place, len(logged_episodes) - 1)], beyond)


def logged_number(name: str) -> int:
    """Return the number of a checkpoint `309_Step-8349`."""
    return int(name.partition("_")[0])


def first_checkpoint(log: TrainingLog) -> int:
    """Return the number of the checkpoint a training began with: a clone's numbers continue its parent's."""
    names = [*log.saved, *(name for _, name in log.checkpoints)]
    fresh = (name for name in names if name.endswith("_Step-0"))
    return logged_number(next(fresh, names[0])) if names else 0


def _episodes_between(log: TrainingLog, usual: int) -> int:
    """Return the number of episodes in an iteration: those between two evaluations."""
    ends = log.evaluated_after
    if len(ends) > 1:
        return ends[1] - ends[0]
    return ends[0] if ends and 0 in log.iteration_of else usual


def rows_also_in(log: Drives, other: Drives) -> Flags:
    """Return whether the other drives contain each row of a log, perhaps with more digits.

    Two races can begin at the same place and time: drives are the same only if most of their common steps are.
    """
    mine, theirs = log.key, other.key
    if not len(mine) or not len(theirs):
        return np.zeros(len(mine), np.bool_)
    if _rises(theirs):
        match = np.minimum(np.searchsorted(theirs, mine), len(theirs) - 1)
    else:
        order = np.argsort(theirs, kind="stable")
        match = order[np.minimum(np.searchsorted(theirs[order], mine), len(theirs) - 1)]
    same = theirs[match] == mine
    common = int(same.sum())
    for name, near in (("tstamp", _NEAR_S), ("X", _NEAR_M), ("Y", _NEAR_M)):
        same &= np.abs(log.table[name].to_numpy() - other.table[name].to_numpy()[match]) <= near
    return same if same.sum() > common / 2 else np.zeros(len(mine), np.bool_)


def repeated(drives: Drives) -> Flags:
    """Return whether each row duplicates an earlier one."""
    key = drives.key
    if _rises(key) or len(np.unique(key)) == len(key):
        return np.zeros(len(key), np.bool_)
    values = {name: drives.table[name].to_numpy() for name in ("tstamp", "X", "Y", "yaw")}
    return pd.DataFrame({"key": key, **values}).duplicated().to_numpy()


def number_episodes(
    rounds: Ints, worker: Ints, raw: Ints, iteration: Ints, steps: Ints
) -> tuple[Ints, Mapping[tuple[int, int, int], int]]:
    """Number the episodes of a stream so that no two share a number.

    The arguments have a value a row: the index of its training, in ascending order, the worker, the number of the
    episode in the worker's own log, the iteration within its training, and the control step.

    A single worker keeps its numbers. Episodes of several, which each count from 0, are numbered in the order of
    iteration, worker and own number; the numbers of a training continue those of the one before.

    Returns:
        The new numbers, and the new number of each (round, worker, own number).
    """
    if not len(raw):
        return raw, {}
    alone = rounds[-1] == rounds[0] and bool((worker == worker[0]).all())
    unchanged = {(int(rounds[0]), int(worker[0]), int(episode)): int(episode) for episode in np.unique(raw)}
    if alone and _rises((raw << 32) | steps):
        return raw, unchanged
    new = np.ones(len(raw), np.bool_)
    new[1:] = (np.diff(rounds) != 0) | (np.diff(worker) != 0) | (np.diff(raw) != 0) | (np.diff(steps) <= 0)
    drive = np.cumsum(new) - 1
    starts = np.flatnonzero(new)
    table = pd.DataFrame(
        {name: values[starts] for name, values in
         {"rounds": rounds, "iteration": iteration, "worker": worker, "raw": raw}.items()}
    )  # fmt: skip
    # The same number again is another episode only if its steps start from 1 again.
    table["again"] = (
        table.assign(fresh=steps[starts] == 1).groupby(["rounds", "worker", "raw"])["fresh"].cumsum()
    )
    table["again"] = table["again"].clip(lower=1)
    if alone and (table["again"] == 1).all():
        return raw, unchanged
    by = ["rounds", "iteration", "worker", "raw", "again"]
    # An episode that continues into the next iteration belongs to the first.
    table["iteration"] = table.groupby(["rounds", "worker", "raw", "again"])["iteration"].transform("min")
    number = table.groupby(by, sort=True).ngroup().to_numpy()
    keys = zip(table["rounds"], table["worker"], table["raw"], strict=True)
    numbers: dict[tuple[int, int, int], int] = {}
    for key, value in zip(keys, number.tolist(), strict=True):
        numbers.setdefault((int(key[0]), int(key[1]), int(key[2])), value)
    return number[drive], numbers


@dataclass(frozen=True)
class Rows:
    """The drives of one stream, with numbers that are unique over all of them."""

    stream: str
    table: pa.Table
    """Columns of `sim_trace.SCHEMA`."""
    worker: Ints
    iteration: Ints
    episode: Ints
    track: Sequence[str]
    """Names of the courses that `track_code` refers to."""
    track_code: Ints


def steps_of(parts: Sequence[Rows]) -> pd.DataFrame:
    """Return the rows of all streams, one after the other, with the columns of `STEP_COLUMNS`."""
    if not parts:
        return typed_table(STEP_COLUMNS)
    table = concatenated([part.table for part in parts])
    sizes = [part.table.num_rows for part in parts]
    tracks = list(dict.fromkeys(name for part in parts for name in part.track))
    codes = [np.array([tracks.index(name) for name in part.track])[part.track_code] for part in parts]
    status = table["episode_status"].chunk(0) if table.num_rows else None
    first_columns: dict[str, Any] = {
        "stream": pd.Categorical.from_codes(
            np.repeat(np.arange(len(parts)), sizes), [part.stream for part in parts]
        ),
        "worker": np.concatenate([part.worker for part in parts]),
        "iteration": np.concatenate([part.iteration for part in parts]),
        "episode": np.concatenate([part.episode for part in parts]),
        "episode_status": pd.Categorical([])
        if status is None
        else pd.Categorical.from_codes(status.indices.to_numpy(), status.dictionary.to_pylist()),
        "speed_mps": np.full(sum(sizes), np.nan),
        "track": pd.Categorical.from_codes(np.concatenate(codes), tracks),
    }
    columns = {}
    for name, (kind, _) in STEP_COLUMNS.items():
        values = first_columns[name] if name in first_columns else table[name].to_numpy()
        columns[name] = values if kind == "category" else values.astype(kind, copy=False)
    return pd.DataFrame(columns, copy=False)


def concatenated(tables: Sequence[pa.Table]) -> pa.Table:
    """Return tables of `sim_trace.SCHEMA` as one, with one dictionary of statuses."""
    return pa.concat_tables(tables).unify_dictionaries().combine_chunks()


def _rises(key: Ints) -> bool:
    return bool((key[1:] > key[:-1]).all())
