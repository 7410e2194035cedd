"""Export the logs of a run as the service would have written them, for existing tools."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.writer import (
    PLACES,
    NumberedTraining,
    log_head,
    metrics_text,
    trainer_log,
    write_trace,
)
from deepracer_exp.aws.models.hyperparameters import hyperparameters_text
from deepracer_exp.aws.models.model_metadata import model_metadata_text
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.errors import BadInput, count, writing
from deepracer_exp.lookup.resolve import StoredRun
from deepracer_exp.runs.recording import RunRecording, read_run_recording

from .aws_files import hyperparameters_of, services_metadata
from .written import Written, write_files


def export_logs(run: StoredRun, layout: str, folder: Path) -> Written:
    """Write the logs of a run's training; arguments, result and errors as for `export.Writer`."""
    log = read_run_recording(run.path)
    notes = write_aws_logs(log, run.experiment, folder, layout)
    return [folder], [*notes, *map(str, log.recording.problems)]


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
    head = log_head(next(iter(experiment.tracks)), metadata, hyperparameters)
    texts = {
        "model/model_metadata.json": metadata,
        "ip/hyperparameters.json": hyperparameters,
        PLACES[layout]["metrics"].format(job=job): metrics_text(numbered, log.evaluations),
        f"logs/training/training-{job}-sagemaker.log": trainer_log(head, numbered, recording.updates),
    }
    if recording.reward_source is not None:
        texts["reward_function.py"] = recording.reward_source
    if layout == "console":
        texts |= {"model_metadata.json": metadata, "hyperparameters.json": hyperparameters}
    text_log = folder / f"logs/training/training-{job}-robomaker.log"
    with writing(folder, "another folder with -o"):
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise BadInput(f"--output {folder}", "is not empty", "a new or an empty folder")
        write_files(texts, folder)
        write_trace(numbered, folder / PLACES[layout]["trace"], text_log, head)
    rows, episodes = count(len(numbered.rows), "row"), count(len(numbered.episodes), "episode")
    what = f"{rows}, {episodes}, {count(numbered.iterations, 'iteration')}, as {layout} has them"
    return [what, *_notes(numbered, experiment)]


def _number(steps: pd.DataFrame, period_s: float) -> NumberedTraining:
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
    matching = episodes.loc[finished["episode"]]
    finished = finished.assign(number=matching["number"].array, trace_iteration=matching["iteration"].array)
    return NumberedTraining(
        rows=finished.sort_values("number", kind="stable"),
        episodes=episodes,
        per_iteration=per_iteration,
        iterations=int(iteration.max()) + 1,
        first_iteration=first,
        left_out=len(rows) - len(finished),
    )


def _notes(numbered: NumberedTraining, experiment: Experiment) -> list[str]:
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
