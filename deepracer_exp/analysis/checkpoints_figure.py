"""The picture of a run's checkpoints: speed against stability."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.typing import ColorType

from .figures import FAINT, INK, MANY


@dataclass(frozen=True)
class Lap:
    """How a checkpoint drives under some conditions."""

    time_s: float | None
    """25th percentile; None without a complete lap."""
    complete: float
    """Laps of a hundred."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """A checkpoint in the picture."""

    name: str
    labels: str
    """`best, last` and the like."""
    usual: Lap
    interval: tuple[float, float]
    """Of the complete laps on the usual conditions, of a hundred."""
    held_out: Lap | None


def checkpoints_figure(title: str, points: Sequence[Point], recommended: str) -> Figure:
    """Draw lap time against the share of complete laps, a colour for each checkpoint.

    Args:
        title: name of the run.
        points: its checkpoints, the oldest first.
        recommended: name of the one that gets a ring.
    """
    figure = Figure(figsize=(9.0, 5.2), dpi=150, layout=ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.12))
    axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#cdd2d8")
    axes.tick_params(length=0, labelcolor=FAINT)
    axes.grid(color="#e9ecef", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_ylim(-4, 104)
    axes.set_ylabel("complete laps, per cent", color=FAINT)
    axes.set_xlabel("lap time, 25th percentile, seconds  (faster to the right)", color=FAINT)
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]))
    if all(point.usual.time_s is None for point in points):
        axes.text(0.5, 0.5, "no complete lap", transform=axes.transAxes, ha="center", color=FAINT)
        axes.set_xticks([])
    for number, point in enumerate(points):
        # Lap times are multiples of the control period, so that points fall on each other: the older one is larger.
        above = sum(later.usual == point.usual for later in points[number + 1 :])
        _draw(axes, point, MANY[number % len(MANY)], 8 + 5 * above, point.name == recommended)
    axes.margins(x=0.12)
    axes.invert_xaxis()
    keys, labels = _legend(points, recommended)
    figure.legend(keys, labels, loc="outside right upper", frameon=False, fontsize=9, labelcolor=INK)
    return figure


def _draw(axes: Axes, point: Point, color: ColorType, size: float, ringed: bool) -> None:
    usual, held_out = point.usual, point.held_out
    if held_out is not None and held_out.time_s is not None:
        if usual.time_s is not None:
            way = [usual.time_s, held_out.time_s], [usual.complete, held_out.complete]
            axes.plot(*way, color=color, linewidth=1.0, alpha=0.5, zorder=2)
        axes.plot(held_out.time_s, held_out.complete, "o", mfc="white", mec=color, mew=1.6, ms=7, zorder=3)
    if usual.time_s is None:
        return
    axes.plot([usual.time_s] * 2, point.interval, color=color, linewidth=1.6, solid_capstyle="butt", zorder=2)
    axes.plot(usual.time_s, usual.complete, "o", color=color, ms=size, zorder=4)
    if ringed:
        axes.plot(usual.time_s, usual.complete, "o", mfc="none", mec=INK, mew=1.6, ms=size + 7, zorder=5)


def _legend(points: Sequence[Point], recommended: str) -> tuple[list[Artist], list[str]]:
    keys: list[Artist] = []
    labels = []
    for number, point in enumerate(points):
        keys.append(Line2D([], [], color=MANY[number % len(MANY)], marker="o", linestyle="", ms=8))
        more = [point.labels, "no lap" * (point.usual.time_s is None)]
        labels.append("  ".join([point.name, *filter(None, more)]))
    keys.append(Line2D([], [], mfc="none", mec=INK, mew=1.6, marker="o", linestyle="", ms=11))
    labels.append(f"recommended: {recommended}")
    keys.append(Line2D([], [], color=FAINT, linewidth=1.6))
    labels.append("95% interval")
    if any(point.held_out is not None for point in points):
        keys.append(Line2D([], [], mfc="white", mec=FAINT, mew=1.6, marker="o", linestyle="", ms=7))
        labels.append("on held-out conditions")
    return keys, labels
