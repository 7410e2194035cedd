"""The picture of runs side by side."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator
from matplotlib.typing import ColorType

from deepracer_exp.formats.run_files import RunRecord

from .comparison import last_value
from .figures import FAINT, INK, MANY

_SMOOTHED = 5  # iterations


def comparison_figure(records: Mapping[str, RunRecord]) -> Figure:
    """Draw the learning curves of runs over each other, and their lap times as bars.

    Args:
        records: the runs by a short label, each with at least one iteration.
    """
    room = 0.24 * math.ceil(len(records) / 2) + 0.2
    bars = max(2.6, 0.34 * len(records) + 0.9)
    figure = Figure(
        figsize=(10.0, 3.1 + bars + room), dpi=150, layout=ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.12)
    )
    grid = figure.subplots(2, 2, height_ratios=[3.1, bars])
    completion, returns, laps, times = grid.flat
    runs = list(records.values())
    _overlay(completion, "Driven, mean per cent of the lap", runs, "completion")
    completion.set_ylim(-3, 103)
    _overlay(returns, "Mean return of an episode", runs, "mean_return")
    _overlay(laps, "Mean lap time, seconds", runs, "mean_lap_time_s")
    _bars(times, records)
    keys = [Line2D([], [], color=_color(number), linewidth=2.5) for number in range(len(records))]
    labels = [f"{label}  {record.name}" for label, record in records.items()]
    figure.legend(
        keys, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=9, labelcolor=INK
    )
    return figure


def _color(number: int) -> ColorType:
    return MANY[number % len(MANY)]


def _overlay(axes: Axes, title: str, records: Sequence[RunRecord], column: str) -> None:
    _style(axes, title)
    axes.grid(axis="y", color="#e9ecef", linewidth=0.8)
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    axes.set_xlabel("control steps", color=FAINT)
    longest, known = 1000.0, False
    for number, record in enumerate(records):
        rows = pd.DataFrame(record.rows)
        columns = [name for name in rows if name.startswith(f"{column}/")] or [column]
        # Not every iteration ends an episode on every track.
        told = rows[columns].astype(float).ffill().mean(axis=1, skipna=False)
        curve = told.rolling(_SMOOTHED, min_periods=1).mean()
        steps = rows["env_steps"].to_numpy(dtype=np.float64)
        longest, known = max(longest, float(steps[-1])), known or bool(curve.notna().any())
        marker = "o" if len(rows) < 12 else ""
        axes.plot(steps, curve, color=_color(number), linewidth=1.6, marker=marker, markersize=3.5)
    axes.set_xlim(0, longest)
    if not known:
        axes.text(0.5, 0.5, "none yet", transform=axes.transAxes, ha="center", color=FAINT)
        axes.set_yticks([])


def _bars(axes: Axes, records: Mapping[str, RunRecord]) -> None:
    """Draw the best lap of each training as a bar, and the mean of its last iteration as a line."""
    _style(axes, "Laps in training, seconds: best (bar), mean of the last iteration (line)")
    best = [last_value(record, "best_lap_time_s") for record in records.values()]
    means = [last_value(record, "mean_lap_time_s") for record in records.values()]
    longest = max((time for time in (*best, *means) if time is not None), default=1.0)
    for number, (time, mean) in enumerate(zip(best, means, strict=True)):
        if time is None:
            axes.text(0.02 * longest, number, "no lap", va="center", color=FAINT, fontsize=9)
            continue
        axes.barh(number, time, height=0.62, color=_color(number))
        axes.text(
            0.02 * longest, number, f"{time:.2f}", va="center", color="white", fontsize=9, fontweight="bold"
        )
        if mean is not None:
            axes.plot([mean, mean], [number - 0.31, number + 0.31], color=INK, linewidth=2.0)
    axes.set(xlim=(0, 1.05 * longest), ylim=(len(records) - 0.5, -0.5))
    axes.set_yticks(range(len(records)), list(records))
    axes.spines["left"].set_visible(False)


def _style(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#cdd2d8")
    axes.tick_params(length=0, labelcolor=FAINT)
    axes.set_axisbelow(True)
