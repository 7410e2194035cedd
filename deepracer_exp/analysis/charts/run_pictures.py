"""The two pictures of every run, best_lap.png and learning.png: its driven line and its learning curves."""

import math
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.ticker import EngFormatter, MaxNLocator
from shapely import get_coordinates, get_parts, get_rings, orient_polygons

from deepracer_exp.tracks.track import Track

LINE_COLUMNS = (
    *("car", "episode", "steps", "X", "Y", "progress", "tstamp", "episode_status", "iteration", "speed_mps"),
    "track",
)
"""Columns of a trace that `episodes`, `driven_line` and `driven_lines` use."""
ROAD, BORDER, CENTER, INK, FAINT = "#30343b", "#b9bfc8", "#6b727d", "#22262b", "#7b828c"
SPEED = LinearSegmentedColormap.from_list("speed", ["#e0457b", "#f58f3c", "#ffe14d", "#7fe3a1", "#4fd6ff"])
"""From slow to fast; every colour can be seen on the dark road."""
BLUE, ORANGE, GREEN, PURPLE = "#2f6fb5", "#d9822b", "#2e8b57", "#7a5195"
MANY = [*matplotlib.color_sequences["tab20"][::2], *matplotlib.color_sequences["tab20"][1::2]]
"""Colours of the tracks of a run."""


def episodes(trace: pd.DataFrame) -> pd.DataFrame:
    """Summarise each episode of a trace in one row, indexed by its number.

    Columns: `car`, `rows`, `status` and `iteration` of the last row, `progress` (highest, per cent),
    `lap_time_s` (simulated time from the prepare row to the last; NaN unless the lap is complete and whole).
    """
    grouped = trace.groupby("episode")
    table = grouped.agg(
        car=("car", "first"),
        rows=("steps", "size"),
        first_step=("steps", "first"),
        status=("episode_status", "last"),
        progress=("progress", "max"),
        iteration=("iteration", "last"),
        start_s=("tstamp", "first"),
        end_s=("tstamp", "last"),
    )
    # An episode whose beginning is not in the trace would count as a very fast lap.
    whole = (table["status"] == "lap_complete") & (table["first_step"] == 1)
    table["lap_time_s"] = (table["end_s"] - table["start_s"]).where(whole)
    return table.drop(columns=["first_step", "start_s", "end_s"])


def driven_line(trace: pd.DataFrame, track: Track, episode: int | None = None) -> Figure:
    """Draw the line of one episode on its track, coloured by measured speed.

    Args:
        trace: rows as `deepracer.trace.read_trace` gives them.
        track: their course.
        episode: its number; without it the fastest complete lap, or where there is none the
            episode that drove farthest.

    Raises:
        KeyError: the trace has no such episode.
    """
    table = episodes(trace)
    episode = _best(table) if episode is None else episode
    summary = table.loc[episode]
    rows = trace[trace["episode"] == episode]

    (left, right), (bottom, top_m) = _bounds(track)
    width_m, height_m = right - left, top_m - bottom
    # A picture 10 inches wide, whose height follows the track and leaves room for the two lines of title.
    figure = Figure(figsize=(10.0, float(np.clip(8.8 * height_m / width_m + 0.9, 3.5, 10.0))), dpi=150)
    axes = figure.add_axes((0.02, 0.02, 0.86, 0.96 - 0.85 / figure.get_figheight()))
    _draw_road(axes, track)

    speed_mps = rows["speed_mps"].to_numpy(dtype=np.float64)
    line = _draw_line(axes, rows, width=3.0, arrow=11.0)
    line.set_clim(*_colored_speeds(speed_mps[1:]))
    _speed_bar(figure, line, (0.905, 0.14, 0.016, 0.6))

    top = figure.get_figheight()
    figure.text(0.035, 1 - 0.32 / top, track.title, fontsize=17, fontweight="bold", color=INK, va="center")
    figure.text(
        0.035,
        1 - 0.64 / top,
        f"{_result(summary)}  ·  {track.length_m:.2f} m, mean {speed_mps[1:].mean():.2f} m/s,"
        f" top {speed_mps.max():.2f} m/s"
        f"  ·  iteration {summary['iteration']}, episode {episode}, car {summary['car']}",
        fontsize=11,
        color=FAINT,
        va="center",
    )
    return figure


def driven_lines(trace: pd.DataFrame, tracks: Mapping[str, Track]) -> Figure:
    """Draw the best episode of each track side by side, coloured by measured speed on one scale.

    Args:
        trace: rows as `deepracer.trace.read_trace` gives them.
        tracks: the courses by their names in the trace; one that was not driven on is shown empty.
    """
    columns = len(tracks) if len(tracks) <= 3 else math.ceil(math.sqrt(len(tracks)))
    rows = math.ceil(len(tracks) / columns)
    cell = 12.1 / columns  # inches: square cells without the two lines of text
    width, height = 13.0, rows * (0.8 * cell + 0.55)
    figure = Figure(figsize=(width, height), dpi=150)
    lines = []
    for number, (name, track) in enumerate(tracks.items()):
        row, column = divmod(number, columns)
        left, top = 0.15 + column * cell, height - 0.12 - row * height / rows
        box = (left / width, (top - 0.42 - 0.74 * cell) / height, 0.9 * cell / width, 0.74 * cell / height)
        axes = figure.add_axes(box, anchor="NW")
        _draw_road(axes, track)
        here = trace[trace["track"] == name]
        table = episodes(here)
        result = "not driven"
        if len(table):
            episode = _best(table)
            lines.append(_draw_line(axes, here[here["episode"] == episode], width=1.8, arrow=7.0))
            result = _result(table.loc[episode])
        place = left / width, (top - 0.1) / height
        figure.text(*place, track.title, fontsize=9, fontweight="bold", color=INK, va="center")
        place = left / width, (top - 0.28) / height
        figure.text(*place, result, fontsize=8.5, color=FAINT, va="center")
    if lines:
        bounds = _colored_speeds(np.concatenate([np.asarray(line.get_array()) for line in lines]))
        for line in lines:
            line.set_clim(*bounds)
        bar_height = min(3.0, 0.6 * height)
        _speed_bar(figure, lines[0], (0.95, 1 - (bar_height + 0.6) / height, 0.012, bar_height / height))
    return figure


def learning_curves(metrics: pd.DataFrame) -> Figure:
    """Draw how a run learned: completion, return, lap times and entropy against control steps.

    With several tracks, completion and lap times have a thin line for each.

    Args:
        metrics: rows of metrics.jsonl; `completion` in per cent, `lap_share` a fraction; `completion/TRACK` and
            `mean_lap_time_s/TRACK` of each of several tracks.
    """
    tracks = [name.removeprefix("completion/") for name in metrics if name.startswith("completion/")]
    room = 0.3 * math.ceil(len(tracks) / 5)
    figure = Figure(
        figsize=(10.0, 6.0 + room), dpi=150, layout=ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.12)
    )
    grid = figure.subplots(2, 2, sharex=True)
    steps = metrics["env_steps"].to_numpy(dtype=np.float64)

    def values(name: str) -> np.ndarray:
        return metrics[name].to_numpy(dtype=np.float64, na_value=np.nan)

    driving, returns, laps, entropy = grid.flat
    laps_label = "share of complete laps" + (", on the track where it is lowest" if tracks else "")
    _curves(
        driving,
        "Driven, per cent",
        steps,
        [
            ("mean completion of an episode", values("completion"), BLUE),
            (laps_label, 100 * values("lap_share"), GREEN),
        ],
        [values(f"completion/{name}") for name in tracks],
    )
    driving.set_ylim(-3, 103)
    _curves(returns, "Mean return of an episode", steps, [("", values("mean_return"), BLUE)])
    _curves(
        laps,
        "Mean lap time of each track, seconds" if tracks else "Lap time, seconds",
        steps,
        [("mean", values("mean_lap_time_s"), BLUE), ("best", values("best_lap_time_s"), ORANGE)],
        [values(f"mean_lap_time_s/{name}") for name in tracks],
    )
    _curves(entropy, "Entropy of the policy, nats", steps, [("", values("entropy"), PURPLE)])
    for axes in (laps, entropy):
        axes.set_xlabel("control steps", color=FAINT)
        axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
        axes.set_xlim(0, max(float(steps.max(initial=0.0)), 1000.0))
    if tracks:
        keys = [Line2D([], [], color=MANY[number % len(MANY)]) for number in range(len(tracks))]
        figure.legend(
            keys, tracks, loc="outside lower center", ncols=5, frameon=False, fontsize=8, labelcolor=INK
        )
    return figure


def _best(table: pd.DataFrame) -> int:
    """Return the fastest complete lap, or where there is none the episode that drove farthest."""
    laps = table["lap_time_s"]
    return int(laps.idxmin() if laps.notna().any() else table["progress"].idxmax())


def _result(episode: pd.Series) -> str:
    lap_s = float(episode["lap_time_s"])
    if math.isfinite(lap_s):
        return f"lap in {lap_s:.2f} s"
    return f"{episode['progress']:.1f} % of the lap, {str(episode['status']).replace('_', ' ')}"


def _colored_speeds(speed_mps: np.ndarray) -> tuple[float, float]:
    """Return the speeds of the first and the last colour."""
    # The few rows after the standing start would take half of the colours.
    return float(np.percentile(speed_mps, 5)), float(speed_mps.max())


def _draw_line(axes: Axes, rows: pd.DataFrame, width: float, arrow: float) -> LineCollection:
    points = rows[["X", "Y"]].to_numpy()
    line = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        cmap=SPEED,
        linewidths=width,
        capstyle="round",
        zorder=4,
    )
    # A segment has the speed at its end: the row before it may be the standing start.
    line.set_array(rows["speed_mps"].to_numpy(dtype=np.float64)[1:])
    axes.add_collection(line)
    ahead_x, ahead_y = points[min(5, len(points) - 1)] - points[0]
    marker = (3, 0, math.degrees(math.atan2(ahead_y, ahead_x)) - 90)
    axes.plot(*points[0], marker=marker, markersize=arrow, color="white", markeredgecolor=INK, zorder=5)
    return line


def _speed_bar(figure: Figure, line: LineCollection, place: tuple[float, float, float, float]) -> None:
    bar = figure.colorbar(line, cax=figure.add_axes(place), extend="min")
    bar.outline.set_visible(False)
    bar.ax.tick_params(length=0, labelcolor=FAINT, labelsize=10)
    bar.ax.set_title("m/s", fontsize=10, color=FAINT, loc="left", pad=8)


def _bounds(track: Track) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of x and y that show the whole road."""
    borders = np.concatenate([track.inner, track.outer])
    (left, bottom), (right, top) = borders.min(axis=0) - 0.25, borders.max(axis=0) + 0.25
    return (left, right), (bottom, top)


def _draw_road(axes: Axes, track: Track) -> None:
    x_range, y_range = _bounds(track)
    axes.set(xlim=x_range, ylim=y_range, aspect="equal")
    axes.set_axis_off()
    polygons = [orient_polygons(part) for part in get_parts(track.road) if part.geom_type == "Polygon"]
    # Rings run in opposite directions, so that holes stay empty.
    rings = [
        Outline(get_coordinates(ring), closed=True) for polygon in polygons for ring in get_rings(polygon)
    ]
    axes.add_patch(PathPatch(Outline.make_compound_path(*rings), facecolor=ROAD, edgecolor="none", zorder=1))
    for border in (track.inner, track.outer):
        axes.plot(*border.T, color=BORDER, linewidth=1.8, solid_joinstyle="round", zorder=2)
    axes.plot(*track.waypoints.T, color=CENTER, linewidth=1.0, dashes=(5, 4), zorder=2)
    axes.plot(*np.stack([track.inner[0], track.outer[0]]).T, color="white", linewidth=2.2, zorder=3)


def _curves(
    axes: Axes,
    title: str,
    steps: np.ndarray,
    curves: Sequence[tuple[str, np.ndarray, str]],
    of_tracks: Sequence[np.ndarray] = (),
) -> None:
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#cdd2d8")
    axes.tick_params(length=0, labelcolor=FAINT, labelbottom=True)
    axes.grid(axis="y", color="#e9ecef", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    known = False
    for number, curve in enumerate(of_tracks):
        # Not every iteration ends an episode on every track.
        finite = np.isfinite(curve)
        known = known or bool(finite.any())
        color = MANY[number % len(MANY)]
        (line,) = axes.plot(
            steps[finite], curve[finite], color=color, linewidth=0.8, alpha=0.9, clip_on=False
        )
        line.set_in_layout(False)
    labelled = False
    for label, curve, color in curves:
        if of_tracks and not np.isfinite(curve).any():
            continue
        known = known or bool(np.isfinite(curve).any())
        labelled = labelled or bool(label)
        # Dots as well where there are few, since a single point has no line.
        (line,) = axes.plot(
            steps,
            curve,
            color=color,
            linewidth=1.8,
            label=label,
            marker="o" if len(steps) < 12 else "",
            markersize=4,
            clip_on=False,
        )
        # Unclipped lines would influence the layout, and a line without points breaks it.
        line.set_in_layout(False)
    if not known:
        axes.text(0.5, 0.5, "none yet", transform=axes.transAxes, ha="center", color=FAINT)
        axes.set_yticks([])
    elif labelled:
        axes.legend(frameon=False, fontsize=9, labelcolor=INK)
