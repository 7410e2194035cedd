"""The zig-zag of a log: which driving shows it, and when it is one."""

import math

from .log_view import LogView
from .zigzag import zigzag_in

ZIGZAG_PER_M = 1.0
"""Changes of steering a metre of straight from which on a car zig-zags: fast policies of the service's races change 0.2
to 0.4 times, those of its first trainings 1 to 7 times."""
ZIGZAG_DEG = 5.0
"""Angle to either side below which nobody would see it."""
LEAST_M = 10.0
"""Metres of straight without which the figures say little."""
CURE = (
    "an action space with smaller angles; algorithm.smoothness=0.02 helps some trainings (docs/smoothness.md)"
)

Figures = tuple[float, float, float]
"""`changes_per_m`, `amplitude_deg` (NaN without a change) and `lost_s` of a `ZigZag`."""


def zigzag_now(view: LogView) -> tuple[Figures | None, str]:
    """Return how the car steers on straights as it races now, and in which driving that is seen.

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
        wanted = view.steps["episode"].isin(episodes["episode"]).to_numpy()
        zigzag, where = zigzag_in(view.steps, view.course, wanted), f"while exploring, {when}"
    if zigzag.straight_m < LEAST_M or zigzag.changes_per_m is None or zigzag.lost_s is None:
        return None, where
    amplitude_deg = math.nan if zigzag.amplitude_deg is None else zigzag.amplitude_deg
    return (zigzag.changes_per_m, amplitude_deg, zigzag.lost_s), where
