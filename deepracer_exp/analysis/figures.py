"""The two pictures of every run: the line it drove, and how it learned."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.ticker import EngFormatter, MaxNLocator
from shapely import get_coordinates, get_parts, get_rings, orient_polygons

from deepracer_exp.tracks.track import Track

LINE_COLUMNS = (
    *("car", "episode", "steps", "X", "Y", "progress", "tstamp", "episode_status", "iteration", "speed_mps"),
)
"""Columns of a trace that `episodes` and `driven_line` look at."""
ROAD, BORDER, CENTER, INK, FAINT = "#30343b", "#b9bfc8", "#6b727d", "#22262b", "#7b828c"
SPEED = LinearSegmentedColormap.from_list("speed", ["#e0457b", "#f58f3c", "#ffe14d", "#7fe3a1", "#4fd6ff"])
"""Slow to fast; every colour stands out from the dark road."""
BLUE, ORANGE, GREEN, PURPLE = "#2f6fb5", "#d9822b", "#2e8b57", "#7a5195"


def episodes(trace: pd.DataFrame) -> pd.DataFrame:
    """Sum up each episode of a trace in one row, indexed by its number.

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
    # An episode whose beginning is not in the trace would pass for a very fast lap.
    whole = (table["status"] == "lap_complete") & (table["first_step"] == 1)
    table["lap_time_s"] = (table["end_s"] - table["start_s"]).where(whole)
    return table.drop(columns=["first_step", "start_s", "end_s"])


def driven_line(trace: pd.DataFrame, track: Track, episode: int | None = None) -> Figure:
    """Draw the line of one episode on its track, coloured by measured speed.

    Args:
        trace: rows as `formats.trace.read_trace` gives them.
        track: the course they were driven on.
        episode: its number; without it the fastest complete lap, or where there is none the
            episode that came farthest.

    Raises:
        KeyError: the trace has no such episode.
    """
    table = episodes(trace)
    if episode is None:
        laps = table["lap_time_s"]
        episode = laps.idxmin() if laps.notna().any() else table["progress"].idxmax()
    summary = table.loc[episode]
    rows = trace[trace["episode"] == episode]

    low, high = (getattr(np.concatenate([track.inner, track.outer]), name)(axis=0) for name in ("min", "max"))
    width_m, height_m = (high - low) + 0.5
    # A picture 10 inches wide, whose height follows the track and leaves room for the two lines of title.
    figure = Figure(figsize=(10.0, float(np.clip(8.8 * height_m / width_m + 0.9, 3.5, 10.0))), dpi=150)
    axes = figure.add_axes((0.02, 0.02, 0.86, 0.96 - 0.85 / figure.get_figheight()))
    axes.set(xlim=(low[0] - 0.25, high[0] + 0.25), ylim=(low[1] - 0.25, high[1] + 0.25), aspect="equal")
    axes.set_axis_off()
    _draw_road(axes, track)

    points = rows[["X", "Y"]].to_numpy()
    speed_mps = rows["speed_mps"].to_numpy(dtype=np.float64)
    line = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        cmap=SPEED,
        linewidths=3.0,
        capstyle="round",
        zorder=4,
    )
    # A segment has the speed at its end: the row before it may be the standing start.
    line.set_array(speed_mps[1:])
    # The few rows of pulling away would take half of the colours.
    line.set_clim(np.percentile(speed_mps[1:], 5), speed_mps.max())
    axes.add_collection(line)
    ahead_x, ahead_y = points[min(5, len(points) - 1)] - points[0]
    arrow = (3, 0, math.degrees(math.atan2(ahead_y, ahead_x)) - 90)
    axes.plot(*points[0], marker=arrow, markersize=11, color="white", markeredgecolor=INK, zorder=5)
    bar = figure.colorbar(line, cax=figure.add_axes((0.905, 0.14, 0.016, 0.6)), extend="min")
    bar.outline.set_visible(False)
    bar.ax.tick_params(length=0, labelcolor=FAINT, labelsize=10)
    bar.ax.set_title("m/s", fontsize=10, color=FAINT, loc="left", pad=8)

    lap_s = float(summary["lap_time_s"])
    result = (
        f"lap in {lap_s:.2f} s"
        if math.isfinite(lap_s)
        else f"{summary['progress']:.1f} % of the lap, {str(summary['status']).replace('_', ' ')}"
    )
    top = figure.get_figheight()
    figure.text(0.035, 1 - 0.32 / top, track.title, fontsize=17, fontweight="bold", color=INK, va="center")
    figure.text(
        0.035,
        1 - 0.64 / top,
        f"{result}  ·  {track.length_m:.2f} m, mean {speed_mps[1:].mean():.2f} m/s,"
        f" top {speed_mps.max():.2f} m/s"
        f"  ·  iteration {summary['iteration']}, episode {episode}, car {summary['car']}",
        fontsize=11,
        color=FAINT,
        va="center",
    )
    return figure


def learning_curves(metrics: pd.DataFrame) -> Figure:
    """Draw how a run learned: completion, return, lap times and entropy against control steps.

    Args:
        metrics: rows of metrics.jsonl; `completion` in per cent, `lap_share` a fraction.
    """
    figure = Figure(figsize=(10.0, 6.0), dpi=150, layout=ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.12))
    grid = figure.subplots(2, 2, sharex=True)
    steps = metrics["env_steps"].to_numpy(dtype=np.float64)

    def values(name: str) -> np.ndarray:
        return metrics[name].to_numpy(dtype=np.float64, na_value=np.nan)

    driving, returns, laps, entropy = grid.flat
    _curves(
        driving,
        "Driven, per cent",
        steps,
        [
            ("mean completion of an episode", values("completion"), BLUE),
            ("share of complete laps", 100 * values("lap_share"), GREEN),
        ],
    )
    driving.set_ylim(-3, 103)
    _curves(returns, "Mean return of an episode", steps, [("", values("mean_return"), BLUE)])
    _curves(
        laps,
        "Lap time, seconds",
        steps,
        [("mean", values("mean_lap_time_s"), BLUE), ("best", values("best_lap_time_s"), ORANGE)],
    )
    _curves(entropy, "Entropy of the policy, nats", steps, [("", values("entropy"), PURPLE)])
    for axes in (laps, entropy):
        axes.set_xlabel("control steps", color=FAINT)
        axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
        axes.set_xlim(0, max(float(steps.max(initial=0.0)), 1000.0))
    return figure


def _draw_road(axes: Axes, track: Track) -> None:
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


def _curves(axes: Axes, title: str, steps: np.ndarray, curves: Sequence[tuple[str, np.ndarray, str]]) -> None:
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#cdd2d8")
    axes.tick_params(length=0, labelcolor=FAINT, labelbottom=True)
    axes.grid(axis="y", color="#e9ecef", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    known = False
    for label, curve, color in curves:
        known = known or bool(np.isfinite(curve).any())
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
        # Unclipped lines would have a say in the layout, and a line without points turns it to nothing.
        line.set_in_layout(False)
    if not known:
        axes.text(0.5, 0.5, "none yet", transform=axes.transAxes, ha="center", color=FAINT)
        axes.set_yticks([])
    elif any(label for label, _, _ in curves):
        axes.legend(frameon=False, fontsize=9, labelcolor=INK)
