"""Episodes of a recording, one row each."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

EPISODE_COLUMNS: Mapping[str, str] = {
    "iteration": "policy update that learned from its last row",
    "episode": "number within the stream",
    "worker": "process of the service that drove",
    "steps": "control steps from the first to the last, both counted",
    "start_at": "waypoint of its first row",
    "progress": "per cent of the lap, the highest",
    "time_s": "simulated seconds from the first row to the last; of a flying lap from the last row of the one before",
    "dist_m": "m driven, between rows in a straight line",
    "reward": "sum",
    "speed_mps": "m/s commanded, mean of all rows",
    "time_if_complete_s": "s, time_s * 100 / progress; NaN without progress",
    "reward_if_complete": "reward * 100 / progress; NaN without progress",
    "ended": "whether its last row is the end of the episode, not only of the recording",
    "complete": "whether progress reached 100 per cent",
    "lap_time_s": "time_s of a complete lap whose beginning is recorded; NaN of other episodes",
    "status": "episode_status of its last row; lap_complete of a lap in a race; where the generation has none, "
    "lap_complete, off_track or empty",
    "first_waypoint": "waypoint of its first row",
    "last_waypoint": "waypoint of its last row",
    "quarter": "1 to 4, of the training's episodes in their order",
    "quintile": "1 to 5, likewise",
}
"""Names of the columns, with meaning and unit; the first ones equal deepracer-utils' `simulation_agg`."""
FIRST_STEPS = 2
"""Step of an episode's first row, at most: generations without prepare rows may begin with 2."""


def first_rows(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Tell which rows are their episode's first one, where the rows of each episode stand together."""
    stream = steps["stream"].astype("category").cat.codes.to_numpy()
    episode = steps["episode"].to_numpy()
    first = np.ones(len(steps), bool)
    first[1:] = (episode[1:] != episode[:-1]) | (stream[1:] != stream[:-1])
    return first


def flying_rows(steps: pd.DataFrame, first: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which first rows go on from the row before: laps of a race are driven without a stop in between."""
    number = steps["steps"].to_numpy()
    stream = steps["stream"].astype("category").cat.codes.to_numpy()
    flying = first & (number > FIRST_STEPS)
    flying[:1] = False
    flying[1:] &= (number[1:] == number[:-1] + 1) & (stream[1:] == stream[:-1])
    return flying


def whole_from_start(steps: pd.DataFrame, first: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell of each episode whether its beginning is recorded."""
    begin = np.flatnonzero(first)
    return (steps["steps"].to_numpy()[begin] <= FIRST_STEPS) | flying_rows(steps, first)[begin]


def episode_table(steps: pd.DataFrame, first: NDArray[np.bool_]) -> pd.DataFrame:
    """Sum up each episode in one row, `EPISODE_COLUMNS`, in the order of the steps.

    Steps, start, progress, time, distance, speed, reward and completeness are defined as in deepracer-utils 1.5.6
    (logs/log_utils.py, `simulation_agg`).

    Args:
        steps: rows of each episode together and in the order of time, with the derived columns.
        first: whether a row is its episode's first one.
    """
    begin = np.flatnonzero(first)
    end = np.append(begin[1:], len(steps))[: len(begin)] - 1
    rows = end - begin + 1

    def values(name: str) -> NDArray[np.float64]:
        return steps[name].to_numpy(np.float64)

    def total(name: str) -> NDArray[np.float64]:
        return np.add.reduceat(values(name), begin)

    number, waypoint = steps["steps"].to_numpy(), steps["closest_waypoint"].to_numpy()
    progress, time_s, reward = (
        np.maximum.reduceat(values("progress"), begin),
        total("delta_time_s"),
        total("reward"),
    )
    complete = progress >= 100.0
    per_lap = np.divide(100.0, progress, out=np.full(len(begin), np.nan), where=progress > 0)
    order = np.arange(len(begin))
    return pd.DataFrame(
        {
            "iteration": steps["iteration"].to_numpy()[end],
            "episode": steps["episode"].to_numpy()[begin],
            "worker": steps["worker"].to_numpy()[begin],
            "steps": np.maximum.reduceat(number, begin) - np.minimum.reduceat(number, begin) + 1,
            "start_at": waypoint[begin],
            "progress": progress,
            "time_s": time_s,
            "dist_m": total("delta_dist_m"),
            "reward": reward,
            "speed_mps": total("throttle") / rows,
            "time_if_complete_s": time_s * per_lap,
            "reward_if_complete": reward * per_lap,
            "ended": complete | steps["done"].to_numpy(bool)[end],
            "complete": complete,
            "lap_time_s": np.where(complete & whole_from_start(steps, first) & (time_s > 0), time_s, np.nan),
            "status": _status(steps, end, complete),
            "first_waypoint": waypoint[begin],
            "last_waypoint": waypoint[end],
            "quarter": 1 + 4 * order // len(order),
            "quintile": 1 + 5 * order // len(order),
        }
    )


def _status(steps: pd.DataFrame, end: NDArray[np.intp], complete: NDArray[np.bool_]) -> NDArray[np.object_]:
    last = steps.iloc[end]
    status = last["episode_status"].astype(str).to_numpy(dtype=object)
    unknown = status == ""
    off = unknown & last["done"].to_numpy(bool) & ~last["all_wheels_on_track"].to_numpy(bool)
    status[complete & (unknown | (status == "in_progress"))] = "lap_complete"  # races go on with the next lap
    status[off & ~complete] = "off_track"
    return status
