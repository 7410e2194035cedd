"""The tables of a recording: columns derived from its steps, one row an episode and an iteration, the candidates."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import NDArray

from deepracer_exp.aws.logs.recording import TRAINING, Recording
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.tracks.track import Track

from .statistics import Values

DERIVED_COLUMNS: Mapping[str, str] = {
    "lap_clock_s": "s since the lap began, as the service counts a lap time (`rules.lap_clock_s`)",
    "delta_time_s": "s since the row before; 0 in an episode's first row except on a flying lap; likewise the others",
    "delta_dist_m": "m from the row before; 0 in an episode's first row",
    "track_speed_mps": "m/s, distance over time since the row before; NaN in an episode's first row",
    "progress_speed_pps": "per cent of the lap a second since the row before; NaN in an episode's first row",
    "acceleration_mps2": "m/s2 of growing track speed, between the rows before and after; 0 where it falls",
    "braking_mps2": "m/s2 of falling track speed, likewise, positive; 0 where it grows",
    "yaw_rate_dps": "degrees a second since the row before, positive to the left",
    "true_bearing_deg": "degrees, -180 to 180, direction in which the logged point moved since the row before",
    "slide_deg": "degrees, direction in which the rear axle moved since the row before minus the mean of both yaws; "
    "0 for tyres that do not slip, positive where the tail goes to the left",
    "skew_deg": "degrees, direction of travel minus that of the centre line, positive to the left",
    "lap_position": "0 to 1, normalised projection on the centre line in driving direction; without a course "
    "computed from progress and the waypoint of the start",
    "offset_m": "m from the centre line, positive to the left of the driving direction",
    "discounted_future_reward": "reward units, of this row and all later ones of the episode, discounted",
}
"""Names of the columns that `add_derived` adds, with meaning and unit."""
CONTROL_PERIOD_S = 1 / 15
"""The service's, for recordings without two rows in succession."""
FRONT_TO_REAR_AXLE_M = 0.14 + 0.081663
"""From the logged point back to the rear axle (deepracer-simapp: front point, rear wheels of the car's model)."""
STILL_M = 0.01
"""Below this a movement has no direction."""
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
STOPPED = ("off_track", "crashed", "immobilized", "reversed")
"""Status of the rows after which a car is put back, or the episode ends."""
FIRST_STEPS = 2
"""Highest step number of an episode's first row: formats without prepare rows may begin with 2."""
ITERATION_COLUMNS: Mapping[str, str] = {
    "iteration": "policy update; the service counts from 0, our own runs from 1",
    "episodes": "that ended in it",
    "steps": "control steps driven for it",
    "complete": "episodes that completed the lap",
    "completion_mean": "per cent of the lap, mean over episodes",
    "lap_share": "share of episodes that completed the lap, 0 to 1",
    "reward_mean": "mean of the episodes' sums",
    "lap_time_mean_s": "s, of complete laps; NaN without one; likewise the next two",
    "lap_time_best_s": "s",
    "lap_time_p25_s": "s, 25th percentile",
    "speed_mps": "m/s commanded, mean over episodes",
    "entropy": "nats, mean over the update's epochs; NaN where not logged; likewise the next ones",
    "kl": "nats",
    "policy_loss": "surrogate loss",
    "value_loss": "mean squared or Huber, as the training has it",
    "lr": "learning rate",
    "checkpoint": "the service's name of the checkpoint that drove it; empty where the log does not name it",
    "eval_completion": "per cent of the lap, mean of the evaluation episodes after the update",
    "held_out_completion": "per cent of the lap, the same on held-out conditions",
    "eval_lap_share": "complete laps of the evaluation on usual conditions, as a share of those tried",
    "eval_lap_time_s": "s, mean of the complete laps of the evaluation on usual conditions; NaN on several tracks",
    "eval_zigzag_per_m": "changes of steering a metre of straight in the evaluation",
}
"""Names of the columns, with meaning and unit."""
FINISHED = 0.75
"""Share of the usual number of episodes below which the last iteration of a metrics file was not finished."""
CANDIDATE_LAPS = 3
"""Complete laps of an iteration below which its 25th percentile means nothing."""
DENSE = 0.5
"""Share of complete laps a candidate must have, over the highest share of an iteration with `CANDIDATE_LAPS`."""
MOST_CANDIDATES = 3
CANDIDATE_COLUMNS: Mapping[str, str] = {
    "iteration": "that the checkpoint drove",
    "checkpoint": "the service's name of it; empty where the log does not name it",
    "evaluated": "whether its evaluation is judged; else the training's own laps",
    **{name: ITERATION_COLUMNS[name] for name in ("lap_time_p25_s", "lap_time_best_s", "lap_time_mean_s")},
    **{name: ITERATION_COLUMNS[name] for name in ("lap_share", "complete", "episodes")},
}
"""Names of the columns, with meaning and unit; laps, shares and times are those of what is judged."""
_REPORTED = ("entropy", "kl", "policy_loss", "value_loss", "lr")


def add_derived(steps: pd.DataFrame, course: Track | None, discount: float) -> pd.DataFrame:
    """Return the steps with `DERIVED_COLUMNS`.

    Args:
        steps: rows of each episode contiguous and in the order of time.
        course: what was driven on.
        discount: factor on the reward of the next step.
    """
    x, y, yaw, time_s, progress, reward = (
        steps[name].to_numpy(np.float64) for name in ("X", "Y", "yaw", "tstamp", "progress", "reward")
    )
    first = first_rows(steps)
    lap_position, offset_m, center_deg = _places(steps, first, course)
    stopped = first & ~flying_rows(steps)
    delta_time_s, dx, dy = (_since(values, stopped) for values in (time_s, x, y))
    delta_dist_m = np.hypot(dx, dy)
    moving = ~stopped & (delta_dist_m >= STILL_M)
    passed_s = np.where(delta_time_s > 0, delta_time_s, np.nan)
    track_speed_mps = delta_dist_m / passed_s
    change = _change(track_speed_mps, time_s, stopped)
    turned = _wrapped(_since(yaw, stopped))
    bearing = np.where(moving, np.degrees(np.arctan2(dy, dx)), np.nan)
    heading = np.radians(yaw)
    rear_dx = _since(x - FRONT_TO_REAR_AXLE_M * np.cos(heading), stopped)
    rear_dy = _since(y - FRONT_TO_REAR_AXLE_M * np.sin(heading), stopped)
    slide = _wrapped(np.degrees(np.arctan2(rear_dy, rear_dx)) - (yaw - turned / 2))
    # Both are directions between two rows, because a centre line turns by up to 10 degrees at a waypoint.
    center_turned = _wrapped(_since(center_deg, first))
    return steps.assign(
        lap_clock_s=_lap_clock(steps, stopped, first, delta_time_s),
        delta_time_s=delta_time_s,
        delta_dist_m=delta_dist_m,
        track_speed_mps=track_speed_mps,
        progress_speed_pps=_since(progress, first) / np.where(first, np.nan, passed_s),
        acceleration_mps2=np.maximum(change, 0.0),
        braking_mps2=np.maximum(-change, 0.0),
        yaw_rate_dps=turned / passed_s,
        true_bearing_deg=bearing,
        slide_deg=np.where(moving & (np.hypot(rear_dx, rear_dy) >= STILL_M), slide, np.nan),
        skew_deg=_wrapped(bearing - (center_deg - center_turned / 2)),
        lap_position=lap_position,
        offset_m=offset_m,
        discounted_future_reward=_discounted(np.nan_to_num(reward), first, discount),
    )


def _lap_clock(
    steps: pd.DataFrame, stopped: NDArray[np.bool_], first: NDArray[np.bool_], delta_time_s: Values
) -> Values:
    """Return the clock of a lap: the time before its first row was driven without a pause, the rest is recorded."""
    begin, tstamp = np.flatnonzero(first), steps["tstamp"].to_numpy(np.float64)
    period_s = float(np.median(delta_time_s[~stopped])) if not stopped.all() else CONTROL_PERIOD_S
    # The generation that counts from 0 has no prepare rows either.
    before_s = lap_clock_s(np.maximum(steps["steps"].to_numpy()[begin], 1), period_s)
    began_s = tstamp[begin] - np.where(stopped[begin], before_s, delta_time_s[begin])
    return tstamp - began_s[np.cumsum(first) - 1]


def timed_by_service(steps: pd.DataFrame, metrics: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """Set the clocks of complete laps to the times that the service's metrics files give.

    Args:
        steps: rows of each episode contiguous, with the derived columns.
        metrics: `recording.METRICS_COLUMNS`.

    Returns:
        The steps, and of how many laps without resets the files give the time.
    """
    in_training = metrics["stream"].astype(str) == TRAINING
    laps = metrics[(metrics["completion"] >= 100.0) & (in_training == (metrics["phase"] == "training"))]
    if laps.empty or steps.empty:
        return steps, 0
    begin = np.flatnonzero(first_rows(steps))
    counts = np.diff(np.append(begin, len(steps)))
    end = begin + counts - 1
    official = laps.drop_duplicates(["stream", "episode"]).astype({"stream": str})
    keys = steps.iloc[end][["stream", "episode"]].astype({"stream": str})
    known_s = keys.merge(official, how="left", on=["stream", "episode"])["time_s"].to_numpy(np.float64)
    whole = (np.maximum.reduceat(steps["progress"].to_numpy(np.float64), begin) >= 100.0) & whole_from_start(
        steps
    )
    late_s = np.where(whole, known_s - steps["lap_clock_s"].to_numpy()[end], np.nan)
    moved = steps["lap_clock_s"].to_numpy() + np.repeat(np.nan_to_num(late_s), counts)
    return steps.assign(lap_clock_s=moved), int((np.isfinite(late_s) & (resets(steps) == 0)).sum())


def _places(
    steps: pd.DataFrame, first: NDArray[np.bool_], course: Track | None
) -> tuple[Values, Values, Values]:
    """Return lap position, offset and the centre line's direction in degrees."""
    if course is not None:
        found = course.project(steps[["X", "Y"]].to_numpy(np.float64))
        return found.ndist, found.offset_m, np.degrees(found.heading_rad)
    unknown = np.full(len(steps), np.nan)
    if not len(steps):
        return unknown, unknown, unknown
    waypoint, progress = (steps[name].to_numpy(np.float64) for name in ("closest_waypoint", "progress"))
    start = waypoint / (waypoint.max() + 1.0) - progress / 100.0
    return (start[first][np.cumsum(first) - 1] + progress / 100.0) % 1.0, unknown, unknown


def _since(values: Values, first: NDArray[np.bool_]) -> Values:
    """Return the differences to the rows before, 0 in first rows."""
    since = np.diff(values, prepend=values[:1])
    since[first] = 0.0
    return since


def _change(speed_mps: Values, time_s: Values, first: NDArray[np.bool_]) -> Values:
    """Return the speed's change a second between the rows before and after; 0 where one of them is missing.

    A speed is that of the time since the row before: its moment is the middle of it. Control steps last 50 to 80 ms
    in the service's traces, so that differences of neighbours would be mostly noise.
    """
    change = np.zeros(len(speed_mps))
    if len(change) > 3:
        passed_s = (time_s[3:] + time_s[2:-1] - time_s[1:-2] - time_s[:-3]) / 2.0
        with np.errstate(divide="ignore", invalid="ignore"):
            change[2:-1] = (speed_mps[3:] - speed_mps[1:-2]) / passed_s
        change[2:-1][first[3:] | first[2:-1] | first[1:-2]] = 0.0
    return np.nan_to_num(change, nan=0.0, posinf=0.0, neginf=0.0)


def _wrapped(angle_deg: Values) -> Values:
    return (angle_deg + 180.0) % 360.0 - 180.0


@njit(cache=True, nogil=True)
def _discounted(reward, first, discount):  # type: ignore[no-untyped-def]
    future = np.empty(len(reward))
    total = 0.0
    for i in range(len(reward) - 1, -1, -1):
        total = reward[i] + discount * total
        future[i] = total
        if first[i]:
            total = 0.0
    return future


def first_rows(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Return which rows are the first of their episode; the rows of an episode must be contiguous."""
    stream = steps["stream"].astype("category").cat.codes.to_numpy()
    episode = steps["episode"].to_numpy()
    first = np.ones(len(steps), bool)
    first[1:] = (episode[1:] != episode[:-1]) | (stream[1:] != stream[:-1])
    return first


def flying_rows(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Return which first rows continue the row before: laps of a race are driven without a stop."""
    number = steps["steps"].to_numpy()
    stream = steps["stream"].astype("category").cat.codes.to_numpy()
    flying = first_rows(steps) & (number > FIRST_STEPS)
    flying[:1] = False
    flying[1:] &= (number[1:] == number[:-1] + 1) & (stream[1:] == stream[:-1])
    return flying


def whole_from_start(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Return for each episode whether its beginning is recorded."""
    begin = np.flatnonzero(first_rows(steps))
    return (steps["steps"].to_numpy()[begin] <= FIRST_STEPS) | flying_rows(steps)[begin]


def resets(steps: pd.DataFrame) -> NDArray[np.int64]:
    """Return for each episode how often the car was put back on its way."""
    first = first_rows(steps)
    stopped = steps["episode_status"].isin(STOPPED).to_numpy()
    begins = stopped.copy()
    begins[1:] &= first[1:] | ~stopped[:-1]
    begin = np.flatnonzero(first)
    end = np.append(begin[1:], len(steps))[: len(begin)] - 1
    return (
        np.add.reduceat(begins, begin, dtype=np.int64) - stopped[end] if len(begin) else np.zeros(0, np.int64)
    )


def laps_driven(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Return for each episode whether it is a complete lap without a reset whose beginning is recorded.

    Only these show the driving line and what a lap takes: a car that is put back stands, and drives a part of the lap
    again.
    """
    begin = np.flatnonzero(first_rows(steps))
    progress = steps["progress"].to_numpy(np.float64)
    complete = np.maximum.reduceat(progress, begin) >= 100.0 if len(begin) else np.zeros(0, bool)
    return complete & whole_from_start(steps) & (resets(steps) == 0)


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
    first_row, last_row = (steps.iloc[at].reset_index(drop=True) for at in (begin, end))
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
        known = driven.index.union(ended["iteration"].unique()).union(updates.index).union(evaluated.index)
        row_of = _put_together(known, ended["iteration"], least_episodes)
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
    known = driven.index.union(table.index).union(updates.index)
    table = table.reindex(known).join(updates).join(evaluated).assign(steps=driven)
    table = table.fillna({"episodes": 0, "complete": 0, "steps": 0})
    table["checkpoint"] = [recording.checkpoints.get(k, "") for k in known]
    whole = dict.fromkeys(("iteration", "episodes", "steps", "complete"), np.int64)
    return table.rename_axis("iteration").reset_index()[list(ITERATION_COLUMNS)].astype(whole)


def _put_together(iterations: pd.Index, ended: pd.Series, least_episodes: int) -> "pd.Series[int]":
    """Return for each iteration the last of those that make up its row; the newest row may have fewer episodes."""
    counts = ended.value_counts().reindex(iterations, fill_value=0)
    rows, gathered = [], 0
    for count in counts:
        rows.append(gathered >= least_episodes)
        gathered = count + (0 if rows[-1] else gathered)
    number = pd.Series(np.cumsum(rows), iterations)
    last = pd.Series(iterations, iterations).groupby(number).max()
    return number.map(last)


def _from_metrics_only(recording: Recording, episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the training episodes that are in metrics files only, without a trace."""
    rows = recording.metrics
    rows = rows[(rows["phase"] == "training") & (rows["stream"] == "training")]
    counts = rows.groupby("iteration").size()
    if len(counts) > 1 and counts.iloc[-1] < FINISHED * counts.median():
        rows = rows[rows["iteration"] != counts.index[-1]]  # the job ended within it
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
        if recording.track is None:  # a mean over whichever tracks have a lap
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
    """Return the checkpoints of the service worth submitting, the best first, at most `MOST_CANDIDATES`.

    Evaluations decide where they completed a lap: they race the policy that is submitted, while a training draws its
    actions. The largest share of complete laps is first, then the lowest mean lap time. Otherwise the training's own
    laps decide, fast and dense (after TheRayG/deepracer-log-analysis): at least `CANDIDATE_LAPS` complete laps, and
    `DENSE` of the highest share of complete laps among these; of them the ones with the lowest 25th percentile of the
    lap time.

    A policy that no update of this training has changed is none of its results: what drove iteration 0 is a network
    that has learned nothing, or the model that was cloned.

    Args:
        recording: of the service.
        iterations: `ITERATION_COLUMNS`, those to be judged.

    Returns:
        `CANDIDATE_COLUMNS`.
    """
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
    raced = raced[raced["complete"] > 0]
    if len(raced):
        # What is evaluated after an iteration drives the next one.
        raced = raced.reset_index().assign(lap_time_p25_s=np.nan, evaluated=True)
        raced["iteration"] += 1
        ranked = raced.sort_values(["lap_share", "lap_time_mean_s"], ascending=[False, True], kind="stable")
    else:
        trained = iterations[iterations["iteration"] > 0].assign(evaluated=False)
        enough = trained["lap_time_p25_s"].notna() & (trained["complete"] >= CANDIDATE_LAPS)
        dense = trained["lap_share"] >= DENSE * trained.loc[enough, "lap_share"].max()
        ranked = trained[enough & dense].sort_values("lap_time_p25_s", kind="stable")
    named = ranked.assign(checkpoint=[recording.checkpoints.get(k, "") for k in ranked["iteration"]])
    return named.head(MOST_CANDIDATES).reset_index(drop=True)[list(CANDIDATE_COLUMNS)]
