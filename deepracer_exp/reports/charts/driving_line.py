"""The driving line: sectors, speed, steering, slide and zig-zag, and its loss to the fastest lap."""

import numpy as np
import pandas as pd

from deepracer_exp.errors import count
from deepracer_exp.evaluation.zigzag import CENTRED_DEG, zigzag_in_words
from deepracer_exp.reports.tables.against_fastest import CAUSES, loss, lost_in_words
from deepracer_exp.reports.tables.log_view import STARTING_STEPS, LogView, closest_waypoints
from deepracer_exp.reports.tables.racing_line import center_line, minimum_curvature_line
from deepracer_exp.reports.tables.sector_times import sectors_now, zigzag_now
from deepracer_exp.reports.tables.statistics import MOST_ROWS, Values, means, quantiles, subsample
from deepracer_exp.reports.tables.step_columns import SPEED_STEPS, first_rows
from deepracer_exp.tracks.sectors import sectors_of, waypoint_positions
from deepracer_exp.tracks.track import Track

from .figure import Chart, Layer, Panel, band, bars, color_range, colored_points, line, note, points
from .maps import LEAST_STEPS, Grid, beside, map_panel, outlines, waypoint_panel
from .style import BLUE, CATEGORIES, INK, ORANGE, PALE, VERMILION

GRIP_SHARE = 0.95
"""Quantile of the lateral acceleration in complete laps that counts as the grip of the car."""
LEAST_GRIP_MPS2 = 0.5
SLIDE_BRIGHT_DEG = 5.0
"""The brightest colour stands for at least this slide."""
SLIDE_LEAST_MPS = 0.3
"""Below this speed the direction of travel is mostly noise."""


def lap_line(view: LogView) -> Chart | None:
    """Draw the fastest lap on the course, coloured by speed."""
    columns = ("X", "Y", "steps", "closest_waypoint", "progress", "steer", "throttle", "track_speed_mps")
    lap = view.fastest_lap(*columns)
    if lap is None or view.course is None:
        return None
    row = view.episodes.loc[view.comparable["lap_time_s"].idxmin()]
    moving = lap[lap["track_speed_mps"].notna()]
    hover = [
        f"step {step.steps:.0f}, waypoint {step.closest_waypoint}, {step.progress:.1f}%\n"
        f"driven {step.track_speed_mps:.2f} m/s, commanded {step.throttle:.2f} m/s, steering {step.steer:.1f}°"
        for step in moving.itertuples()
    ]
    dots = colored_points(
        moving["X"],
        moving["Y"],
        moving["track_speed_mps"],
        "speed along the track, m/s",
        size=7.5,
        hover=hover,
    )
    mean_mps = view.course.length_m / float(row["lap_time_s"])
    boxes = view.boxes_of(int(row["episode"]))
    around = [outlines(boxes, VERMILION, width=2.0)] if len(boxes) else []
    whose = f"iteration {row['iteration']}" if view.trained else str(row["stream"])
    kind = "exploring lap" if view.trained else "lap"
    return Chart(
        name="lap_line",
        title=f"The fastest {kind}: {row['lap_time_s']:.3f} s, {whose}, episode {row['episode']}",
        caption="One dot for each control step of the fastest complete lap, coloured by the speed of the car "
        f"over {SPEED_STEPS} control steps, whose time stamps jitter; "
        f"at a constant {mean_mps:.2f} m/s the centre line would take as long. Dots close together are slow: find "
        "where the car slows down and ask whether the bend requires it."
        + " The outlines are the boxes of this episode."
        * bool(around),
        rows=[[map_panel(view.course, [line(lap["X"], lap["Y"], PALE, width=1.25), *around, dots])]],
    )


def raced_lap(view: LogView) -> Chart | None:
    """Draw the fastest lap of the evaluations and races beside a training; None without one."""
    laps_s = view.evaluation_episodes["lap_time_s"]
    if not view.trained or view.course is None or not laps_s.notna().any():
        return None
    number = int(np.nanargmin(laps_s.to_numpy(np.float64)))
    steps = view.evaluation_steps
    lap = steps[(np.cumsum(first_rows(steps)) - 1 == number) & steps["track_speed_mps"].notna()]
    return evaluated_lap(
        words=f"The fastest evaluated lap: {laps_s.iloc[number]:.2f} s",
        whose=str(view.evaluation_episodes["stream"].iloc[number]),
        course=view.course,
        x_m=lap["X"].to_numpy(np.float64),
        y_m=lap["Y"].to_numpy(np.float64),
        speed_mps=lap["track_speed_mps"].to_numpy(np.float64),
        boxes=np.zeros((0, 4, 2)),
    )


def evaluated_lap(
    words: str, whose: str, course: Track, x_m: Values, y_m: Values, speed_mps: Values, boxes: Values
) -> Chart:
    """Draw a lap of a policy that takes its most probable actions, coloured by speed; arrays (n,).

    `words` are the title; `whose` names the checkpoint, or the evaluation or race of a log. `boxes` are the corners of
    those on the road, (k, 4, 2).
    """
    hover = [f"driven {speed:.2f} m/s" for speed in speed_mps]
    # The few steps after a standing start would take half of the colours.
    low, high = float(np.percentile(speed_mps, 10)), float(speed_mps.max())
    value_range = low, max(high, low + 0.1)
    dots = colored_points(x_m, y_m, speed_mps, "speed, m/s", size=7.5, hover=hover, value_range=value_range)
    around = [outlines(boxes, VERMILION, width=2.0)] if len(boxes) else []
    layers = [line(x_m, y_m, PALE, width=1.25), *around, dots]
    return Chart(
        name="evaluated_lap",
        title=words,
        caption=f"A lap of {whose}. One dot for each control step, coloured by the speed of the car. In an "
        "evaluation the policy takes its most probable actions; while it trains it explores, and drives otherwise.",
        rows=[[map_panel(course, layers, numbers=False)]],
    )


def sector_times(view: LogView) -> Chart | None:
    """Draw the time lost in each sector: by the fastest lap and by the median lap, to the best time of the sector."""
    if view.course is None or not len(view.steps):
        return None
    sectors, times, when = sectors_now(view, view.course)
    if not len(times):
        return None
    best_s, fastest_s = times.min(), times.loc[times.sum(axis=1).idxmin()]
    x = np.arange(len(sectors))
    panel = Panel(
        layers=[
            bars(x, times.median() - best_s, PALE, f"median of {count(len(times), 'complete lap')}"),
            points(x, fastest_s - best_s, VERMILION, "fastest of them", size=12.0, symbol="diamond"),
        ],
        x_names=list(times),
        x_label="sector, in driving direction",
        y_label="s behind the best of the sector",
    )
    lines: list[Layer] = []
    notes: list[Layer] = []
    for number, sector in enumerate(sectors):
        places = view.course.points_at(np.linspace(sector.begin, sector.end, 60))
        lines.append(line(places[:, 0], places[:, 1], CATEGORIES[number % 6], width=5.0))
        notes.append(note(places[30].tolist(), f"{sector.name}\n{best_s[sector.name]:.2f} s"))
    return Chart(
        name="sector_times",
        title=f"Sectors: the best times add up to {best_s.sum():.3f} s, the fastest of these laps took "
        f"{fastest_s.sum():.3f} s",
        caption="Sectors begin and end where the curvature of the centre line changes; the map shows the best time "
        f"of each, of {count(len(times), 'complete lap')} {when}. The height of a bar is what the median lap loses "
        "there, the diamond what even the fastest of them lost.",
        rows=[[map_panel(view.course, [*lines, *notes], numbers=False)], [panel]],
    )


def speed_steering_by_waypoint(view: LogView) -> Chart | None:
    """Draw speed and steering at each waypoint, beside those of the racing line and of the centre line."""
    columns = ("closest_waypoint", "track_speed_mps", "yaw_rate_dps", "steer", "throttle", "steps")
    rows, which = _laps_or_recent(view, *columns)
    started = rows["steps"].to_numpy() > STARTING_STEPS
    if not started.any():
        return None
    rows = pd.DataFrame({name: rows[name].to_numpy()[started] for name in columns}, copy=False)
    n = view.waypoint_count
    x, waypoint, part = np.arange(n), closest_waypoints(rows), subsample(len(rows), MOST_ROWS)
    lap = view.fastest_lap(*columns)
    panels: dict[str, list[Layer]] = {"track_speed_mps": [], "steer": []}
    for column, layers in panels.items():
        values = rows[column].to_numpy(np.float64)
        low, high = quantiles(waypoint[part], values[part], n, (0.1, 0.9))
        layers.append(band(x, low, high, BLUE, f"{which}, 10th to 90th percentile"))
        layers.append(line(x, means(waypoint, values, n), BLUE, "mean", width=2.5))
        if column == "track_speed_mps":
            layers.append(line(x, means(waypoint, rows["throttle"], n), PALE, "mean speed commanded"))
        if lap is not None:
            driven = lap[lap["steps"] > STARTING_STEPS]
            best = _without_gaps(means(closest_waypoints(driven), driven[column], n))
            layers.append(line(x, best, INK, "fastest lap", width=1.5))
    if view.course is not None:
        places = waypoint_positions(view.course)
        grip_mps2, top_mps = _grip(rows.iloc[part]), float(rows["throttle"].max())
        for ideal, name, color in (
            (minimum_curvature_line(view.course), "racing line", VERMILION),
            (center_line(view.course), "centre line", ORANGE),
        ):
            speed_mps = ideal.interpolate(places, ideal.speed_mps(grip_mps2, top_mps))
            x, words = np.arange(len(places)), f"{name}, cornering at {grip_mps2:.1f} m/s²"
            panels["track_speed_mps"].append(line(x, speed_mps, color, words, dashed=True))
            panels["steer"].append(
                line(x, ideal.interpolate(places, ideal.steering_deg), color, name, dashed=True)
            )
    return Chart(
        name="speed_steering_by_waypoint",
        title="Speed and steering by waypoint",
        caption="Driven speed and commanded steering; the dashed lines are those of a car on the racing line and on "
        "the centre line with the lateral acceleration that this car reached (standing starts left out), without "
        "room for braking. Where the driven speed stays far below the dashed lines, time can be gained; steering "
        "that swings where they are flat is weaving.",
        rows=[
            [waypoint_panel(panels["track_speed_mps"], "speed along the track, m/s", n)],
            [waypoint_panel(panels["steer"], "steering, ° (left is positive)", n)],
        ],
        share_x=True,
    )


def racing_line(view: LogView) -> Chart | None:
    """Draw the car's distance from the racing line."""
    course = view.course
    if course is None:
        return None
    columns = ("closest_waypoint", "lap_position", "offset_m", "X", "Y")
    rows, which = _laps_or_recent(view, *columns)
    placed = np.flatnonzero(np.isfinite(rows["offset_m"].to_numpy()))
    if not len(placed):
        return None
    ideal, n = minimum_curvature_line(course), view.waypoint_count
    x = np.arange(n)
    rows = rows.iloc[placed[subsample(len(placed), MOST_ROWS)]]
    waypoint = closest_waypoints(rows)
    away_m = rows["offset_m"] - ideal.interpolate(rows["lap_position"], ideal.offset_m)
    low, middle, high = quantiles(waypoint, away_m, n, (0.1, 0.5, 0.9))
    places = waypoint_positions(course)[:n]
    median = beside(course, places, quantiles(waypoint, rows["offset_m"], n, (0.5,))[0][: len(places)])
    layers: list[Layer] = [
        line(x, np.zeros(n), VERMILION, "racing line", dashed=True),
        band(x, low, high, BLUE, f"{which}, 10th to 90th percentile"),
        line(x, middle, BLUE, "median", width=2.5),
    ]
    paths: list[Layer] = [
        line(ideal.xy[:, 0], ideal.xy[:, 1], VERMILION, "racing line", dashed=True),
        line(median[:, 0], median[:, 1], BLUE, f"{which}, median", width=2.5),
    ]
    lap = view.fastest_lap(*columns)
    if lap is not None:
        own_m = lap["offset_m"] - ideal.interpolate(lap["lap_position"], ideal.offset_m)
        line_driven = _without_gaps(means(closest_waypoints(lap), own_m, n))
        paths.append(line(lap["X"], lap["Y"], INK, "fastest lap", width=1.5))
        layers.append(line(x, line_driven, INK, "fastest lap", width=1.5))
    return Chart(
        name="racing_line",
        title=f"The racing line: the car drives {100 * away_m.abs().mean():.0f} cm from it on average",
        caption="The racing line is the one of minimum curvature that keeps all wheels on the road; the lower panel "
        "shows how far to the left (positive) or to the right of it the car is. A line that cuts in before the bend "
        "and runs wide behind it crosses zero twice: the car turns in too early.",
        rows=[[map_panel(course, paths)], [waypoint_panel(layers, "m left of the racing line", n)]],
    )


def acceleration_map(view: LogView) -> Chart | None:
    """Draw where the car accelerates and where it brakes."""
    rows = view.recent("X", "Y", "acceleration_mps2", "braking_mps2", "steps")
    rows = rows[rows["steps"] > STARTING_STEPS]
    if view.course is None or not len(rows):
        return None
    change = rows["acceleration_mps2"] - rows["braking_mps2"]
    scale = "change of speed, m/s²"
    cells = Grid.over(view.course, 8_000).means(rows, change, scale, LEAST_STEPS, diverging=True)
    return Chart(
        name="acceleration_map",
        title="Where the car accelerates and where it brakes",
        caption="Mean change of the speed along the track in each cell, in the last third of the iterations, without "
        "standing starts: positive where the car gets faster. A car should brake before a bend and accelerate in its "
        "second half; braking on a straight is time lost.",
        rows=[[map_panel(view.course, [cells])]],
    )


def slide_map(view: LogView) -> Chart | None:
    """Draw where the car slides: the angle between its heading and its direction of travel."""
    rows = view.recent("X", "Y", "slide_deg", "track_speed_mps")
    if view.course is None or not len(rows):
        return None
    slide = rows["slide_deg"].abs().where(rows["track_speed_mps"] >= SLIDE_LEAST_MPS)
    grid = Grid.over(view.course, 8_000)
    mean = means(grid.of(rows["X"], rows["Y"]), slide, grid.count, LEAST_STEPS)
    if not np.isfinite(mean).any():
        return None
    # Tyres that hardly slip must not look as if they did.
    colors = 0.0, max(color_range(mean)[1], SLIDE_BRIGHT_DEG)
    cells = grid.cells(mean, "slide, degrees", value_range=colors)
    return Chart(
        name="slide_map",
        title="Where the car slides",
        caption="Mean angle between the direction in which the rear axle moved and the heading of the car, in the "
        "last third of the iterations; 0 is rolling without slip. Bright cells are bends taken at the limit of grip, "
        "where only another line can be faster; where all is dark, the tyres hold more than is asked of them.",
        rows=[[map_panel(view.course, [cells])]],
    )


def waypoint_map(view: LogView) -> Chart | None:
    """Draw the course with its waypoints numbered."""
    if view.course is None:
        return None
    course = view.course
    x, y = course.waypoints.T
    hover = [f"waypoint {k}: x {a:.2f}, y {b:.2f} m" for k, (a, b) in enumerate(zip(x, y, strict=True))]
    tenth = np.arange(0, len(x) - course.closed, 10)
    ahead = course.start_pose(np.array([0.5 * course.width_m / course.length_m]))
    layers: list[Layer] = [
        points(x, y, BLUE, size=4.0, hover=hover),
        points(x[tenth], y[tenth], VERMILION, size=8.0),
        note((float(ahead.x[0]), float(ahead.y[0])), "start"),
    ]
    return Chart(
        name="waypoint_map",
        title=f"{course.title}: {len(x)} waypoints, {course.length_m:.2f} m",
        caption="The numbers are those of `closest_waypoints` in a reward function and of the waypoint axes of all "
        "other figures; every tenth waypoint is marked. The car drives from low to high numbers and starts at "
        "waypoint 0.",
        rows=[[map_panel(course, layers)]],
    )


def _laps_or_recent(view: LogView, *columns: str) -> tuple[pd.DataFrame, str]:
    """Return the rows of complete laps on usual conditions, or else those of the last third, and which they are."""
    complete = view.episodes["complete"].to_numpy(bool) & view.on_usual
    if complete.any():
        return view.of_episodes(complete, *columns), count(int(complete.sum()), "complete lap")
    return view.recent(*columns), "last third of the iterations"


def _grip(rows: pd.DataFrame) -> float:
    """Return the lateral acceleration that the car reaches, m/s2: speed times yaw rate."""
    lateral = (rows["track_speed_mps"] * np.radians(rows["yaw_rate_dps"])).abs().dropna()
    return max(float(lateral.quantile(GRIP_SHARE)), LEAST_GRIP_MPS2) if len(lateral) else LEAST_GRIP_MPS2


def _without_gaps(values: Values) -> Values:
    """Return values with the gaps filled in, which are waypoints that one lap jumped over."""
    return pd.Series(values).interpolate(limit_direction="both").to_numpy()


def zigzag(view: LogView) -> Chart | None:
    """Draw the steering of the fastest lap, control step by control step, with the straights of the course."""
    lap = view.fastest_lap("lap_position", "steer", "progress")
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


def against_fastest(view: LogView) -> Chart | None:
    """Draw the seconds that a run's lap loses to the fastest lap of its car, by sector and cause."""
    folder = view.run_folder
    lost = None if folder is None else loss(view, folder)
    if lost is None:
        return None
    table, alike = lost.by_sector, "" if view.on_usual.all() else " on usual conditions"
    places, colors = np.arange(len(table)), dict(zip(CAUSES, (BLUE, ORANGE, VERMILION), strict=True))
    layers = [
        bars(places + 0.26 * (number - 1), table[cause].to_numpy(), colors[cause], cause, width=0.26)
        for number, cause in enumerate(CAUSES)
    ]
    return Chart(
        name="against_fastest",
        title="Seconds lost to the fastest lap of this car",
        caption=f"The fastest {view.lap_word} from the start line{alike}: {lost_in_words(lost)}. Line is a longer way, "
        "steering the way that turning to and fro adds to it, speed the rest; below zero the lap gains. The fastest "
        "lap itself: `deepracer-exp tracks NAME --fastest`.",
        rows=[[Panel(layers=layers, y_label="seconds lost", x_names=list(table.index))]],
    )
