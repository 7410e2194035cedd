"""The figures of docs/fidelity.md: the recorded and the simulated car, sent the same actions."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray

from benchmarks.calibrate import FIT_STEPS, REPORT_STEPS, held_out
from benchmarks.replay import WARM_UP_STEPS, Windows, cut_windows, replay
from deepracer_exp.config.car import CarConfig

Floats = NDArray[np.float64]
RECORDED, SIMULATED, FAINT = "#d9822b", "#2f6fb5", "#7b828c"
LEAST = 15
"""A median of fewer rows is not drawn."""


def draw(car: CarConfig, recorded: pd.DataFrame, folder: Path) -> list[Path]:
    """Draw all figures into the folder and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    windows = cut_windows(recorded, car.front_point_m, REPORT_STEPS)
    windows = windows.choose(held_out(windows.iteration))
    motions = {"recorded": Motion(windows.start, windows.truth, windows, car.control_period_s)}
    motions["simulated"] = Motion(
        windows.start, replay(car, windows, threads=0), windows, car.control_period_s
    )
    figures = {
        "fidelity_laps.png": _laps(car, recorded),
        "fidelity_steady.png": _steady(motions),
        "fidelity_lags.png": _lags(motions, car.control_period_s),
    }
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=110, bbox_inches="tight")
        plt.close(figure)
    return [folder / name for name in figures]


class Motion:
    """What poses after each step tell of speed and curvature, with how long the action had been held."""

    def __init__(self, start: Floats, after: Floats, windows: Windows, period_s: float) -> None:
        """Take starts, (M, 3), and poses after each step, (M, S, 3)."""
        pose = np.concatenate([start[:, None], after], axis=1)
        moved = np.diff(pose, axis=1)
        turned = np.remainder(moved[..., 2] + np.pi, 2.0 * np.pi) - np.pi
        distance = np.hypot(moved[..., 0], moved[..., 1])
        self.speed_mps: Floats = distance / period_s
        self.rate_radps: Floats = turned / period_s
        action = windows.action
        self.commanded_mps, self.steering_deg = (
            action[:, WARM_UP_STEPS:, 0],
            np.degrees(action[:, WARM_UP_STEPS:, 1]),
        )
        self.speed_held, self.steering_held = (_held(action[..., i])[:, WARM_UP_STEPS:] for i in (0, 1))
        self.standing = windows.standing

    def curvature(self, of: NDArray[np.bool_]) -> Floats:
        """Return the curvature in 1/m, left positive, of the chosen rows."""
        curvature: Floats = self.rate_radps[of] / np.maximum(self.speed_mps[of], 0.05)
        return curvature


def _held(action: Floats) -> NDArray[np.int64]:
    """For how many steps, this one included, an action, (M, S), has been the same."""
    held = np.ones(action.shape, np.int64)
    for step in range(1, action.shape[1]):
        held[:, step] = np.where(action[:, step] == action[:, step - 1], held[:, step - 1] + 1, 1)
    return held


def _laps(car: CarConfig, recorded: pd.DataFrame) -> plt.Figure:
    """Draw the fastest laps of the last three held-out iterations, the simulated car put back every three seconds."""
    held = recorded[held_out(recorded["iteration"].to_numpy())]
    of = ["stream", "worker", "iteration", "episode"]
    episodes = held.groupby(of, sort=False, observed=True)
    laps = episodes.agg(rows=("steps", "size"), progress=("progress", "max")).reset_index()
    # Complete laps before others, then the shortest.
    laps = laps.sort_values(["progress", "rows"], ascending=[False, True]).drop_duplicates("iteration")
    laps = laps.sort_values("iteration").tail(3)
    figure, axes = plt.subplots(1, len(laps), figsize=(4.6 * len(laps), 3.6), squeeze=False)
    for axis, (_, lap) in zip(axes[0], laps.iterrows(), strict=True):
        rows = held[(held[of] == list(lap[of])).all(axis=1)]
        yaw = np.radians(rows["yaw"])
        origin = [rows[c] - car.front_point_m * turn(yaw) for c, turn in (("X", np.cos), ("Y", np.sin))]
        axis.plot(*origin, color=RECORDED, lw=2.6)
        # With the end of the episode before, which tells how the wheels stand at the start.
        begins = int(recorded.index.get_loc(rows.index[0]))
        known = recorded.iloc[max(0, begins - WARM_UP_STEPS) : begins + len(rows)]
        # The first row is the prepare step. A rest shorter than a third of a piece is not drawn.
        for begin in range(1, len(rows) - FIT_STEPS, REPORT_STEPS):
            steps = min(REPORT_STEPS, len(rows) - 1 - begin)
            windows = cut_windows(known, car.front_point_m, steps)
            piece = windows.choose(np.array([(begin - 1) // WARM_UP_STEPS]))
            path = np.vstack([piece.start, replay(car, piece)[0]])
            axis.plot(*path[:, :2].T, color=SIMULATED, lw=1.4)
            axis.plot(*path[0, :2], "o", color=SIMULATED, ms=4)
        axis.set_aspect("equal")
        axis.set_title(f"iteration {lap['iteration']}, episode {lap['episode']}", fontsize=10)
        axis.set_xlabel("x (m)")
    axes[0][0].set_ylabel("y (m)")
    names = (("recorded", RECORDED), ("simulated, put back onto the recording every 3 s (dots)", SIMULATED))
    lines = [axes[0][0].plot([], [], color=color, lw=2, label=name)[0] for name, color in names]
    figure.legend(handles=lines, frameon=False, fontsize=9, loc="lower center", ncols=2)
    figure.tight_layout(rect=(0, 0.07, 1, 1))
    return figure


def _steady(motions: dict[str, Motion]) -> plt.Figure:
    """Draw how a commanded speed is reached, and curvature by steering and by speed."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12.5, 3.6))
    angles = (-30, -20, -10, 0, 10, 20, 30)
    bins = np.arange(0.3, 2.2, 0.2)
    for (name, motion), color in zip(motions.items(), (RECORDED, SIMULATED), strict=True):
        for speed, style in ((2.0, "-"), (1.0, "--")):
            points = []
            for steps in range(1, 21):
                of = (np.abs(motion.commanded_mps - speed) < 0.05) & (motion.speed_held == steps)
                if (q := _quartiles(motion.speed_mps[of])) is not None:
                    points.append((steps, q[1]))
            left.plot(*np.array(points).reshape(-1, 2).T, style, color=color, lw=1.8)
        shift = 0.02 if name == "simulated" else -0.02
        turning = [
            (a, q)
            for a in angles
            if (
                q := _quartiles(
                    motion.curvature((np.abs(motion.steering_deg - a) < 1) & (motion.steering_held >= 6))
                )
            )
            is not None
        ]
        _bars(middle, [a + 15 * shift for a, _ in turning], [q for _, q in turning], color, "o-")
        full = (np.abs(motion.steering_deg) > 29) & (motion.steering_held >= 6)
        by_speed = []
        for low in bins:
            inside = full & (motion.speed_mps >= low) & (motion.speed_mps < low + 0.2)
            q = _quartiles(np.sign(motion.steering_deg[inside]) * motion.curvature(inside))
            if q is not None:
                by_speed.append((low + 0.1, q))
        _bars(right, [s + 0.5 * shift for s, _ in by_speed], [q for _, q in by_speed], color, "o-")
    for speed, style in ((2, "-"), (1, "--")):
        left.axhline(speed, color=FAINT, lw=0.6, ls=":")
        left.plot([], [], style, color=FAINT, label=f"commanded {speed} m/s")
    left.set(xlabel="steps for which the speed has been commanded", ylabel="speed (m/s)", title="median")
    middle.axhline(0, color=FAINT, lw=0.6)
    middle.set(
        xlabel="steering (degrees)", ylabel="curvature (1/m)", title="steering held for 6 steps or more"
    )
    right.set(xlabel="speed (m/s)", ylabel="curvature (1/m)", title="30 degrees held for 6 steps or more")
    right.set_ylim(bottom=0)
    left.legend(frameon=False, fontsize=9)
    _legend(middle, [("recorded", RECORDED), ("simulated", SIMULATED)])
    for axis in (left, middle, right):
        axis.title.set_fontsize(10)
    figure.tight_layout()
    return figure


def _lags(motions: dict[str, Motion], period_s: float) -> plt.Figure:
    """Draw the speed after a standing start, and curvature as steering is held."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.6))
    for motion, color in zip(motions.values(), (RECORDED, SIMULATED), strict=True):
        starts = motion.speed_mps[motion.standing][:, :25]
        time = (np.arange(starts.shape[1]) + 0.5) * period_s
        low, mid, high = np.quantile(starts, [0.25, 0.5, 0.75], axis=0)
        left.plot(time, mid, color=color, lw=1.8)
        left.fill_between(time, low, high, color=color, alpha=0.15, lw=0)
        for angle, style in ((30, "-"), (20, "--"), (10, ":")):
            points = []
            for steps in range(1, 13):
                of = (np.abs(np.abs(motion.steering_deg) - angle) < 1) & (motion.steering_held == steps)
                q = _quartiles(np.sign(motion.steering_deg[of]) * motion.curvature(of))
                if q is not None:
                    points.append((steps, q[1]))
            right.plot(*np.array(points).reshape(-1, 2).T, style, color=color, lw=1.8)
    left.set(xlabel="seconds after a standing start", ylabel="speed (m/s)", title="median and middle half")
    left.set_ylim(bottom=0)
    right.set(
        xlabel="steps for which the steering has been held",
        ylabel="curvature (1/m)",
        title="towards the steered side, median",
    )
    _legend(left, [("recorded", RECORDED), ("simulated", SIMULATED)])
    for angle, style in ((30, "-"), (20, "--"), (10, ":")):
        right.plot([], [], style, color=FAINT, label=f"{angle} degrees")
    right.legend(frameon=False, fontsize=9)
    for axis in (left, right):
        axis.title.set_fontsize(10)
    figure.tight_layout()
    return figure


def _quartiles(values: Floats) -> Floats | None:
    return np.quantile(values, [0.25, 0.5, 0.75]) if len(values) >= LEAST else None


def _bars(axis: Axes, at: list[float], quartiles: list[Floats], color: str, style: str) -> None:
    """Draw medians with bars over the middle half."""
    if at:
        low, mid, high = np.array(quartiles).T
        axis.errorbar(
            at, mid, yerr=[mid - low, high - mid], fmt=style, color=color, ms=4, lw=1.2, elinewidth=0.9
        )


def _legend(axis: Axes, entries: list[tuple[str, str]]) -> None:
    lines = [axis.plot([], [], color=color, lw=2, label=name)[0] for name, color in entries]
    axis.legend(handles=lines, frameon=False, fontsize=9)
