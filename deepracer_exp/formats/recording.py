"""What was recorded of a training or a race, whoever wrote it: one schema for all."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from .model_metadata import ModelMetadata
from .run_result import RunResult

TRAINING = "training"
"""The stream, and the kind of job, of what a training drove."""
STEP_COLUMNS: Mapping[str, tuple[str, str]] = {
    "stream": ("category", "`training`, or the name of an evaluation or race"),
    "worker": ("int16", "process of the service that drove, from 0"),
    "iteration": (
        "int32",
        "policy update that learned from the row; the service counts from 0, our own runs from 1",
    ),
    "episode": ("int32", "counted from 0 within the stream, unique in it over all workers"),
    "steps": ("int32", "control step of the episode; 1 is the prepare step where the generation writes one"),
    "X": ("float64", "m, front of the car"),
    "Y": ("float64", "m, front of the car"),
    "yaw": ("float64", "degrees, -180 to 180, counter-clockwise from +x"),
    "steer": ("float64", "degrees commanded, positive to the left"),
    "throttle": ("float64", "m/s commanded"),
    "action": ("float64", "action number; NaN where the policy gives [steer, throttle] itself"),
    "reward": ("float64", "reward units"),
    "done": ("bool", "last step of the episode"),
    "all_wheels_on_track": ("bool", "every wheel centre on the road"),
    "progress": ("float64", "per cent of the lap"),
    "closest_waypoint": ("int32", "index of the nearer of the two waypoints around"),
    "track_len": ("float64", "m"),
    "tstamp": ("float64", "s, simulated time; unix time in logs of 2019 and 2020"),
    "episode_status": ("category", "the service's words; empty where the generation has none"),
    "pause_duration": ("float64", "s of penalty left; 0 where the generation has none"),
    "obstacle_crash_counter": ("float64", "obstacles hit; NaN where not told"),
    "wall_clock": ("float64", "s, unix time; NaN where not told"),
    "speed_mps": ("float64", "m/s measured; NaN where not told (our own runs tell it)"),
    "track": ("category", "name of the course; empty where not told"),
}
"""Columns of `Recording.steps`: type and meaning with unit."""
UPDATE_COLUMNS: Mapping[str, tuple[str, str]] = {
    "iteration": ("int32", "policy update, counted as in the steps"),
    "epoch": (
        "int32",
        "pass over the iteration's steps, from 0; of our own runs the mean is told, as epoch 0",
    ),
    "policy_loss": ("float64", "surrogate loss"),
    "value_loss": ("float64", "NaN where not told"),
    "kl": ("float64", "KL divergence of the policy before and after, nats"),
    "entropy": ("float64", "nats"),
    "lr": ("float64", "learning rate"),
}
"""Columns of `Recording.updates`: type and meaning with unit."""
TOLD_COLUMNS: Mapping[str, tuple[str, str]] = {
    "stream": ("category", "as in the steps"),
    "worker": ("int16", "as in the steps"),
    "iteration": ("int32", "as in the steps; of an evaluation that of the training episodes before it"),
    "episode": ("int32", "counted from 0; the file counts from 1"),
    "trial": ("int32", "counted from 1 within the iteration"),
    "phase": ("category", "`training` or `evaluation`"),
    "reward": ("float64", "sum of the episode"),
    "completion": ("float64", "per cent of the lap"),
    "time_s": ("float64", "simulated seconds"),
    "episode_status": ("category", "the service's words, as in the steps"),
    "resets": ("float64", "how often the car was put back; NaN where not told"),
}
"""Columns of `Recording.told`: type and meaning with unit."""
EVALUATED_COLUMNS: Mapping[str, tuple[str, str]] = {
    "iteration": ("int32", "policy update after which the policy was evaluated, counted as in the steps"),
    "completion": ("float64", "per cent of the lap, mean over the laps tried"),
    "held_out_completion": (
        "float64",
        "the same on conditions kept out of the training; NaN where not tried",
    ),
    "lap_time_s": ("float64", "s, mean of the complete laps; NaN without one"),
}
"""Columns of `Recording.evaluated`: type and meaning with unit."""


def readable(name: str) -> str:
    """Return a file's name with a mark for each byte that is no UTF-8 and for what would steer a terminal."""
    text = name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def empty(columns: Mapping[str, tuple[str, str]]) -> pd.DataFrame:
    """Return a table of these columns without rows."""
    return pd.DataFrame({name: pd.Series(dtype=kind) for name, (kind, _) in columns.items()})


@dataclass(frozen=True)
class LogProblem:
    """Something that could not be read, while the rest was."""

    file: str
    line: int | None
    """Counted from 1; None: the whole file."""
    reason: str
    lines: int = 1
    """How many lines it stands for; after the first of a file that cannot be read, the others are only counted."""

    def __post_init__(self) -> None:
        """Make the name of the file one that can be shown."""
        object.__setattr__(self, "file", readable(self.file))

    def __str__(self) -> str:
        """Return it as one line."""
        return f"{self.file}{'' if self.line is None else f':{self.line}'}: {self.reason}"


@dataclass(frozen=True)
class Round:
    """One of several trainings in a recording; a clone goes on counting where the one before it ended."""

    name: str
    first_iteration: int
    first_episode: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """All that a folder, an archive or a file tells of a training and of what was driven with it."""

    name: str
    steps: pd.DataFrame
    """One row a control step, `STEP_COLUMNS`; training first, then each evaluation, in the order of time."""
    updates: pd.DataFrame
    """One row an epoch of a policy update, `UPDATE_COLUMNS`."""
    told: pd.DataFrame
    """What metrics files say of each episode, `TOLD_COLUMNS`."""
    evaluated: pd.DataFrame = field(
        default_factory=lambda: pd.DataFrame({name: [] for name in EVALUATED_COLUMNS})
    )
    """What our own runs' evaluations between the iterations came to, `EVALUATED_COLUMNS`; the service tells each of
    their episodes instead, in `told`."""
    metadata: ModelMetadata | None
    """Action space and sensors."""
    hyperparameters: Mapping[str, Any] | None
    reward_source: str | None
    """Text of the reward function."""
    track: str | None
    """Name of the course the training says it drove on."""
    problems: tuple[LogProblem, ...]
    files: tuple[Path, ...]
    """What was read; members of an archive stand below its path."""
    best: RunResult | None = None
    """Of a run of ours: its best checkpoint. None: a log of the service, whose iterations each have a checkpoint."""
    checkpoints: Mapping[int, str] = field(default_factory=dict)
    """Name of the service's checkpoint that drove each iteration, as its text logs prove it: `309_Step-8349`."""
    rounds: tuple[Round, ...] = ()
    """The trainings in the order of `steps`; empty where there is only one."""
