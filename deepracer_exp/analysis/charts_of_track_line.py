"""The way round the course: speed and steering, the racing line, sectors."""

import numpy as np
import pandas as pd

from .cells import means, quantiles
from .chart import (
    BLUE,
    CATEGORIES,
    INK,
    ORANGE,
    PALE,
    VERMILION,
    Band,
    Bars,
    Chart,
    Layer,
    Line,
    Note,
    Panel,
    Points,
    Values,
    thinned,
)
from .log_view import LogView
from .maps import (
    STARTING_STEPS,
    fastest_lap,
    map_panel,
    of_episodes,
    recent,
    waypoint_count,
    waypoint_positions,
    waypoints_of,
)
from .racing_line import center_line
from .racing_line import racing_line as line_of
from .sectors import sector_times as times_of_sectors
from .sectors import sectors_of, theoretical_best_s

GRIP_SHARE = 0.95
"""Quantile of the lateral acceleration in complete laps that counts as what the car can hold."""
LEAST_GRIP_MPS2 = 0.5
_ROWS = 200_000
"""Rows beyond which quantiles are those of a part of them, at even distances."""


def speed_steering_by_waypoint(view: LogView) -> Chart | None:
    """Show speed and steering at each waypoint, beside what the racing line and the centre line ask for."""
    columns = ("closest_waypoint", "track_speed_mps", "yaw_rate_dps", "steer", "throttle", "steps")
    rows, which = _laps_or_recent(view, *columns)
    rows = rows[rows["steps"].to_numpy() > STARTING_STEPS]
    if not len(rows):
        return None
    n = waypoint_count(view)
    at = np.arange(n, dtype=np.float64)
    waypoint = waypoints_of(rows)
    part = thinned(len(rows), _ROWS)
    lap = fastest_lap(view, *columns)
    if lap is not None:
        lap = lap[lap["steps"] > STARTING_STEPS]
    table = pd.DataFrame({"waypoint": np.arange(n)})
    panels = []
    for column, label in (
        ("track_speed_mps", "speed along the track, m/s"),
        ("steer", "steering, ° (left is positive)"),
    ):
        values = rows[column].to_numpy(np.float64)
        low, high = quantiles(waypoint[part], values[part], n, (0.1, 0.9))
        mean = means(waypoint, values, n)
        table = table.assign(**{f"{column}_mean": mean, f"{column}_p10": low, f"{column}_p90": high})
        layers: list[Layer] = [
            Band(x=at, low=low, high=high, name=f"{which}, 10th to 90th percentile", color=BLUE),
            Line(x=at, y=mean, name="mean", color=BLUE, width=2.0),
        ]
        if column == "track_speed_mps":
            asked = means(waypoint, rows["throttle"].to_numpy(np.float64), n)
            layers.append(Line(x=at, y=asked, name="mean speed asked for", color=PALE, width=1.4))
        if lap is not None:
            # Control steps of uneven length make the speed of a single one jump.
            smooth = lap[column].rolling(3, center=True, min_periods=1).mean().to_numpy(np.float64)
            best = means(waypoints_of(lap), smooth, n)
            layers.append(
                Line(x=at, y=_bridged(best), name="fastest lap, mean of three steps", color=INK, width=1.2)
            )
        panels.append((layers, label))
    if view.course is not None:
        places = waypoint_positions(view.course)
        grip_mps2, top_mps = _grip(rows.iloc[part]), float(np.nanmax(rows["throttle"].to_numpy(np.float64)))
        for line, name, color in (
            (line_of(view.course), "racing line", VERMILION),
            (center_line(view.course), "centre line", ORANGE),
        ):
            speed = line.at(places, line.speed_mps(grip_mps2, top_mps))
            steering = line.at(places, line.steering_deg)
            x = np.arange(len(places), dtype=np.float64)
            panels[0][0].append(
                Line(
                    x=x, y=speed, name=f"{name}, cornering at {grip_mps2:.1f} m/s²", color=color, dashed=True
                )
            )
            panels[1][0].append(Line(x=x, y=steering, name=name, color=color, dashed=True))
            key = name.replace(" ", "_")
            known = np.minimum(np.arange(n), len(places) - 1)
            table = table.assign(**{f"{key}_speed_mps": speed[known], f"{key}_steering_deg": steering[known]})
    return Chart(
        name="speed_steering_by_waypoint",
        title="Speed and steering by waypoint",
        caption="Driven speed and commanded steering, and dashed what the racing line and the centre line "
        "would ask of a car that holds the sideways acceleration this one showed (standing "
        "starts left out), without room for braking. Where the driven speed stays far below the "
        "dashed line, time is to be won; steering that swings where the dashed line is flat is "
        "weaving.",
        rows=[[_by_waypoint(layers, label, n)] for layers, label in panels],
        share_x=True,
        table=table,
    )


def racing_line(view: LogView) -> Chart | None:
    """Show how far the car drives from the racing line."""
    if view.course is None:
        return None
    columns = ("closest_waypoint", "lap_position", "offset_m", "X", "Y")
    rows, which = _laps_or_recent(view, *columns)
    rows = rows[np.isfinite(rows["offset_m"].to_numpy(np.float64))]
    if not len(rows):
        return None
    line, course = line_of(view.course), view.course
    n = waypoint_count(view)
    at = np.arange(n, dtype=np.float64)
    part = thinned(len(rows), _ROWS)
    some = rows.iloc[part]
    lap_position = some["lap_position"].to_numpy(np.float64)
    away_m = some["offset_m"].to_numpy(np.float64) - line.at(lap_position, line.offset_m)
    waypoint = waypoints_of(some)
    low, middle, high = quantiles(waypoint, away_m, n, (0.1, 0.5, 0.9))
    layers: list[Layer] = [
        Line(x=at, y=np.zeros(n), name="racing line", color=VERMILION, dashed=True),
        Band(x=at, low=low, high=high, name=f"{which}, 10th to 90th percentile", color=BLUE),
        Line(x=at, y=middle, name="median", color=BLUE, width=2.0),
    ]
    paths = [
        Line(x=line.xy[:, 0], y=line.xy[:, 1], name="racing line", color=VERMILION, width=1.8, dashed=True)
    ]
    offset_m = quantiles(waypoint, some["offset_m"].to_numpy(np.float64), n, (0.5,))[0][
        : len(course.waypoints)
    ]
    paths.append(_beside(course.waypoints, offset_m, f"{which}, median", BLUE))
    lap = fastest_lap(view, *columns)
    if lap is not None:
        paths.append(
            Line(
                x=lap["X"].to_numpy(np.float64),
                y=lap["Y"].to_numpy(np.float64),
                name="fastest lap",
                color=INK,
                width=1.2,
            )
        )
        own = lap["offset_m"].to_numpy(np.float64) - line.at(
            lap["lap_position"].to_numpy(np.float64), line.offset_m
        )
        layers.append(
            Line(x=at, y=_bridged(means(waypoints_of(lap), own, n)), name="fastest lap", color=INK, width=1.2)
        )
    mean_m = float(np.nanmean(np.abs(away_m)))
    return Chart(
        name="racing_line",
        title=f"The racing line, and how far from it the car drives: {100 * mean_m:.0f} cm on average",
        caption="The racing line is the one of least curvature that keeps all wheels on the road; the "
        "lower panel shows how far to the left (positive) or right of it the car is. A line that "
        "cuts in before the bend and runs wide behind it crosses zero twice: that is turning in "
        "too early.",
        rows=[
            [map_panel(course, paths)],
            [_by_waypoint(layers, "m left of the racing line", n)],
        ],
        table=pd.DataFrame({"waypoint": np.arange(n), "median_m": middle, "p10_m": low, "p90_m": high}),
    )


def sector_times(view: LogView) -> Chart | None:
    """Show what each sector costs: the fastest lap and the usual lap beside the best time of every sector."""
    if view.course is None or not len(view.steps):
        return None
    sectors = sectors_of(view.course)
    times = times_of_sectors(view.steps, sectors)
    times = times[np.isfinite(times).all(axis=1)]
    if not len(times):
        return None
    best = times.min()
    usual, fastest = times.median() - best, times.loc[times.sum(axis=1).idxmin()] - best
    whole_s, ideal_s = float(times.sum(axis=1).min()), theoretical_best_s(times)
    names = list(times.columns)
    x = np.arange(len(names), dtype=np.float64)
    bars = Panel(
        layers=[
            Bars(
                x=names,
                height=usual.to_numpy(np.float64),
                name=f"median of {len(times)} complete laps",
                color=PALE,
            ),
            Points(
                x=x,
                y=fastest.to_numpy(np.float64),
                name="fastest lap",
                color=VERMILION,
                size=9.0,
                symbol="diamond",
                hover=[
                    f"{name}: {lost:.3f} s behind the best {own:.3f} s"
                    for name, lost, own in zip(names, fastest, best, strict=True)
                ],
            ),
        ],
        x_label="sector, in driving direction",
        y_label="s behind the best of the sector",
    )
    lines, notes = [], []
    for number, sector in enumerate(sectors.parts):
        places = view.course.points_at(np.linspace(sector.begin, sector.end, 60))
        color = CATEGORIES[number % 6]
        lines.append(Line(x=places[:, 0], y=places[:, 1], color=color, width=4.0))
        notes.append(
            Note(
                x=float(places[30, 0]),
                y=float(places[30, 1]),
                text=f"{sector.name}\n{best[sector.name]:.2f} s",
            )
        )
    return Chart(
        name="sector_times",
        title=f"Sectors: the best of all together make {ideal_s:.3f} s, the fastest lap took {whole_s:.3f} s",
        caption="Sectors begin and end where the centre line's curvature changes; the map tells the best "
        "time driven in each, in any complete lap. The height of a bar is what the usual lap "
        "loses there, the diamond what even the fastest lap lost.",
        rows=[[map_panel(view.course, [*lines, *notes], numbers=False)], [bars]],
        table=pd.DataFrame(
            {
                "sector": names,
                "best_s": best.to_numpy(),
                "median_s": times.median().to_numpy(),
                "fastest_lap_s": (fastest + best).to_numpy(),
            }
        ),
    )


def _by_waypoint(layers: list[Layer], label: str, n: int) -> Panel:
    return Panel(layers=layers, x_label="waypoint", y_label=label, x_range=(-1.0, float(n)))


def _laps_or_recent(view: LogView, *columns: str) -> tuple[pd.DataFrame, str]:
    """Return the rows of complete laps, or where there is none those of the last third, and what they are."""
    complete = view.episodes["complete"].to_numpy(bool)
    if complete.any():
        return of_episodes(view, complete, *columns), f"{complete.sum()} complete laps"
    return recent(view, *columns), "last third of the iterations"


def _grip(rows: pd.DataFrame) -> float:
    """Return the sideways acceleration that the car holds, m/s2: speed times turn rate of the yaw."""
    speed, turn = (rows[name].to_numpy(np.float64) for name in ("track_speed_mps", "yaw_rate_dps"))
    sideways = np.abs(speed * np.radians(turn))
    sideways = sideways[np.isfinite(sideways)]
    return (
        max(float(np.quantile(sideways, GRIP_SHARE)), LEAST_GRIP_MPS2) if len(sideways) else LEAST_GRIP_MPS2
    )


def _bridged(values: Values) -> Values:
    """Return values with the gaps of waypoints that one lap jumped over filled in."""
    known = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(len(values)), known, values[known]) if len(known) else values


def _beside(waypoints: Values, offset_m: Values, name: str, color: str) -> Line:
    """Return the line that runs beside the waypoints, m to their left."""
    ahead = np.gradient(waypoints, axis=0)
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    places = (
        waypoints[: len(offset_m)]
        + offset_m[:, None] * np.column_stack([-ahead[:, 1], ahead[:, 0]])[: len(offset_m)]
    )
    return Line(x=places[:, 0], y=places[:, 1], name=name, color=color, width=2.0)
