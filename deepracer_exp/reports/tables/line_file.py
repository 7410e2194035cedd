"""A line along a track as a file for other programs: a table, an array, or a list to paste into a reward function.

A line is a table of points in their order: `x_m` and `y_m` in the frame of the track's route, `speed_mps` where it is
known, and `progress` in per cent of the lap.
"""

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deepracer_exp.errors import BadInput, count
from deepracer_exp.files import atomic_write

if TYPE_CHECKING:
    import pandas as pd

    from deepracer_exp.tracks.track import Track

    from .log_view import LogView

SUFFIXES = (".csv", ".npy", ".py")
"""Endings of the formats, which `write_line` describes."""
DIGITS = 4
"""Decimals that are written: 0.1 mm, as in logs of the service."""
_OFFERED = 5
"""Most laps that a message lists."""


def recorded_line(view: "LogView", episode: int | None) -> tuple["pd.DataFrame", str]:
    """Return the line of a complete lap, a point per control step, and the lap's description.

    The points are those that the recording logs, at the front of the car. `episode` is a number of `view.episodes`;
    None: the fastest of `LogView.comparable`.

    Raises:
        BadInput: there is no complete lap, or the episode is none.
    """
    laps = view.episodes[view.episodes["lap_time_s"].notna()].sort_values("lap_time_s", kind="stable")
    if laps.empty:
        raise BadInput(view.name, "has no complete lap with its steps", "a run or log with laps")
    fastest = view.comparable["lap_time_s"].idxmin()
    chosen = laps.loc[fastest] if episode is None else _lap(view, laps, episode)
    wanted = (view.episodes["episode"] == chosen["episode"]).to_numpy()
    rows = view.of_episodes(wanted, "X", "Y", "track_speed_mps", "progress")
    rows = rows.rename(columns={"X": "x_m", "Y": "y_m", "track_speed_mps": "speed_mps"})
    line = rows.assign(speed_mps=driven_speed_mps(rows["speed_mps"]))
    where = f"iteration {chosen['iteration']}" if view.trained else str(chosen["stream"])
    which = f"{'the fastest lap, ' * (episode is None)}{where}, episode {chosen['episode']}"
    # A log may lack a position, and `nan` is no number in Python.
    return line[np.isfinite(line).all(axis=1)], f"{which}, {chosen['lap_time_s']:.3f} s"


def _lap(view: "LogView", laps: "pd.DataFrame", episode: int) -> "pd.Series[float]":
    chosen = laps[laps["episode"] == episode]
    if chosen.empty:
        fastest = ", ".join(map(str, laps["episode"].head(_OFFERED)))
        what = "is no complete lap" if (view.episodes["episode"] == episode).any() else "is not there"
        raise BadInput(
            f"--lap {episode}: episode {episode} of {view.name} {what}; accepted: one of its "
            f"{count(len(laps), 'complete lap')}, the fastest first: {fastest}{', ...' * (len(laps) > _OFFERED)}"
        )
    return chosen.iloc[0]


def driven_speed_mps(track_speed_mps: "pd.Series[float]") -> "pd.Series[float]":
    """Return the speed of an episode's control steps, of its first row that of the next one."""
    return track_speed_mps.bfill().ffill()


def racing_line_table(track: "Track") -> "pd.DataFrame":
    """Return the racing line of a track from waypoint 0, without a speed, which depends on the car.

    On a closed track its last point is the first one again, as among the waypoints.
    """
    import pandas as pd

    from .racing_line import minimum_curvature_line

    line = minimum_curvature_line(track)
    return pd.DataFrame({"x_m": line.xy[:, 0], "y_m": line.xy[:, 1], "progress": 100.0 * line.lap_position})


def check_line_file(file: str | None) -> None:
    """Check where `--line` is to write.

    Raises:
        BadInput: its ending is not one of `SUFFIXES`, or its folder does not exist.
    """
    if file is not None and (Path(file).suffix not in SUFFIXES or not Path(file).absolute().parent.is_dir()):
        raise BadInput(
            f"--line {file}", "", f"a name that ends in {', '.join(SUFFIXES)}, in an existing folder"
        )


def write_line(path: Path, line: "pd.DataFrame") -> Path:
    """Write a line atomically, in the format of the file's ending.

    .csv: a table with a head and all columns. .npy: an array of float64, (n, 3) with x, y and speed, or (n, 2) without
    a speed. .py: the same as a list of tuples, `LINE`, which can be imported or pasted into a reward function.

    Raises:
        OSError: it cannot be written.
    """
    line = line.round(DIGITS) + 0.0  # no -0.0
    points = line.drop(columns="progress")
    if path.suffix == ".csv":
        return atomic_write(path, line.to_csv(index=False, lineterminator="\n"))
    if path.suffix == ".npy":
        array = io.BytesIO()
        np.save(array, points.to_numpy(np.float64))
        return atomic_write(path, array.getvalue())
    tuples = "".join(
        f"    ({', '.join(map(repr, point))}),\n" for point in points.to_numpy(np.float64).tolist()
    )
    return atomic_write(path, f"# {', '.join(points)}\nLINE = [\n{tuples}]\n")
