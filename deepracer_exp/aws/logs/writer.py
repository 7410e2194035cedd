"""The logs of a training as the service writes them: traces, metrics and text logs."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .sim_trace import LOG_LAYOUTS

TRACE_HEADER = ",".join(LOG_LAYOUTS[17])
"""Columns of the console's training traces of 2022; tools read a log line of 18 fields differently."""
LABELS = {
    "lap_complete": "Lap complete",
    "off_track": "Off track",
    "crashed": "Crashed",
    "immobilized": "Immobilized",
    "reversed": "Reversed",
    "time_up": "Time Up",
}
"""Last statuses of episodes in the words of the metrics file (deepracer-simapp, metrics/constants.py)."""
PLACES = {
    "console": {
        "trace": "sim-trace/training/training-simtrace",
        "metrics": "metrics/training/training-{job}.json",
    },
    "deepracer-for-cloud": {"trace": "training-simtrace", "metrics": "metrics/TrainingMetrics.json"},
}
"""Folders in which each layout keeps traces and metrics."""


@dataclass(frozen=True, kw_only=True)
class NumberedTraining:
    """The finished episodes in the service's numbering."""

    rows: pd.DataFrame
    """Their rows by episode; `number` and `trace_iteration` are in the service's numbering."""
    episodes: pd.DataFrame
    """One row each, in the same order: number, trial, iteration and the values of the metrics file."""
    per_iteration: int
    iterations: int
    first_iteration: int
    """The run's iteration that becomes the first one: the first in which an episode ended."""
    left_out: int
    """Rows of episodes interrupted by the end of the training."""


def log_head(world: str, metadata: str, hyperparameters: str) -> str:
    """Return what every log of the service begins with."""
    model = json.loads(metadata)
    return (
        f" * /WORLD_NAME: {world}\n"
        f"Sensor list {model['sensor']}, network {model['neural_network']}, simapp_version "
        f"{float(model['version'])}, training_algorithm {model['training_algorithm']}, action_space_type "
        f"{model['action_space_type']}\n"
        f"Action space from file: {model['action_space']}\n"
        f"Using the following hyper-parameters\n{hyperparameters}"
    )


def trainer_log(head: str, numbered: NumberedTraining, updates: pd.DataFrame) -> str:
    """Return the trainer's log: the end of each episode, and the mean over the epochs of each update."""
    lines = [head.rstrip("\n"), _saved(0, 0)]
    driven = 0
    by_iteration = dict(iter(numbered.episodes.groupby("iteration", sort=False)))
    losses = {int(row["iteration"]) - numbered.first_iteration: row for row in updates.to_dict("records")}
    for iteration in range(max([*by_iteration, *losses]) + 1):
        if iteration in by_iteration:
            for episode in by_iteration[iteration].itertuples():
                driven += int(episode.steps)
                lines.append(_episode_line(episode, driven, 0))
        row = losses.get(iteration)
        if row is not None:
            if pd.notna(row["kl"]):  # of SAC the service logs no line
                lines.append(
                    f"Policy training> Surrogate loss={row['policy_loss']}, KL divergence={row['kl']}, "
                    f"Entropy={row['entropy']}, training epoch=0, learning_rate={row['lr']}"
                )
            lines.append(_saved(iteration + 1, driven))
    return "\n".join(lines) + "\n"


def _saved(number: int, driven: int) -> str:
    """Return the line of a checkpoint; the one before any driving is 0, and drives the first iteration."""
    return f"Checkpoint> Saving in path=['./checkpoint/agent/{number}_Step-{driven}.ckpt']"


def _episode_line(episode: Any, driven: int, reward: float) -> str:
    return (
        f"Training> Name=main_level/agent, Worker=0, Episode={episode.number + 1}, Total reward={reward:g}, "
        f"Steps={driven}, Training iteration={episode.iteration}"
    )


def metrics_text(numbered: NumberedTraining, evaluated: pd.DataFrame) -> str:
    """Return the metrics file: an item for each episode, and for each evaluation.

    The service evaluates after an iteration the policy that drove it: ours, evaluated after its update, stands after
    the next iteration, and that of the last one is left out.
    """
    tried = {
        int(row["iteration"]) - numbered.first_iteration + 1: row for row in evaluated.to_dict("records")
    }
    items: list[dict[str, Any]] = []
    for iteration, episodes in numbered.episodes.groupby("iteration", sort=False):
        end_s = 0.0
        for episode in episodes.itertuples():
            end_s = episode.end_s
            items.append(
                _item(
                    episode.reward,
                    episode.begin_s,
                    episode.end_s,
                    episode=int(episode.number) + 1,
                    trial=int(episode.trial),
                    phase="training",
                    completion_percentage=int(episode.progress),
                    episode_status=LABELS.get(episode.status, episode.status),
                )
            )
        row = tried.get(int(iteration))
        if row is not None:
            lap_s = 0.0 if np.isnan(row["lap_time_s"]) else row["lap_time_s"]
            complete = row["completion"] >= 100.0
            items.append(
                _item(
                    0.0,
                    end_s,
                    end_s + lap_s,
                    episode=(int(iteration) + 1) * numbered.per_iteration,
                    trial=numbered.per_iteration,
                    phase="evaluation",
                    completion_percentage=int(row["completion"]),
                    episode_status=LABELS["lap_complete" if complete else "off_track"],
                )
            )
    return json.dumps({"metrics": items, "version": 2.0, "best_model_metric": "progress"}) + "\n"


def _item(reward: float, begin_s: float, end_s: float, **more: Any) -> dict[str, Any]:
    begin_ms, end_ms = round(begin_s * 1000), round(end_s * 1000)
    return {
        "reward_score": round(reward),
        "metric_time": end_ms,
        "start_time": begin_ms,
        "elapsed_time_in_milliseconds": end_ms - begin_ms,
        **more,
    }


def write_trace(numbered: NumberedTraining, folder: Path, log: Path, head: str) -> None:
    """Write one CSV per iteration, in full precision, and the same rows into the log, rounded as the service does."""
    folder.mkdir(parents=True, exist_ok=True)
    episodes, driven = numbered.episodes.itertuples(), 0
    with log.open("w", encoding="utf-8") as out:
        out.write(head)
        # An iteration in which no episode ended gets no file: tools do not expect one without rows.
        for iteration, rows in _trace(numbered.rows).groupby(numbered.rows["trace_iteration"]):
            table = rows.assign(steps=rows["steps"].astype(np.float64))
            table.to_csv(folder / f"{iteration}-iteration.csv", index=False)
            for _, of_episode in rows.groupby("episode"):
                out.writelines(map(_log_line, of_episode.itertuples()))
                driven += len(of_episode)
                episode: Any = next(episodes)
                out.write(_episode_line(episode, driven, episode.reward) + "\n")


def write_evaluation_trace(rows: pd.DataFrame, folder: Path) -> Path:
    """Write the steps of an evaluation, with the columns of a trace, as the service does; return the file."""
    file = folder / "evaluation-simtrace" / "0-iteration.csv"
    file.parent.mkdir()
    table = _trace(rows.assign(number=rows["episode"]))
    table.assign(steps=table["steps"].astype(np.float64)).to_csv(file, index=False)
    return file


def _trace(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with the columns of `TRACE_HEADER`."""
    table = rows.assign(episode=rows["number"])[TRACE_HEADER.split(",")]
    if rows["action"].isna().any():  # of a continuous action space, as the service has it
        both = zip(rows["steer"].tolist(), rows["throttle"].tolist(), strict=True)
        return table.assign(action=[f"[{steer} {throttle}]" for steer, throttle in both])
    return table.astype({"action": np.int64})


def _log_line(row: Any) -> str:
    return (
        f"SIM_TRACE_LOG:{row.episode},{row.steps},{row.X:.4f},{row.Y:.4f},{row.yaw:.4f},{row.steer:.2f},"
        f"{row.throttle:.2f},{row.action},{row.reward:.4f},{row.done},{row.all_wheels_on_track},{row.progress:.4f},"
        f"{row.closest_waypoint},{row.track_len:.2f},{row.tstamp!r},{row.episode_status},{row.pause_duration:.2f}\n"
    )
