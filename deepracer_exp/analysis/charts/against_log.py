"""Simulated laps beside logged ones: both lines over the track, time, speed and steering along it, and the actions."""

from dataclasses import replace

import numpy as np
import pandas as pd

from deepracer_exp.analysis.against_log import PLACES, AgainstLog, quantile
from deepracer_exp.analysis.sectors import interval_times, sectors_of

from .figure import Chart, Layer, Panel, band, bars, in_rows, line
from .laps import time_lost_panel
from .maps import beside, map_panel
from .style import BLUE, ORANGE, VERMILION

SIDES = {"log": ORANGE, "simulated": BLUE}
_PER_CENT = 100.0 * PLACES
_RANGES = (
    " Actions are counted in ranges of steering (split at 0.2 and 0.6 of the largest angle) and speed (three of equal "
    "width): they are continuous, or log and run have different lists of them."
)


def lines_compared(both: AgainstLog) -> Chart:
    """Draw the lines of all laps and their medians on the course, and the stretch where they differ most."""
    layers: list[Layer] = []
    if (one := both.stretch) is not None:
        end = one.end if one.end > one.begin else one.end + 100
        there = both.course.points_at(np.linspace(one.begin, end, 60) / 100.0 % 1.0)
        layers.append(line(there[:, 0], there[:, 1], VERMILION, "where they differ most", width=9.0))
    for laps, color in zip((both.logged, both.simulated), SIDES.values(), strict=True):
        # NaN between the laps.
        apart = laps.steps[["X", "Y"]].to_numpy(np.float64)
        apart = np.insert(apart, np.flatnonzero(np.diff(laps.number)) + 1, np.nan, axis=0)
        layers.append(line(apart[:, 0], apart[:, 1], color, width=0.6))
    for (name, color), curves in zip(SIDES.items(), both.curves["offset_m"], strict=True):
        path = beside(both.course, PLACES, quantile(curves, 0.5))
        path = np.vstack([path, path[:1]]) if both.course.closed else path
        layers.append(line(path[:, 0], path[:, 1], color, f"{name}, median", width=2.5))
    return Chart(
        name="lines_compared",
        title="Both lines",
        caption="Thin lines are the laps, thick ones their medians at each place. The marked stretch is the tenth of "
        "the track where line or speed differ most: the line in halves of the road's width, the speed in means of "
        "the logged one.",
        rows=[[map_panel(both.course, layers)]],
    )


def along_the_track(both: AgainstLog) -> Chart:
    """Draw time, speed, steering and distance from the centre line along the course."""
    bounds = np.append(PLACES, 1.0)
    spent = [interval_times(laps.steps, bounds) for laps in (both.logged, both.simulated)]
    panels = []
    if all(len(times) for times in spent):
        logged, simulated = (times.median().to_numpy() for times in spent)
        lost_s = np.r_[0.0, np.cumsum(simulated - logged)]
        delta = pd.DataFrame({"lap_position": bounds, "delta_s": lost_s})
        title = "Time the simulated laps lose to the logged ones"
        panels.append(time_lost_panel(title, delta, sectors_of(both.course), 100.0))
    for column, title, label in (
        ("track_speed_mps", "Speed along the track", "m/s"),
        ("steer", "Steering commanded, positive to the left", "degrees"),
        ("offset_m", "Distance from the centre line, positive to the left", "m"),
    ):
        layers: list[Layer] = []
        for (name, color), curves in zip(SIDES.items(), both.curves[column], strict=True):
            layers.append(band(_PER_CENT, quantile(curves, 0.1), quantile(curves, 0.9), color))
            layers.append(line(_PER_CENT, quantile(curves, 0.5), color, name, width=2.5))
        panels.append(Panel(title=title, y_label=label, layers=layers))
    panels[-1] = replace(panels[-1], x_label="per cent of the track from waypoint 0")
    return Chart(
        name="along_the_track",
        title="Along the track",
        caption="Lines are medians over the laps, bands reach from the 10th to the 90th percentile. Where the line of "
        "the time rises, the simulated car is slower.",
        rows=in_rows(panels, 1),
        share_x=True,
    )


def actions_compared(both: AgainstLog) -> Chart | None:
    """Draw how often each action is taken."""
    if both.actions is None:
        return None
    # From left to right, as on the road seen from above.
    at, names = np.arange(len(both.actions.names)), both.actions.names[::-1]
    layers = [
        bars(at + side * 0.2, share[::-1], color, name, width=0.38)
        for side, share, (name, color) in zip((-1, 1), both.action_shares, SIDES.items(), strict=True)
    ]
    return Chart(
        name="actions_compared",
        title="Actions taken",
        caption="Share of all control steps. Equal policies in an equal simulation would take equal shares."
        + _RANGES * both.actions.continuous,
        rows=[[Panel(layers=layers, x_names=names, x_label="action", y_label="% of the steps")]],
    )
