"""How the car moved along the course: the fastest lap, acceleration and slide."""

import numpy as np

from .cells import Grid, means
from .chart import BLUE, PALE, Chart, Line, Points
from .log_view import LogView
from .maps import LEAST_STEPS, STARTING_STEPS, fastest_lap, map_panel, recent

_LAP = (
    *("steps", "X", "Y", "closest_waypoint", "progress", "lap_position", "tstamp", "steer", "throttle"),
    *("track_speed_mps", "acceleration_mps2", "braking_mps2", "slide_deg", "reward"),
)
SLIDE_LEAST_MPS = 0.3
"""Below this speed the direction of travel is mostly noise."""


def lap_line(view: LogView) -> Chart | None:
    """Show the fastest lap as it was driven, coloured by speed."""
    lap = fastest_lap(view, *_LAP)
    if lap is None or view.course is None:
        return None
    x, y = (lap[name].to_numpy(np.float64) for name in ("X", "Y"))
    speed_mps = lap["track_speed_mps"].to_numpy(np.float64)
    row = view.episodes.loc[view.episodes["lap_time_s"].idxmin()].to_dict()
    hover = [
        f"step {step.steps:.0f}, waypoint {step.closest_waypoint}, {step.progress:.1f} %\n"
        f"driven {step.track_speed_mps:.2f} m/s, asked {step.throttle:.2f} m/s, steering {step.steer:.1f}°"
        for step in lap.itertuples()
    ]
    known = np.isfinite(speed_mps)
    dots = Points(
        x=x[known],
        y=y[known],
        values=speed_mps[known],
        scale="speed along the track, m/s",
        color=BLUE,
        size=5.5,
        hover=[text for text, shown in zip(hover, known, strict=True) if shown],
    )
    path = Line(x=x, y=y, color=PALE, width=1.0)
    mean = view.course.length_m / float(row["lap_time_s"])
    return Chart(
        name="lap_line",
        title=f"The fastest lap: {row['lap_time_s']:.3f} s, "
        + (f"iteration {row['iteration']}" if view.trained else str(row["stream"]))
        + f", episode {row['episode']}",
        caption="One dot a control step of the fastest complete lap, coloured by how fast "
        f"the car moved; {mean:.2f} m/s would lap the centre line in the same time. Dots close "
        "together are slow: look where the car slows down and ask whether the bend needs it.",
        rows=[[map_panel(view.course, [path, dots])]],
        table=lap.reset_index(drop=True),
    )


def acceleration_map(view: LogView) -> Chart | None:
    """Show where the car gains speed and where it brakes."""
    rows = recent(view, "X", "Y", "acceleration_mps2", "braking_mps2", "steps")
    rows = rows[rows["steps"].to_numpy() > STARTING_STEPS]
    if view.course is None or not len(rows):
        return None
    change = (rows["acceleration_mps2"] - rows["braking_mps2"]).to_numpy(np.float64)
    grid = Grid.over(view.course, 8_000)
    mean = means(grid.of(rows["X"], rows["Y"]), change, grid.count, LEAST_STEPS)
    return Chart(
        name="acceleration_map",
        title="Where the car gains speed and where it brakes",
        caption="Mean change of the speed along the track in each cell, in the last third of the "
        "iterations, without standing starts: positive where the car gets faster. Braking belongs "
        "before a bend and gaining speed to its second half; braking on a straight is time lost.",
        rows=[[map_panel(view.course, [grid.cells(mean, "change of speed, m/s²", diverging=True)])]],
        table=grid.table({"change_mps2": mean}),
    )


def slide_map(view: LogView) -> Chart | None:
    """Show where the tyres let go: the angle between where the car points and where it goes."""
    rows = recent(view, "X", "Y", "slide_deg", "track_speed_mps")
    if view.course is None or not len(rows):
        return None
    slide = np.abs(rows["slide_deg"].to_numpy(np.float64))
    slide = np.where(rows["track_speed_mps"].to_numpy(np.float64) >= SLIDE_LEAST_MPS, slide, np.nan)
    grid = Grid.over(view.course, 8_000)
    mean = means(grid.of(rows["X"], rows["Y"]), slide, grid.count, LEAST_STEPS)
    if not np.isfinite(mean).any():
        return None
    return Chart(
        name="slide_map",
        title="Where the car slides",
        caption="Mean angle between the direction in which the rear axle moved and the one in which the "
        "car pointed, in the last third of the iterations; 0 is rolling without slip. Bright "
        "cells are bends taken at the limit of grip: faster is not to be had there without "
        "another line.",
        rows=[[map_panel(view.course, [grid.cells(mean, "slide, degrees")])]],
        table=grid.table({"slide_deg": mean}),
    )
