"""The figures of docs/measured/fidelity.md: recorded laps and simulated ones, and what the errors look like."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from benchmarks.calibrate import Fit
from benchmarks.recorded import BANDS, LENGTHS, Recorded, in_band, join
from benchmarks.replay import WARM_UP_STEPS, cut_windows, errors, replay

Floats = NDArray[np.float64]
RECORDED, SIMULATED, FAINT = "#d9822b", "#2f6fb5", "#7b828c"
COLOURS = {"low": "#5aa469", "middle": "#2f6fb5", "high": "#b5432f"}
_PERIOD_S = 1.0 / 15.0
_LEAST = 20
"""Fewer windows are not drawn."""
_BINS = 9

Drawn = Sequence[tuple[int, Sequence[tuple[Recorded, Fit]]]]
"""Versions, each with its recordings and the car that was fitted to each."""


def draw(versions: Drawn, folder: Path) -> list[Path]:
    """Draw all figures into the folder and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"fidelity_laps.png": _laps(versions), "fidelity_residuals.png": _residuals(versions)}
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=110, bbox_inches="tight")
        plt.close(figure)
    return [folder / name for name in figures]


def _laps(versions: Drawn) -> plt.Figure:
    """Draw the fastest episode of each version, the simulated car put back every three seconds."""
    figure, axes = plt.subplots(1, len(versions), figsize=(4.6 * len(versions), 3.8), squeeze=False)
    for axis, (version, parts) in zip(axes[0], versions, strict=True):
        # The recording with most rows; of its episodes, complete laps before others, then the shortest.
        one, fitted = max(parts, key=lambda each: len(each[0].steps))
        of = ["stream", "worker", "iteration", "episode"]
        episodes = one.steps.groupby(of, sort=False, observed=True)
        laps = episodes.agg(rows=("steps", "size"), progress=("progress", "max")).reset_index()
        lap = laps.sort_values(["progress", "rows"], ascending=[False, True]).iloc[0]
        rows = one.steps[(one.steps[of] == list(lap[of])).all(axis=1)]
        car, yaw = fitted.car, np.radians(rows["yaw"])
        origin = [rows[c] - car.front_point_m * turn(yaw) for c, turn in (("X", np.cos), ("Y", np.sin))]
        axis.plot(*origin, color=RECORDED, lw=2.6)
        for begin in range(0, len(rows) - LENGTHS["one_second"], LENGTHS["three_second"]):
            ahead = min(LENGTHS["three_second"], len(rows) - begin - 2)
            piece = cut_windows(rows.iloc[max(0, begin - WARM_UP_STEPS) :], car.front_point_m, ahead)
            piece = piece.choose(np.arange(len(piece)) == (begin > 0))
            if len(piece):
                path = np.vstack([piece.start, replay(car, piece, fitted.observer)[0]])
                axis.plot(*path[:, :2].T, color=SIMULATED, lw=1.4)
                axis.plot(*path[0, :2], "o", color=SIMULATED, ms=4)
        axis.set_aspect("equal")
        seconds = np.ptp(rows["tstamp"].to_numpy())
        mps = np.hypot(np.diff(origin[0]), np.diff(origin[1])).sum() / max(seconds, _PERIOD_S)
        axis.set_title(f"version {version}, {mps:.1f} m/s on average", fontsize=10)
        axis.set_xlabel("x (m)")
    axes[0][0].set_ylabel("y (m)")
    names = (("recorded", RECORDED), ("simulated, put back onto the recording every 3 s (dots)", SIMULATED))
    lines = [axes[0][0].plot([], [], color=color, lw=2, label=name)[0] for name, color in names]
    figure.legend(handles=lines, frameon=False, fontsize=9, loc="lower center", ncols=2)
    figure.tight_layout(rect=(0, 0.07, 1, 1))
    return figure


def _residuals(versions: Drawn) -> plt.Figure:
    """Draw, by band: the error as it grows, its distribution ahead and to the left, and both by what was commanded."""
    columns = (
        "error as it grows",
        "after 1 s: ahead and to the left",
        "to the left, by steering",
        "ahead, by speed",
    )
    figure, axes = plt.subplots(len(versions), 4, figsize=(15, 3.3 * len(versions)), squeeze=False)
    for row, (version, parts) in zip(axes, versions, strict=True):
        each = [one.windows["one_second"] for one, _ in parts]
        windows = join(each)
        fits = [fitted for _, fitted in parts]
        paths = [replay(fit.car, of, fit.observer) for fit, of in zip(fits, each, strict=True)]
        off = errors(np.concatenate(paths), windows)
        yaw = windows.truth[:, -1, 2]
        x_m, y_m = off.x_m[:, -1], off.y_m[:, -1]
        ahead_m, left_m = np.cos(yaw) * x_m + np.sin(yaw) * y_m, np.cos(yaw) * y_m - np.sin(yaw) * x_m
        action = windows.action[:, WARM_UP_STEPS:]
        steering_deg, speed_mps = np.degrees(action[..., 1].mean(axis=1)), action[..., 0].mean(axis=1)
        time_s = np.arange(1, windows.steps + 1) * _PERIOD_S
        for band in BANDS:
            of, color = in_band(windows, band), COLOURS[band]
            if of.sum() < _LEAST:
                continue
            low, middle, high = np.quantile(off.distance_m[of], [0.25, 0.5, 0.75], axis=0)
            row[0].plot(time_s, middle, color=color, label=f"{band}: {of.sum()} windows")
            row[0].fill_between(time_s, low, high, color=color, alpha=0.15, lw=0)
            row[1].plot(left_m[of], ahead_m[of], ".", color=color, ms=2, alpha=0.5)
            _binned(row[2], steering_deg[of], left_m[of], color)
            _binned(row[3], speed_mps[of], ahead_m[of], color)
        row[0].set(xlabel="seconds", ylabel=f"version {version}: metres", ylim=(0, None))
        row[0].legend(frameon=False, fontsize=8)
        row[1].set(xlim=(-0.5, 0.5), ylim=(-0.3, 0.3), xlabel="to the left (m)", ylabel="ahead (m)")
        row[2].set(xlabel="mean steering (degrees)", ylabel="to the left (m)", ylim=(-0.3, 0.3))
        row[3].set(xlabel="mean commanded speed (m/s)", ylabel="ahead (m)", ylim=(-0.2, 0.2))
        for axis in row[1:]:
            axis.axhline(0, color=FAINT, lw=0.6)
    for axis, title in zip(axes[0], columns, strict=True):
        axis.set_title(title, fontsize=10)
    figure.tight_layout()
    return figure


def _binned(axis: plt.Axes, at: Floats, values: Floats, color: str) -> None:
    """Draw medians and the middle half of the values in bins with as many windows each."""
    edges = np.unique(np.quantile(at, np.linspace(0, 1, min(_BINS, len(at) // _LEAST) + 1)))
    number = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, max(len(edges) - 2, 0))
    points = [
        (np.median(at[number == one]), *np.quantile(values[number == one], [0.25, 0.5, 0.75]))
        for one in np.unique(number)
        if (number == one).sum() >= _LEAST // 2
    ]
    if points:
        place, low, middle, high = np.array(points).T
        axis.errorbar(
            place,
            middle,
            yerr=[middle - low, high - middle],
            fmt="o-",
            color=color,
            ms=3,
            lw=1.0,
            elinewidth=0.8,
        )
