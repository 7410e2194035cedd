"""The zig-zag of the policy in a log."""

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.evaluation.zigzag import DRIVES, ZigZag, zigzag_of
from deepracer_exp.tracks.track import Track

from .log_view import LogView, once_per_view
from .step_columns import first_rows

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
