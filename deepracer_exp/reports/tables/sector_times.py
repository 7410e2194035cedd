"""Times of laps in the sectors of a course, the time one lap loses to another, and zig-zag on the straights."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.evaluation.zigzag import DRIVES, ZigZag, zigzag_of
from deepracer_exp.tracks.sectors import Sector, sectors_of
from deepracer_exp.tracks.track import Track

from .log_view import LEAST_LAPS, LogView, once_per_view
from .statistics import Values
from .step_columns import first_rows, laps_driven

_PLACES = 200
"""Places at which two laps are compared."""
_APART = 4.0
"""Offset between the lap positions of two laps that are interpolated together."""


def interval_times(steps: pd.DataFrame, bounds: Values, wanted: Sequence[int] | None = None) -> pd.DataFrame:
    """Return the seconds each complete lap spends between places, interpolated along the lap position.

    `steps` are those of a `LogView`, training or evaluations; `bounds` are lap positions (n + 1,), growing from 0 to 1;
    `wanted` are indices in `LogView.episodes`, None: all.

    The interval in which a lap begins is driven in two parts, at its beginning and at its end, so that the times of a
    lap always add up to its lap time.

    Returns:
        A row for each lap (`tables.laps_driven`), a column for each interval; the index is that of `LogView.episodes`.
    """
    begin = np.flatnonzero(first_rows(steps))
    end = np.append(begin[1:], len(steps))[: len(begin)] - 1
    columns = {name: steps[name].to_numpy(np.float64) for name in ("progress", "lap_position", "lap_clock_s")}
    laps = np.flatnonzero(laps_driven(steps))
    laps = laps if wanted is None else laps[np.isin(laps, wanted)]
    begin, end = begin[laps], end[laps]
    rows = end - begin + 1
    lap = np.repeat(np.arange(len(laps)), rows)
    row = np.arange(rows.sum()) + np.repeat(begin - np.cumsum(rows) + rows, rows)
    lap_time_s = columns["lap_clock_s"][end]
    gone = np.clip(columns["progress"][row] / 100.0, 0.0, 1.0)
    # Every lap begins with a point of its own, so that nothing is interpolated between two laps.
    starts = np.cumsum(rows) - rows
    places = np.insert(np.maximum.accumulate(_APART * lap + gone), starts, _APART * np.arange(len(laps)))
    time_s = np.insert(columns["lap_clock_s"][row], starts, 0.0)
    start = (columns["lap_position"][begin] - columns["progress"][begin] / 100.0) % 1.0
    relative = (bounds[None, :-1] - start[:, None]) % 1.0  # bound 1 is bound 0 again
    query = _APART * np.arange(len(laps))[:, None] + relative
    passed_s = np.interp(query.ravel(), places, time_s).reshape(relative.shape) if len(laps) else relative
    passed_s[relative == 0.0] = 0.0  # the car stands there for a step
    next_s, next_at = np.roll(passed_s, -1, axis=1), np.roll(relative, -1, axis=1)
    spent_s = next_s - passed_s + np.where(next_at <= relative, lap_time_s[:, None], 0.0)
    return pd.DataFrame(spent_s, index=laps)


def times_by_sector(
    steps: pd.DataFrame, sectors: Sequence[Sector], wanted: Sequence[int] | None = None
) -> pd.DataFrame:
    """Return `interval_times` of the sectors, columns by their names; of laps whose times are all known."""
    bounds = np.array([0.0, *(part.end for part in sectors)])
    times = interval_times(steps, bounds, wanted).set_axis([part.name for part in sectors], axis=1)
    return times[np.isfinite(times).all(axis=1)]


@once_per_view
def sectors_now(view: LogView, course: Track) -> tuple[list[Sector], pd.DataFrame, str]:
    """Return the sectors, `times_by_sector` of the present policy's laps, and the description of these."""
    episodes, when = view.now(LEAST_LAPS)
    sectors = sectors_of(course)
    return sectors, times_by_sector(view.steps, sectors, episodes.index), when


def time_lost(steps: pd.DataFrame, lap: int, other: int) -> pd.DataFrame:
    """Return one lap's delay behind another along the course; both are indices in `LogView.episodes`.

    Returns:
        `lap_position` and `delta_s`, the time lost since lap position 0, negative if the lap is ahead; at 1 it is the
        difference of the lap times.

    Raises:
        KeyError: one of them is not a complete lap.
    """
    bounds = np.linspace(0.0, 1.0, _PLACES + 1)
    times = interval_times(steps, bounds, [lap, other])
    lost_s = times.loc[lap].to_numpy() - times.loc[other].to_numpy()
    return pd.DataFrame({"lap_position": bounds, "delta_s": np.r_[0.0, np.cumsum(lost_s)]})


LEAST_M = 10.0
"""Fewest metres of straight for meaningful figures."""
Figures = tuple[float, float, float]
"""`changes_per_m`, `amplitude_deg` (NaN without a change) and `lost_s` of a `ZigZag`."""


def zigzag_in(steps: pd.DataFrame, course: Track | None, wanted: NDArray[np.bool_] | None = None) -> ZigZag:
    """Measure the zig-zag in rows of a recording, `recording.STEP_COLUMNS`; those that are `wanted`, or all."""
    if course is None:
        return ZigZag()
    number = np.cumsum(first_rows(steps), dtype=np.int64)
    rows = np.arange(len(steps)) if wanted is None else np.flatnonzero(wanted)
    x_m, y_m, steering_deg, time_s = (
        steps[name].to_numpy(np.float64)[rows] for name in ("X", "Y", "steer", "tstamp")
    )
    finite = np.isfinite(x_m) & np.isfinite(y_m) & np.isfinite(steering_deg)
    drives = steps["episode_status"].isin(DRIVES).to_numpy()[rows] & finite
    return zigzag_of(
        course, np.nan_to_num(x_m), np.nan_to_num(y_m), steering_deg, time_s, number[rows], drives
    )


@once_per_view
def zigzag_now(view: LogView) -> tuple[Figures | None, str]:
    """Return the zig-zag of the present policy, and the name of the driving it was measured in.

    It is the evaluation of the best checkpoint of a run of ours, or of its last one; of a log of the service all its
    evaluations and races. Where these have no steps it is the training now, in which actions are drawn: the policy that
    races swerves less than that. None without enough straights.
    """
    tried = None if view.run is None else view.run.evaluations.dropna(subset="zigzag_per_m")
    if view.run is not None and tried is not None and len(tried):
        of_best = tried[tried["iteration"] == view.run.best.iteration]
        row = (of_best if len(of_best) else tried).iloc[-1]
        figures = row["zigzag_per_m"], row["zigzag_deg"], row["zigzag_lost_s"]
        return figures, f"evaluation after iteration {row['iteration']:.0f}"
    zigzag, where = zigzag_in(view.evaluation_steps, view.course), "evaluations"
    if zigzag.straight_m < LEAST_M and view.trained:
        episodes, when = view.now()
        wanted = np.zeros(len(view.steps), bool)
        wanted[view.rows_of(view.episodes.index.isin(episodes.index))] = True
        zigzag, where = zigzag_in(view.steps, view.course, wanted), f"while exploring, {when}"
    if zigzag.straight_m < LEAST_M or zigzag.changes_per_m is None or zigzag.lost_s is None:
        return None, where
    amplitude_deg = math.nan if zigzag.amplitude_deg is None else zigzag.amplitude_deg
    return (zigzag.changes_per_m, amplitude_deg, zigzag.lost_s), where
