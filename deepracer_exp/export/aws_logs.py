"""Export the logs of a run as the service would have written them, for existing tools."""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.sim_trace import LOG_LAYOUTS
from deepracer_exp.aws.models.hyperparameters import hyperparameters_text
from deepracer_exp.aws.models.model_metadata import model_metadata_text
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.errors import BadInput, count, writing
from deepracer_exp.runs.recording import RunRecording

from .aws_files import hyperparameters_of, services_metadata, write_files

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
_PLACES = {
    "console": {
        "trace": "sim-trace/training/training-simtrace",
        "metrics": "metrics/training/training-{job}.json",
    },
    "deepracer-for-cloud": {"trace": "training-simtrace", "metrics": "metrics/TrainingMetrics.json"},
}


def write_aws_logs(log: RunRecording, experiment: Experiment, folder: Path, layout: str) -> list[str]:
    """Write the training of our own run in the layout of the console or of deepracer-for-cloud; return notes on it.

    The service's iterations consist of whole episodes, always equally many: tools derive the iteration from the
    episode's number. So an episode belongs to the iteration of its last row, and the numbers have gaps: iteration k
    starts at k * n, where n is the largest number of episodes in an iteration, num_episodes_between_training in
    hyperparameters.json; the last episode of the first iteration has number n - 1. A run keeps only the means of its
    evaluations, so the metrics file has one item for each.

    Raises:
        BadInput: no episode is finished, or the folder is not empty or cannot be written.
    """
    recording = log.recording
    numbered = _number(recording.steps, experiment.car.control_period_s)
    # The service's names of jobs: the time in 14 digits, a hyphen, the rest.
    dated = re.fullmatch(r"(\d{8})-(\d{6})-(.+)", recording.name)
    job = f"{dated[1]}{dated[2]}-{dated[3]}" if dated else f"{'0' * 14}-{recording.name}"
    learning = replace(hyperparameters_of(experiment), num_episodes_between_training=numbered.per_iteration)
    metadata = model_metadata_text(services_metadata(experiment))
    hyperparameters = hyperparameters_text(learning)
    head = _head(next(iter(experiment.tracks)), metadata, hyperparameters)
    texts = {
        "model/model_metadata.json": metadata,
        "ip/hyperparameters.json": hyperparameters,
        _PLACES[layout]["metrics"].format(job=job): _metrics_text(numbered, log.evaluations),
        f"logs/training/training-{job}-sagemaker.log": _trainer_log(head, numbered, recording.updates),
    }
    if recording.reward_source is not None:
        texts["reward_function.py"] = recording.reward_source
    if layout == "console":
        texts |= {"model_metadata.json": metadata, "hyperparameters.json": hyperparameters}
    text_log = folder / f"logs/training/training-{job}-robomaker.log"
    with writing(folder, "another folder with -o"):
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise BadInput(f"--output {folder}: is not empty; accepted: a new or an empty folder")
        write_files(texts, folder)
        _write_trace(numbered, folder / _PLACES[layout]["trace"], text_log, head)
    rows, episodes = count(len(numbered.rows), "row"), count(len(numbered.episodes), "episode")
    what = f"{rows}, {episodes}, {count(numbered.iterations, 'iteration')}, as {layout} has them"
    return [what, *_notes(numbered, experiment)]


@dataclass(frozen=True, kw_only=True)
class _Numbered:
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


def _number(steps: pd.DataFrame, period_s: float) -> _Numbered:
    rows = steps.sort_values("episode", kind="stable")
    begin = np.flatnonzero(np.diff(rows["episode"].to_numpy(), prepend=-1) != 0)
    counts = np.diff(np.r_[begin, len(rows)])
    first_row, last_row = rows.iloc[begin], rows.iloc[begin + counts - 1]
    episodes = pd.DataFrame(
        {
            "iteration": last_row["iteration"].to_numpy(),
            "steps": counts,
            "reward": np.add.reduceat(rows["reward"].to_numpy(), begin),
            "begin_s": first_row["tstamp"].to_numpy() - lap_clock_s(first_row["steps"].to_numpy(), period_s),
            "end_s": last_row["tstamp"].to_numpy(),
            "progress": last_row["progress"].to_numpy(),
            "status": last_row["episode_status"].astype(str).to_numpy(),
        },
        index=first_row["episode"],
    )[last_row["done"].to_numpy()].sort_values("iteration", kind="stable")
    if episodes.empty:
        raise BadInput("the run has no finished episode; the service's logs are made of these")
    first = int(episodes["iteration"].min())
    iteration = episodes["iteration"].to_numpy(np.int64) - first
    trial = episodes.groupby("iteration").cumcount().to_numpy() + 1
    per_iteration = int(trial.max())
    # Tools take the largest episode number in iteration 0 for the length of every iteration.
    trial[np.flatnonzero(iteration == 0)[-1]] = per_iteration
    episodes = episodes.assign(number=iteration * per_iteration + trial - 1, trial=trial, iteration=iteration)
    finished = rows[rows["episode"].isin(episodes.index)]
    own = episodes.loc[finished["episode"]]
    finished = finished.assign(number=own["number"].array, trace_iteration=own["iteration"].array)
    return _Numbered(
        rows=finished.sort_values("number", kind="stable"),
        episodes=episodes,
        per_iteration=per_iteration,
        iterations=int(iteration.max()) + 1,
        first_iteration=first,
        left_out=len(rows) - len(finished),
    )


def _head(world: str, metadata: str, hyperparameters: str) -> str:
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


def _trainer_log(head: str, numbered: _Numbered, updates: pd.DataFrame) -> str:
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


def _metrics_text(numbered: _Numbered, evaluated: pd.DataFrame) -> str:
    """Return the metrics file: an item for each episode, and for each evaluation."""
    tried = {int(row["iteration"]) - numbered.first_iteration: row for row in evaluated.to_dict("records")}
    items: list[dict[str, Any]] = []
    for iteration, episodes in numbered.episodes.groupby("iteration", sort=False):
        end_s = 0.0
        for one in episodes.itertuples():
            end_s = one.end_s
            items.append(
                _item(
                    one.reward,
                    one.begin_s,
                    one.end_s,
                    episode=int(one.number) + 1,
                    trial=int(one.trial),
                    phase="training",
                    completion_percentage=int(one.progress),
                    episode_status=LABELS.get(one.status, one.status),
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


def _write_trace(numbered: _Numbered, folder: Path, log: Path, head: str) -> None:
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


def _notes(numbered: _Numbered, experiment: Experiment) -> list[str]:
    notes = [
        f"hyperparameters.json: num_episodes_between_training={numbered.per_iteration}, the most that ended in one "
        "iteration; episode numbers have gaps in the others"
    ]
    if numbered.left_out:
        notes.append(f"{numbered.left_out:,} rows of unfinished episodes are left out")
    notes.append(
        f"iterations are counted from 0, as in the service: iteration 0 is the run's {numbered.first_iteration}"
        + ", the first in which an episode ended" * (numbered.first_iteration > 1)
    )
    if len(experiment.tracks) > 1:
        names = ", ".join(experiment.tracks)
        notes.append(
            f"{names}: the service's trace has no column for the track; use track_len to distinguish them"
        )
    return notes
