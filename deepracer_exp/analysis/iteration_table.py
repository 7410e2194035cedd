"""Iterations of a training, one row each: how it drove, and what the policy update told."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from deepracer_exp.formats.recording import Recording

ITERATION_COLUMNS: Mapping[str, str] = {
    "iteration": "policy update; the service counts from 0, our own runs from 1",
    "episodes": "that ended in it",
    "steps": "control steps driven for it",
    "complete": "episodes that completed the lap",
    "completion_mean": "per cent of the lap, mean over episodes",
    "lap_share": "share of episodes that completed the lap, 0 to 1",
    "reward_mean": "mean of the episodes' sums",
    "lap_time_mean_s": "s, of complete laps; NaN without one; so the next two",
    "lap_time_best_s": "s",
    "lap_time_p25_s": "s, 25th percentile",
    "speed_mps": "m/s commanded, mean over episodes",
    "entropy": "nats, mean over the update's epochs; NaN where not told; so the next ones",
    "kl": "nats",
    "policy_loss": "surrogate loss",
    "value_loss": "mean squared or Huber, as the training has it",
    "lr": "learning rate",
    "checkpoint": "the service's name of the checkpoint that drove it; empty where the log does not name it",
    "eval_completion": "per cent of the lap, mean of the evaluation episodes after the update",
    "held_out_completion": "per cent of the lap, the same on held-out conditions",
}
"""Names of the columns, with meaning and unit."""
FINISHED = 0.75
"""Share of the usual episodes below which the last iteration of a metrics file was not finished."""
_TOLD = ("entropy", "kl", "policy_loss", "value_loss", "lr")


def iteration_table(recording: Recording, steps: pd.DataFrame, episodes: pd.DataFrame) -> pd.DataFrame:
    """Sum up each iteration in one row, `ITERATION_COLUMNS`; iterations without an episode stand as well.

    Episodes whose end is not recorded are left out: those under way when a run ended would pass for bad ones.
    """
    groups = pd.concat([episodes[episodes["ended"]], _told_alone(recording, episodes)]).groupby("iteration")
    laps = groups["lap_time_s"]
    table = pd.DataFrame(
        {
            "episodes": groups.size(),
            "complete": groups["complete"].sum(),
            "completion_mean": groups["progress"].mean(),
            "lap_share": groups["complete"].mean(),
            "reward_mean": groups["reward"].mean(),
            "lap_time_mean_s": laps.mean(),
            "lap_time_best_s": laps.min(),
            "lap_time_p25_s": laps.quantile(0.25),
            "speed_mps": groups["speed_mps"].mean(),
        }
    )
    driven = np.bincount(steps["iteration"].to_numpy()) if len(steps) else np.zeros(0, np.int64)
    told = recording.updates.groupby("iteration")[list(_TOLD)].mean()
    known = pd.Index(np.flatnonzero(driven)).union(table.index).union(told.index)
    table = table.reindex(known).join(told).join(_evaluated(recording))
    table["steps"] = [int(driven[k]) if k < len(driven) else 0 for k in known]
    counts = table[["episodes", "complete"]].fillna(0).astype(np.int64)
    table = table.assign(episodes=counts["episodes"], complete=counts["complete"])
    table.index.name = "iteration"
    table["checkpoint"] = [recording.checkpoints.get(k, "") for k in known]
    return table.reset_index()[list(ITERATION_COLUMNS)].astype({"iteration": np.int64})


def _told_alone(recording: Recording, episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the training episodes that only metrics files tell of: their traces are not there."""
    told = recording.told
    told = told[(told["phase"] == "training") & (told["stream"] == "training")]
    counts = told.groupby("iteration").size()
    if len(counts) > 1 and counts.iloc[-1] < FINISHED * counts.median():
        told = told[told["iteration"] != counts.index[-1]]  # the job ended within it
    told = told[~told["episode"].isin(episodes["episode"])]
    complete = told["completion"] >= 100.0
    return pd.DataFrame(
        {
            "iteration": told["iteration"],
            "episode": told["episode"],
            "progress": told["completion"],
            "reward": told["reward"],
            "complete": complete,
            "lap_time_s": told["time_s"].where(complete),
            "speed_mps": np.nan,
        }
    ).astype({"complete": bool})


def _evaluated(recording: Recording) -> pd.DataFrame:
    """Return the mean completion of each iteration's evaluation, of our own runs or told of single episodes."""
    if len(recording.evaluated):
        own = recording.evaluated.groupby("iteration")[["completion", "held_out_completion"]].last()
        return own.rename(columns={"completion": "eval_completion"})
    told = recording.told
    told = told[(told["phase"] == "evaluation") & (told["stream"] == "training")]
    return (
        told.groupby("iteration")["completion"]
        .mean()
        .to_frame("eval_completion")
        .assign(held_out_completion=np.nan)
    )
