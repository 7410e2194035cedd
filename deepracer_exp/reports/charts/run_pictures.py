"""The two pictures of every run, best_lap.png and learning.png: its driven lines and its learning curves."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.tracks.drawing import area_patch
from deepracer_exp.tracks.outline import Outline
from deepracer_exp.tracks.track import Track

LINE_COLUMNS = (
    *("car", "episode", "steps", "X", "Y", "progress", "tstamp", "episode_status", "iteration", "speed_mps"),
    "track",
)
"""Columns of a trace that `episodes` and `driven_lines` use."""
ROAD, BORDER, CENTER, INK, FAINT = "#30343b", "#b9bfc8", "#6b727d", "#22262b", "#7b828c"
BOX = "#7b614f"
SPEED = LinearSegmentedColormap.from_list("speed", ["#e0457b", "#f58f3c", "#ffe14d", "#7fe3a1", "#4fd6ff"])
"""Colours from slow to fast; every one can be seen on the dark road."""
BLUE, ORANGE, GREEN, PURPLE = "#2f6fb5", "#d9822b", "#2e8b57", "#7a5195"
MANY = [*matplotlib.color_sequences["tab20"][::2], *matplotlib.color_sequences["tab20"][1::2]]
"""Colours of the tracks of a run."""
_MARGIN_M = 0.25
"""Ground shown around the road."""
_DPI = 120


def episodes(trace: pd.DataFrame) -> pd.DataFrame:
    """Summarise each episode of a trace in one row, indexed by its number.

    Columns: `car`, `status` and `iteration` of the last row, `progress` (highest, per cent), `lap_time_s`
    (`rules.lap_clock_s`; NaN unless the lap is complete and whole).
    """
    table = trace.groupby("episode").agg(
        car=("car", "first"),
        first_step=("steps", "first"),
        last_step=("steps", "last"),
        status=("episode_status", "last"),
        progress=("progress", "max"),
        iteration=("iteration", "last"),
        start_s=("tstamp", "first"),
        end_s=("tstamp", "last"),
    )
    # An episode whose beginning is not in the trace would count as a very fast lap.
    whole = (table["status"] == "lap_complete") & (table["first_step"] == 1)
    period_s = (table["end_s"] - table["start_s"]) / (table["last_step"] - table["first_step"])
    table["lap_time_s"] = (lap_clock_s(table["last_step"], 1.0) * period_s).where(whole)
    return table.drop(columns=["first_step", "last_step", "start_s", "end_s"])


def driven_lines(
    trace: pd.DataFrame,
    tracks: Mapping[str, Track],
    boxes_of: Callable[[Track, int], NDArray[np.float64]] | None = None,
    on_usual: NDArray[np.bool_] | None = None,
) -> Figure:
    """Draw the best episode of each track of a trace: its fastest complete lap, or the episode that drove farthest.

    Lines are coloured by measured speed, on one scale; a track that was not driven on is shown empty. `boxes_of`
    returns the corners of an episode's boxes on a track, (k, 4, 2); None: there are none. `on_usual` says of each car
    whether it drives on usual conditions: laps of the others are drawn on a track that has none of these.
    """
    shown = []
    for name, track in tracks.items():
        here = trace[trace["track"] == name]
        table = episodes(here)
        if not len(table):
            shown.append(TrackLines(track, "not driven", ()))
            continue
        laps = table["lap_time_s"]
        if on_usual is not None:
            usual = on_usual[table["car"].to_numpy()]
            laps = laps.where(usual) if laps[usual].notna().any() else laps
        best = laps.idxmin() if laps.notna().any() else table["progress"].idxmax()
        driven = here[here["episode"] == best]
        words = _result(table.loc[best])
        if len(tracks) == 1:
            speed_mps = driven["speed_mps"].to_numpy(dtype=np.float64)[1:]
            words += (
                f"  ·  {track.length_m:.2f} m, mean {speed_mps.mean():.2f} m/s, top {speed_mps.max():.2f} m/s"
            )
            words += f"  ·  iteration {table['iteration'][best]}, episode {best}, car {table['car'][best]}"
        boxes = np.zeros((0, 4, 2)) if boxes_of is None else boxes_of(track, int(best))
        lines = (driven[["X", "Y", "speed_mps"]].to_numpy(np.float64),)
        shown.append(TrackLines(track, words, lines, boxes))
    return lines_figure(shown)


@dataclass(frozen=True)
class _Margins:
    """Fixed margins around axes in inches: a layout engine would take a third of the drawing time."""

    left: float
    right: float
    bottom: float
    top: float
    between_columns: float
    between_rows: float

    def subplots(self, figure: Figure, rows: int, columns: int, sharex: bool = False) -> NDArray[Any]:
        """Return the axes of a grid, (rows, columns)."""
        width, height = figure.get_size_inches()
        axes_width = (width - self.left - self.right - (columns - 1) * self.between_columns) / columns
        axes_height = (height - self.bottom - self.top - (rows - 1) * self.between_rows) / rows
        place = {
            "left": self.left / width,
            "right": 1 - self.right / width,
            "bottom": self.bottom / height,
            "top": 1 - self.top / height,
            "wspace": self.between_columns / axes_width,
            "hspace": self.between_rows / axes_height,
        }
        return figure.subplots(rows, columns, squeeze=False, sharex=sharex, gridspec_kw=place)


@dataclass(frozen=True, eq=False)
class TrackLines:
    """Driven lines on a track."""

    track: Track
    words: str
    """Shown above it."""
    lines: Sequence[NDArray[np.float64]]
    """Columns x_m, y_m and speed_mps, of each line (n, 3)."""
    boxes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 2)))
    """Corners of the boxes on the road, (k, 4, 2), metres."""


def lines_figure(shown: Sequence[TrackLines]) -> Figure:
    """Draw lines on their tracks, coloured by measured speed, on one scale."""
    single = len(shown) == 1
    columns = len(shown) if len(shown) <= 3 else math.ceil(math.sqrt(len(shown)))
    rows = math.ceil(len(shown) / columns)
    shape = 0.8
    if single:
        low, high = Outline.of(shown[0].track).corners(_MARGIN_M)
        width_m, height_m = high - low
        shape = float(np.clip(height_m / width_m, 0.25, 0.9))
    cell = (10.0 if single else 13.0) / columns  # inches
    figure = Figure((columns * cell, rows * (0.9 * shape * cell + 0.9)), dpi=_DPI)
    title = 0.65 if single else 0.5  # inches
    margins = _Margins(left=0.15, right=1.0, bottom=0.12, top=title, between_columns=0.3, between_rows=title)
    cells = margins.subplots(figure, rows, columns)
    lines = []
    for axes, here in zip(cells.flat, shown, strict=False):
        _draw_road(axes, here.track)
        width = (3.0 if single else 1.8) / math.sqrt(max(len(here.lines), 1))
        for corners in here.boxes:
            axes.add_patch(Polygon(corners, facecolor=BOX, edgecolor="white", linewidth=0.8, zorder=3))
        lines += [_draw_line(axes, line, width, arrow=11.0 if single else 7.0) for line in here.lines]
        size = 11.0 if single else 8.5
        axes.set_title(
            here.track.title, loc="left", fontsize=1.5 * size, fontweight="bold", color=INK, pad=2 * size
        )
        above = {"xytext": (0, 0.7 * size), "textcoords": "offset points", "xycoords": "axes fraction"}
        axes.annotate(here.words, (0, 1), fontsize=size, color=FAINT, **above)
    for axes in cells.flat[len(shown) :]:
        axes.set_axis_off()
    if lines:
        speeds = np.concatenate([np.asarray(line.get_array()) for line in lines])
        for line in lines:
            # The few rows after the standing start would take half of the colours.
            line.set_clim(float(np.percentile(speeds, 5)), float(speeds.max()))
        width, height = figure.get_size_inches()
        place = figure.add_axes((1 - 0.6 / width, 0.2, 0.12 / width, 0.6 - 0.3 / height))
        bar = figure.colorbar(lines[0], cax=place, extend="min")
        bar.outline.set_visible(False)
        bar.ax.tick_params(length=0, labelcolor=FAINT, labelsize=10)
        bar.ax.set_title("m/s", fontsize=10, color=FAINT, loc="left", pad=8)
    return figure


def learning_curves(metrics: pd.DataFrame) -> Figure:
    """Draw a run's learning curves: completion, return, lap times and entropy against control steps.

    The rows are those of metrics.jsonl; `completion` in per cent, `lap_share` a fraction; `completion/TRACK` and
    `mean_lap_time_s/TRACK` of each of several tracks.

    With several tracks, completion and lap times have a thin line for each.
    """
    tracks = [name.removeprefix("completion/") for name in metrics if name.startswith("completion/")]
    legend = 0.3 * math.ceil(len(tracks) / 5)  # inches
    figure = Figure((10.0, 6.0 + legend), dpi=_DPI)
    margins = _Margins(
        left=0.6, right=0.15, bottom=0.55 + legend, top=0.37, between_columns=0.65, between_rows=0.65
    )
    driving, returns, laps, entropy = margins.subplots(figure, 2, 2, sharex=True).flat
    # A column of nulls alone has no numeric type.
    numbers = metrics.apply(pd.to_numeric).assign(lap_share=100 * metrics["lap_share"].astype(float))
    laps_label = "share of complete exploring laps" + (", on the track where it is lowest" if tracks else "")
    _curves(
        driving,
        numbers,
        "Driven, per cent",
        {"completion": ("mean completion of an exploring episode", BLUE), "lap_share": (laps_label, GREEN)},
        [f"completion/{name}" for name in tracks],
    )
    driving.set_ylim(-3, 103)
    _curves(returns, numbers, "Mean return of an episode", {"mean_return": ("", BLUE)})
    _curves(
        laps,
        numbers,
        "Mean exploring lap of each track, seconds" if tracks else "Exploring lap, seconds",
        {"mean_lap_time_s": ("mean", BLUE), "best_lap_time_s": ("fastest so far", ORANGE)},
        [f"mean_lap_time_s/{name}" for name in tracks],
    )
    _curves(entropy, numbers, "Entropy of the policy, nats", {"entropy": ("", PURPLE)})
    for axes in (laps, entropy):
        axes.set_xlabel("control steps", color=FAINT)
        axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
        axes.set_xlim(0, max(float(metrics["env_steps"].max()) if len(metrics) else 0.0, 1000.0))
    if tracks:
        thin = driving.lines[: len(tracks)]
        style = {"ncols": 5, "frameon": False, "fontsize": 8, "labelcolor": INK}
        figure.legend(thin, tracks, loc="lower center", **style)
    return figure


def _curves(
    axes: Axes,
    metrics: pd.DataFrame,
    title: str,
    curves: Mapping[str, tuple[str, str]],
    of_tracks: Sequence[str] = (),
) -> None:
    # With `y`, matplotlib does not search space for the title, which would take as long as drawing the ticks.
    axes.set_title(title, loc="left", y=1.0, fontsize=11, fontweight="bold", color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#cdd2d8")
    axes.tick_params(length=0, labelcolor=FAINT, labelbottom=True)
    axes.grid(axis="y", color="#e9ecef", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    axes.yaxis.set_major_formatter("{x:.5g}")
    thin = {name: ("", MANY[number % len(MANY)]) for number, name in enumerate(of_tracks)}
    for name, (label, color) in (thin | dict(curves)).items():
        # Not every iteration ends an episode on every track.
        rows = metrics[metrics[name].notna()] if name in thin else metrics
        if of_tracks and not rows[name].notna().any():
            continue
        width = 0.8 if name in thin else 1.8
        # Dots as well where there are few, since a single point has no line.
        dots = "o" if name in curves and len(metrics) < 12 else ""
        axes.plot(rows["env_steps"], rows[name], color=color, linewidth=width, label=label, marker=dots, ms=4)
    if not metrics[[*thin, *curves]].notna().any(axis=None):
        axes.text(0.5, 0.5, "none yet", transform=axes.transAxes, ha="center", color=FAINT)
        axes.set_yticks([])
    elif any(label for label, _ in curves.values()) and axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=8, labelcolor=INK)


def _result(episode: pd.Series) -> str:
    lap_s = float(episode["lap_time_s"])
    if math.isfinite(lap_s):
        return f"exploring lap in {lap_s:.2f} s"
    return f"{episode['progress']:.1f}% of the lap, {str(episode['status']).replace('_', ' ')}"


def _draw_line(axes: Axes, rows: NDArray[np.float64], width: float, arrow: float) -> LineCollection:
    points = rows[:, :2]
    segments = list(np.stack([points[:-1], points[1:]], axis=1))
    line = LineCollection(segments, cmap=SPEED, linewidths=width, capstyle="round", zorder=4)
    # A segment has the speed at its end: the row before it may be the standing start.
    line.set_array(rows[1:, 2])
    axes.add_collection(line)
    ahead_x, ahead_y = points[min(5, len(points) - 1)] - points[0]
    marker = (3, 0, math.degrees(math.atan2(ahead_y, ahead_x)) - 90)
    axes.plot(*points[0], marker=marker, markersize=arrow, color="white", markeredgecolor=INK, zorder=5)
    return line


def _draw_road(axes: Axes, track: Track) -> None:
    outline = Outline.of(track)
    x_range, y_range = np.transpose(outline.corners(_MARGIN_M))
    axes.set(xlim=x_range, ylim=y_range, aspect="equal", anchor="NW")
    axes.set_axis_off()
    axes.add_patch(area_patch(outline.rings, facecolor=ROAD, edgecolor="none", zorder=1))
    for border in outline.borders:
        axes.plot(*border.T, color=BORDER, linewidth=1.8, solid_joinstyle="round", zorder=2)
    axes.plot(*track.waypoints.T, color=CENTER, linewidth=1.0, dashes=(5, 4), zorder=2)
    axes.plot(*outline.start_line.T, color="white", linewidth=2.2, zorder=3)
