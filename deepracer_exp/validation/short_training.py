"""A short training that shows whether the policy learns anything from a reward function."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.files import METRICS

_FEWEST = 6
"""Fewest iterations whose thirds can be compared."""


def trial_seconds(text: str) -> float:
    """Return the seconds of `60s`, `2min` or `90`.

    Raises:
        BadInput: it is none of them.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(s|min)?", text)
    seconds = float(match[1]) * (60 if match[2] == "min" else 1) if match else 0.0
    if not seconds:
        raise BadInput(
            f"trial={text}: not a time; accepted: seconds or minutes above 0, e.g. trial=60s, trial=2min"
        )
    return seconds


def short_training_overrides(seconds: float) -> list[str]:
    """Return the overrides for a short training; its run goes to `runs/validate/`."""
    return [
        *("name=validate", "tracking=off", "stopping=none", "checkpoints.every=null"),
        *("budget=default", "budget.env_steps=null", "budget.alerts=[]", f"budget.minutes={seconds / 60!r}"),
    ]


@dataclass(frozen=True)
class Change:
    """A metric in the first and in the last third of a training."""

    name: str
    first: float
    last: float
    rises: bool
    """By more than twice the standard error of the difference."""


@dataclass(frozen=True)
class ShortTraining:
    """Result of a short training."""

    folder: Path
    env_steps: int
    first_episodes: int
    last_episodes: int
    changes: tuple[Change, ...]
    """Empty if the training was too short."""


def run_short_training(experiment: Experiment, composition: Composition, console: Console) -> ShortTraining:
    """Train the experiment and compare its first third with its last.

    Raises:
        BadInput: the experiment cannot be trained.
        RunFailed: the training failed.
        KeyboardInterrupt: it was interrupted.
    """
    from deepracer_exp.training.run import train

    outcome = train(experiment, composition, console)
    if outcome.status == "failed":
        raise RunFailed(f"trial: run failed: {outcome.reason}; see {outcome.folder}")
    if outcome.status == "interrupted":
        raise KeyboardInterrupt
    text = (outcome.folder / METRICS).read_text(encoding="utf-8")
    return compare_thirds(outcome.folder, [json.loads(line) for line in text.splitlines()])


def compare_thirds(folder: Path, rows: list[dict[str, float]]) -> ShortTraining:
    """Compare the iterations of the first third, rows of metrics.jsonl, with those of the last."""
    third = len(rows) // 3
    ended = np.diff([0, *(row["episodes"] for row in rows)])
    changes = []
    if len(rows) >= _FEWEST:
        for key, name in (("completion", "per cent of the lap"), ("mean_return", "reward of an episode")):
            first, last = (
                np.array([row[key] for row in part if row[key] is not None])
                for part in (rows[:third], rows[-third:])
            )
            if len(first) > 1 and len(last) > 1:
                error = np.hypot(
                    first.std(ddof=1) / np.sqrt(len(first)), last.std(ddof=1) / np.sqrt(len(last))
                )
                gain = last.mean() - first.mean()
                changes.append(Change(name, float(first.mean()), float(last.mean()), bool(gain > 2 * error)))
    return ShortTraining(
        folder=folder,
        env_steps=int(rows[-1]["env_steps"]) if rows else 0,
        first_episodes=int(ended[:third].sum()),
        last_episodes=int(ended[len(rows) - third :].sum()),
        changes=tuple(changes),
    )
