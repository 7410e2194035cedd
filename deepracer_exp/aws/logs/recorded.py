"""A recording of a training or a race in one schema for all programs."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from deepracer_exp.aws.models.model_metadata import ModelMetadata

CHECKPOINT = re.compile(r"(\d{1,9})_Step-(\d{1,12})(?!\d)")
"""The service's name of a checkpoint: its number, and the control steps of the training before it."""
TRAINING = "training"
"""Name of the stream, and kind of job, of a training's episodes."""
STEP_COLUMNS: Mapping[str, tuple[str, str]] = {
    "stream": ("category", "`training`, or the name of an evaluation or race"),
    "worker": ("int16", "simulation worker of the service, from 0"),
    "iteration": (
        "int32",
        "policy update that used the row; the service counts from 0, our own runs from 1",
    ),
    "episode": ("int32", "counted from 0 within the stream, unique in it over all workers"),
    "steps": ("int32", "control step of the episode; 1 is the prepare step where the generation writes one"),
    "X": ("float64", "m, front of the car"),
    "Y": ("float64", "m, front of the car"),
    "yaw": ("float64", "degrees, -180 to 180, counter-clockwise from +x"),
    "steer": ("float64", "degrees commanded, positive to the left"),
    "throttle": ("float64", "m/s commanded"),
    "action": ("float64", "action number; NaN for a continuous action space"),
    "reward": ("float64", "reward units"),
    "done": ("bool", "last step of the episode"),
    "all_wheels_on_track": ("bool", "every wheel centre on the road"),
    "progress": ("float64", "per cent of the lap"),
    "closest_waypoint": ("int32", "index of the nearer of the two waypoints around"),
    "track_len": ("float64", "m"),
    "tstamp": ("float64", "s, simulated time; unix time in logs of 2019 and 2020"),
    "episode_status": ("category", "as the service names it; empty where the generation has none"),
    "pause_duration": ("float64", "s of penalty left; 0 where the generation has none"),
    "obstacle_crash_counter": ("float64", "obstacles hit; NaN where not logged"),
    "wall_clock": ("float64", "s, unix time; NaN where not logged"),
    "speed_mps": ("float64", "m/s measured; logged by our own runs only, else NaN"),
    "track": ("category", "name of the course; empty where not logged"),
}
"""Columns of `Recording.steps`: type and meaning with unit."""
UPDATE_COLUMNS: Mapping[str, tuple[str, str]] = {
    "iteration": ("int32", "policy update, counted as in the steps"),
    "epoch": (
        "int32",
        "pass over the iteration's steps, from 0; our own runs log the mean, as epoch 0",
    ),
    "policy_loss": ("float64", "surrogate loss"),
    "value_loss": ("float64", "NaN where not logged"),
    "kl": ("float64", "KL divergence of the policy before and after, nats"),
    "entropy": ("float64", "nats"),
    "lr": ("float64", "learning rate"),
}
"""Columns of `Recording.updates`: type and meaning with unit."""
METRICS_COLUMNS: Mapping[str, tuple[str, str]] = {
    "stream": ("category", "as in the steps"),
    "worker": ("int16", "as in the steps"),
    "iteration": ("int32", "as in the steps; of an evaluation, that of the training episodes before it"),
    "episode": ("int32", "counted from 0; the file counts from 1"),
    "trial": ("int32", "counted from 1 within the iteration"),
    "phase": ("category", "`training` or `evaluation`"),
    "reward": ("float64", "sum of the episode"),
    "completion": ("float64", "per cent of the lap"),
    "time_s": ("float64", "simulated seconds"),
    "episode_status": ("category", "as in the steps"),
    "resets": ("float64", "how often the car was put back; NaN where not logged"),
}
"""Columns of `Recording.metrics`: type and meaning with unit."""


def readable(name: str) -> str:
    """Return a file's name with a replacement for bytes that are not UTF-8 and for control characters."""
    text = name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def typed_table(
    columns: Mapping[str, tuple[str, str]], rows: Sequence[Mapping[str, Any]] = ()
) -> pd.DataFrame:
    """Return rows as a table with the columns and types of one of the schemas above."""
    frame = pd.DataFrame(list(rows), columns=list(columns))
    return frame.astype({name: kind for name, (kind, _) in columns.items()})


@dataclass(frozen=True)
class LogProblem:
    """A part of a recording that could not be read."""

    file: str
    line: int | None
    """Counted from 1; None: the whole file."""
    reason: str
    lines: int = 1
    """Number of lines in this problem: beyond a limit, the unreadable lines of a file are only counted."""

    def __post_init__(self) -> None:
        """Make the file's name printable."""
        object.__setattr__(self, "file", readable(self.file))

    def __str__(self) -> str:
        """Return the problem as one line."""
        return f"{self.file}{'' if self.line is None else f':{self.line}'}: {self.reason}"


@dataclass(frozen=True)
class Round:
    """One of several trainings in a recording; the numbers of a clone continue those of its parent."""

    name: str
    first_iteration: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Everything read from a folder, an archive or a file: a training, its evaluations and its settings."""

    name: str
    steps: pd.DataFrame
    """One row a control step, `STEP_COLUMNS`: the training, then each evaluation, in chronological order."""
    updates: pd.DataFrame
    """One row an epoch of a policy update, `UPDATE_COLUMNS`."""
    metrics: pd.DataFrame
    """One row an episode, from the service's metrics files, `METRICS_COLUMNS`."""
    metadata: ModelMetadata | None
    """Action space and sensors."""
    hyperparameters: Mapping[str, Any] | None
    reward_source: str | None
    """Text of the reward function."""
    track: str | None
    """Name of the course, as the training logs it."""
    problems: tuple[LogProblem, ...]
    files: tuple[Path, ...]
    """The files read; members of an archive have paths below the archive's."""
    checkpoints: Mapping[int, str] = field(default_factory=dict)
    """Name of the service's checkpoint that drove each iteration, from its text logs or, if every step before it is
    recorded, their number: `309_Step-8349`."""
    checkpoints_counted: bool = False
    """Whether these names come from counting alone: the numbers of a clone continue those of its parent."""
    model_checkpoints: Mapping[str, str] = field(default_factory=dict)
    """Names of the checkpoints in the model's folder: `best_checkpoint` by the service's own evaluations, and
    `last_checkpoint`."""
    rounds: tuple[Round, ...] = ()
    """The trainings in the order of `steps`; empty where there is only one."""
    race: Mapping[str, str] = field(default_factory=dict)
    """The parameters of the training, or else of a race, about boxes and bots, by the service's keys
    (`job_settings.race_values`)."""
