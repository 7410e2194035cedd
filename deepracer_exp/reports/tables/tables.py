"""The tables of a recording: one row for each episode, each iteration and each checkpoint worth submitting."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.recorded import Recording

from .statistics import Values
from .step_columns import first_rows, resets, whole_from_start

EPISODE_COLUMNS: Mapping[str, str] = {
    "iteration": "policy update that learned from its last row",
    "episode": "number within the stream",
    "worker": "rollout worker of the service that drove it",
    "steps": "control steps from the first to the last, both counted",
    "start_at": "waypoint of its first row",
    "progress": "per cent of the lap, the highest",
    "time_s": "simulated seconds from the first row to the last; of a flying lap from the last row of the one before",
    "dist_m": "m driven, between rows in a straight line",
    "reward": "sum",
    "speed_mps": "m/s commanded, mean of all rows",
    "time_if_complete_s": "s, time_s * 100 / progress; NaN without progress",
    "reward_if_complete": "reward * 100 / progress; NaN without progress",
    "ended": "whether its last row is the end of the episode, not just of the recording",
    "complete": "whether progress reached 100 per cent",
    "resets": "how often the car was put back on the way",
    "lap_time_s": "s, lap_clock_s at the end of a lap: complete, without a reset, its beginning recorded; else NaN",
    "reset_lap_time_s": "s, the same of a complete lap with resets, their penalties included; else NaN",
    "status": "episode_status of its last row; lap_complete of a lap in a race; where the format has none, "
    "lap_complete, off_track or empty",
    "last_waypoint": "waypoint of its last row",
    "quarter": "1 to 4, of the training's episodes in their order",
    "quintile": "1 to 5, likewise",
}
"""Names of the columns, with meaning and unit; the first ones equal deepracer-utils' `simulation_agg`."""
ITERATION_COLUMNS: Mapping[str, str] = {
    "iteration": "policy update; the service counts from 0, our own runs from 1",
    "episodes": "that ended in it",
    "steps": "control steps driven for it",
    "complete": "episodes that completed the lap",
    "completion_mean": "per cent of the lap, mean over episodes",
    "lap_share": "share of episodes that completed the lap, 0 to 1",
    "reward_mean": "mean of the episodes' sums",
    "lap_time_mean_s": "s, of complete laps that compare; NaN without one; likewise the next two",
    "lap_time_best_s": "s",
    "lap_time_p25_s": "s, 25th percentile",
    "speed_mps": "m/s commanded, mean over episodes",
    "entropy": "nats, mean over the update's epochs; NaN where not logged; likewise the next ones",
    "kl": "nats",
    "policy_loss": "surrogate loss",
    "value_loss": "mean squared or Huber, as the training has it",
    "lr": "learning rate",
    "checkpoint": "the service's name of the checkpoint that drove it; empty where the log does not name it",
    "eval_completion": "per cent of the lap, mean of the evaluation: the service's judges the policy that drove the "
    "iteration, that of our own runs the policy after its update; likewise the next ones",
    "held_out_completion": "per cent of the lap, the same on held-out conditions",
    "eval_lap_share": "complete laps of the evaluation on usual conditions, as a share of those tried",
    "eval_lap_time_s": "s, mean of the complete laps of the evaluation on usual conditions; NaN on several tracks",
    "eval_zigzag_per_m": "changes of steering a metre of straight in the evaluation",
}
"""Names of the columns, with meaning and unit."""
CANDIDATE_LAPS = 3
"""Fewest complete laps of an iteration for a meaningful 25th percentile."""
DENSE = 0.5
"""Share of complete laps a candidate must have, over the highest share of an iteration with `CANDIDATE_LAPS`."""
MOST_CANDIDATES = 3
UNTRAINED = "0_"
"""Beginning of the name of a training's first checkpoint, unless it is a clone."""
CANDIDATE_COLUMNS: Mapping[str, str] = {
    "iteration": "that the checkpoint drove",
    "checkpoint": "the service's name of it; empty where the log does not name it",
    "evaluated": "whether its evaluation is judged; else the training's own laps",
    **{name: ITERATION_COLUMNS[name] for name in ("lap_time_p25_s", "lap_time_best_s", "lap_time_mean_s")},
    **{name: ITERATION_COLUMNS[name] for name in ("lap_share", "complete", "episodes")},
}
"""Names of the columns, with meaning and unit; laps, shares and times are those of the judged laps."""
_REPORTED = ("entropy", "kl", "policy_loss", "value_loss", "lr")


def episode_table(steps: pd.DataFrame) -> pd.DataFrame:
    """Summarise each episode in one row, `EPISODE_COLUMNS`, in the order of the steps.

    Steps, start, progress, time, distance, speed, reward and completeness are defined as in deepracer-utils 1.5.6
    (logs/log_utils.py, `simulation_agg`); its time does not include the step before the first row, which belongs to
    a lap time.

    The rows of each episode are contiguous and in the order of time, with the derived columns.
    """
    begin = np.flatnonzero(first_rows(steps))
    end = np.append(begin[1:], len(steps))[: len(begin)] - 1

    def combined(name: str, how: np.ufunc = np.add) -> Values:
        return how.reduceat(steps[name].to_numpy(np.float64), begin)

    progress, time_s, reward = combined("progress", np.maximum), combined("delta_time_s"), combined("reward")
    number, clock_s = steps["steps"].to_numpy(), steps["lap_clock_s"].to_numpy()[end]
    complete, put_back = progress >= 100.0, resets(steps)
    timed = complete & whole_from_start(steps) & (time_s > 0)
    per_lap = np.divide(100.0, progress, out=np.full(len(begin), np.nan), where=progress > 0)
    first_row, last_row = (steps.iloc[rows].reset_index(drop=True) for rows in (begin, end))
    status = last_row["episode_status"].astype(str)
    unknown, ended = status == "", last_row["done"].astype(bool)
    off = unknown & ended & ~last_row["all_wheels_on_track"].astype(bool)
    lap = complete & (unknown | (status == "in_progress"))  # in races the next lap follows
    order = np.arange(len(begin))
    return pd.DataFrame(
        {
            "iteration": last_row["iteration"],
            "episode": first_row["episode"],
            "worker": first_row["worker"],
            "steps": np.maximum.reduceat(number, begin) - np.minimum.reduceat(number, begin) + 1,
            "start_at": first_row["closest_waypoint"],
            "progress": progress,
            "time_s": time_s,
            "dist_m": combined("delta_dist_m"),
            "reward": reward,
            "speed_mps": combined("throttle") / (end - begin + 1),
            "time_if_complete_s": time_s * per_lap,
            "reward_if_complete": reward * per_lap,
            "ended": complete | ended,
            "complete": complete,
            "resets": put_back,
            "lap_time_s": np.where(timed & (put_back == 0), clock_s, np.nan),
            "reset_lap_time_s": np.where(timed & (put_back > 0), clock_s, np.nan),
            "status": status.mask(lap, "lap_complete").mask(off & ~complete, "off_track"),
            "last_waypoint": last_row["closest_waypoint"],
            "quarter": 1 + 4 * order // len(order),
            "quintile": 1 + 5 * order // len(order),
        }
    )


def iteration_table(
    recording: Recording,
    steps: pd.DataFrame,
    episodes: pd.DataFrame,
    least_episodes: int = 0,
    evaluations: pd.DataFrame | None = None,
) -> pd.DataFrame:
    """Summarise each iteration in one row, `ITERATION_COLUMNS`, also those without an episode.

    Episodes whose end is not recorded are left out: those still driving when a run ended would count as bad ones.

    Args:
        recording: of the training.
        steps: of the training on the course.
        episodes: theirs.
        least_episodes: consecutive iterations are put together until each row has as many; it has the number of the
            last of them.
        evaluations: those of a run of ours, `runs.recording.EVALUATION_COLUMNS`.
    """
    ended = pd.concat([episodes[episodes["ended"]], _from_metrics_only(recording, episodes)])
    driven = steps.groupby("iteration").size()
    updates = recording.updates.groupby("iteration")[list(_REPORTED)].mean()
    evaluated = _evaluated(recording, evaluations)
    if least_episodes:
        iterations = (
            driven.index.union(ended["iteration"].unique()).union(updates.index).union(evaluated.index)
        )
        row_of = _put_together(iterations, ended["iteration"], least_episodes)
        ended = ended.assign(iteration=ended["iteration"].map(row_of))
        driven = driven.groupby(row_of).sum()
        updates, evaluated = updates.groupby(row_of).mean(), evaluated.groupby(row_of).mean()
    groups = ended.groupby("iteration")
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
    iterations = driven.index.union(table.index).union(updates.index)
    table = table.reindex(iterations).join(updates).join(evaluated).assign(steps=driven)
    table = table.fillna({"episodes": 0, "complete": 0, "steps": 0})
    table["checkpoint"] = [recording.checkpoints.get(k, "") for k in iterations]
    whole = dict.fromkeys(("iteration", "episodes", "steps", "complete"), np.int64)
    return table.rename_axis("iteration").reset_index()[list(ITERATION_COLUMNS)].astype(whole)


def _put_together(iterations: pd.Index, ended: pd.Series, least_episodes: int) -> "pd.Series[int]":
    """Return the last iteration of each iteration's block; the newest block may have fewer episodes."""
    counts = ended.value_counts().reindex(iterations, fill_value=0)
    rows, gathered = [], 0
    for count in counts:
        rows.append(gathered >= least_episodes)
        gathered = count + (0 if rows[-1] else gathered)
    number = pd.Series(np.cumsum(rows), iterations)
    last = pd.Series(iterations, iterations).groupby(number).max()
    return number.map(last)


def _from_metrics_only(recording: Recording, episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the training episodes that only metrics files have."""
    rows = recording.metrics
    rows = rows[(rows["phase"] == "training") & (rows["stream"] == "training")]
    rows = rows[~rows["episode"].isin(episodes["episode"])].rename(columns={"completion": "progress"})
    complete = rows["progress"] >= 100.0
    rows = rows.assign(complete=complete, lap_time_s=rows["time_s"].where(complete), speed_mps=np.nan)
    columns = ["iteration", "episode", "progress", "reward", "complete", "lap_time_s", "speed_mps"]
    return rows[columns].astype({"complete": bool})


def _evaluated(recording: Recording, evaluations: pd.DataFrame | None) -> pd.DataFrame:
    """Return the means of each iteration's evaluation: of our own runs, or of the service's metrics.

    The zig-zag in it is that of our own runs only: in the service's traces evaluations have no iteration.
    """
    if evaluations is not None and len(evaluations):
        means = evaluations.groupby("iteration").last()
        if recording.track is None:  # a mean over several tracks
            means["lap_time_s"] = np.nan
        names = ("completion", "lap_share", "lap_time_s", "zigzag_per_m")
        return means.rename(columns={name: f"eval_{name}" for name in names})
    rows = _evaluation_rows(recording)
    groups = rows.assign(time_s=rows["time_s"].where(rows["lap"])).groupby("iteration")
    means = groups["completion"].mean().to_frame("eval_completion")
    laps = {"eval_lap_share": groups["lap"].mean(), "eval_lap_time_s": groups["time_s"].mean()}
    return means.assign(held_out_completion=np.nan, **laps, eval_zigzag_per_m=np.nan)


def _evaluation_rows(recording: Recording) -> pd.DataFrame:
    """Return the evaluation episodes of a training's metrics files; `lap`: whether it is one without a reset."""
    rows = recording.metrics
    rows = rows[(rows["phase"] == "evaluation") & (rows["stream"] == "training")]
    return rows.assign(lap=(rows["completion"] >= 100.0) & ~(rows["resets"] > 0))


def candidates(recording: Recording, iterations: pd.DataFrame) -> pd.DataFrame:
    """Return up to `MOST_CANDIDATES` checkpoints of the service worth submitting, the best first; `CANDIDATE_COLUMNS`.

    Evaluations decide where they completed a lap: they race the policy that is submitted, while a training draws its
    actions. The largest share of complete laps is first, then the lowest mean lap time. Otherwise the training's own
    laps decide, fast and dense (after TheRayG/deepracer-log-analysis): at least `CANDIDATE_LAPS` complete laps, and
    `DENSE` of the highest share of complete laps among these; of them the ones with the lowest 25th percentile of the
    lap time.

    The service evaluates after an iteration the policy that has driven it, before it restores the next checkpoint
    (deepracer-simapp, markov/rollout_worker.py). The first iteration's network has learned nothing and is no candidate,
    unless its name is that of a cloned model.
    """
    checkpoints = recording.checkpoints
    began = [part.first_iteration for part in recording.rounds] or [0]
    untrained = [k for k in began if checkpoints.get(k, UNTRAINED).startswith(UNTRAINED)]
    rows = _evaluation_rows(recording)
    groups = rows.assign(time_s=rows["time_s"].where(rows["lap"])).groupby("iteration")
    raced = pd.DataFrame(
        {
            "episodes": groups.size(),
            "complete": groups["lap"].sum(),
            "lap_share": groups["lap"].mean(),
            "lap_time_mean_s": groups["time_s"].mean(),
            "lap_time_best_s": groups["time_s"].min(),
        }
    )
    raced = raced[(raced["complete"] > 0) & ~raced.index.isin(untrained)]
    if len(raced):
        raced = raced.reset_index().assign(lap_time_p25_s=np.nan, evaluated=True)
        ranked = raced.sort_values(["lap_share", "lap_time_mean_s"], ascending=[False, True], kind="stable")
    else:
        trained = iterations[~iterations["iteration"].isin(untrained)].assign(evaluated=False)
        enough = trained["lap_time_p25_s"].notna() & (trained["complete"] >= CANDIDATE_LAPS)
        dense = trained["lap_share"] >= DENSE * trained.loc[enough, "lap_share"].max()
        ranked = trained[enough & dense].sort_values("lap_time_p25_s", kind="stable")
    named = ranked.assign(checkpoint=[checkpoints.get(k, "") for k in ranked["iteration"]])
    return named.head(MOST_CANDIDATES).reset_index(drop=True)[list(CANDIDATE_COLUMNS)]
