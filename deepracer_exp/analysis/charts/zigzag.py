"""The figure of a car's zig-zag: its steering along a lap, beside where the road is straight."""

import numpy as np

from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.analysis.sectors import sectors_of
from deepracer_exp.analysis.zigzag import CENTRED_DEG, zigzag_in_words
from deepracer_exp.analysis.zigzag_log import zigzag_now

from .figure import Chart, Layer, Panel, band, line
from .style import BLUE, INK, PALE

_COLUMNS = ("lap_position", "steer", "progress")


def zigzag(view: LogView) -> Chart | None:
    """Draw the steering of the fastest lap, control step by control step, with the straights of the course."""
    lap = view.fastest_lap(*_COLUMNS)
    figures, where = zigzag_now(view)
    if view.course is None or lap is None or figures is None:
        return None
    length_m = view.course.length_m
    steer = lap["steer"].to_numpy(np.float64)
    at_m = length_m * lap["lap_position"].to_numpy(np.float64)
    # The lap ends where it began: the line must not lead back across the figure.
    wraps = np.flatnonzero(np.abs(np.diff(at_m)) > length_m / 2) + 1
    at_m, steer = (np.insert(values, wraps, np.nan) for values in (at_m, steer))
    largest = max(float(np.nanmax(np.abs(steer))), CENTRED_DEG)
    layers: list[Layer] = []
    named = False
    for sector in sectors_of(view.course):
        if sector.name.startswith("straight"):
            ends = [sector.begin * length_m, sector.end * length_m]
            layers.append(band(ends, [-largest] * 2, [largest] * 2, PALE, None if named else "straight"))
            named = True
    layers += [
        line([0.0, length_m], [0.0, 0.0], INK, width=1.0),
        line(at_m, steer, BLUE, "steering of the fastest lap", width=1.5),
    ]
    return Chart(
        name="zigzag",
        title="Steering along the fastest lap, and the straights",
        caption=f"Commanded steering at each control step, without smoothing; the straights of the centre line are "
        f"shaded. On these: {zigzag_in_words(*figures)} ({where}). A line that jumps from one side of zero to the "
        "other within a shaded part is zig-zag, but for the first time: that is the way from one bend into the next."
        + " The lap of a training is one of drawn actions; the policy that races swerves less."
        * view.trained,
        rows=[
            [
                Panel(
                    layers=layers,
                    x_label="m along the centre line, from waypoint 0",
                    y_label="steering, ° (left is positive)",
                    x_range=(0.0, length_m),
                )
            ]
        ],
    )
