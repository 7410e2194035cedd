"""The reward map: rewards sampled over the track and by offset, heading, speed and command, and their picture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.env.action_space import DiscreteActions
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import BadInput, writing
from deepracer_exp.tracks.drawing import area_patch
from deepracer_exp.tracks.outline import Outline, rings_of

from .objects import object_outlines
from .probe import Probe
from .situations import OFF_ROAD_M, middle_speed_mps, poses, sample, situations

Floats = NDArray[np.float64]
State = Literal["none", "earlier calls", "randomness"]
HEADINGS_DEG = 180.0
_PLACES, _HEADINGS, _OFFSETS, _SPEEDS, _STEERINGS = 10, 25, 25, 13, 13
BESIDE_M = 0.3
"""Width of the ground shown beside the track."""
_PIXELS = 16_000
"""Points of the track sampled at detail 1."""
INK, FAINT, GROUND = "#22262b", "#7b828c", "#ffffff"
PAY = LinearSegmentedColormap.from_list("pay", ["#1f2a44", "#2f5d8c", "#37a08f", "#a8cf5a", "#fff3a3"])
"""Colours where no reward is negative."""
TAKE_AND_PAY = LinearSegmentedColormap.from_list(
    "take_and_pay", ["#7a1f3d", "#c2455b", "#f0a58f", "#f4f1ec", "#9fd3b4", "#2f9273", "#0f4a4a"]
)
"""Colours from negative over zero to positive."""
_DOTS_PER_INCH = 130


@dataclass(frozen=True, eq=False)
class RewardGrid:
    """Rewards at positions spread evenly over the lap."""

    speeds_mps: Floats
    """Slowest, middle and fastest speed of the action space, (3,)."""
    headings_rad: Floats
    """Headings relative to the centre line, (H,)."""
    offsets_m: Floats
    """Offsets to the left of the centre line, in ascending order, (W,)."""
    reward: Floats
    """Rewards by speed, position, heading and offset, (3, P, H, W)."""
    off_track: NDArray[np.bool_]
    """Whether the car is off the track, in the shape of `reward`."""
    all_speeds_mps: Floats
    """(S,)"""
    steerings_deg: Floats
    """(T,)"""
    by_command: Floats
    """Driving along the centre line, mean over positions by speed and steering, (S, T)."""
    pixels: Floats
    """Driving along the track at middle speed, at points on and beside it, (Y, X); NaN elsewhere."""
    extent: tuple[float, float, float, float]
    """Left, right, lower and upper end of the pixels, m."""

    @property
    def along(self) -> int:
        """The index in `headings_rad` of driving along the track."""
        return len(self.headings_rad) // 2


def sample_reward_grid(setup: RaceSetup, state: State, detail: float) -> RewardGrid:
    """Sample the rewards over the whole track; `detail` is 1, or less for slow functions.

    A reward that depends on earlier calls is first called with the step before.
    """
    probe = Probe(setup)
    low, high = setup.actions.low, setup.actions.high

    def rewards(*pose: ArrayLike) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the rewards of `situations.poses` and whether they are off the track, both of their shape."""
        shape = np.broadcast_shapes(*map(np.shape, pose))
        where = poses(setup, *pose)
        now = situations(setup, where)
        before = situations(setup, where, earlier=True) if state == "earlier calls" else None
        return probe.rewards(now, before).reshape(shape), now.columns["is_offtrack"].reshape(shape)

    def points(n: int) -> int:
        """Return an odd number of points, so that the middle is one of them."""
        return max(5, round(n * detail)) // 2 * 2 + 1

    places = max(4, round(_PLACES * detail))
    ndist = (np.arange(places) + 0.5) / places
    speeds_mps = np.array([low[1], middle_speed_mps(setup), high[1]])
    headings_rad = np.radians(np.linspace(-HEADINGS_DEG, HEADINGS_DEG, points(_HEADINGS)))
    beyond_m = setup.track.width_m / 2 + OFF_ROAD_M
    offsets_m = np.linspace(-beyond_m, beyond_m, points(_OFFSETS))
    reward, off_track = rewards(
        ndist[:, None, None], offsets_m, headings_rad[:, None], speeds_mps[:, None, None, None]
    )
    all_speeds_mps = np.linspace(low[1], high[1], points(_SPEEDS) if high[1] > low[1] else 1)
    steerings_deg = np.linspace(low[0], high[0], points(_STEERINGS) if high[0] > low[0] else 1)
    by_command, _ = rewards(ndist[:, None, None], 0.0, 0.0, all_speeds_mps[:, None], steerings_deg)

    track = setup.track
    (left, lower), (right, upper) = Outline.of(track).corners(BESIDE_M + 0.1)
    cell_m = float(np.sqrt(track.road.buffer(BESIDE_M).area / (_PIXELS * detail**2)))
    x, y = (np.arange(a, b, cell_m) + cell_m / 2 for a, b in ((left, right), (lower, upper)))
    grid_x, grid_y = np.meshgrid(x, y)
    near = shapely.contains_xy(track.road.buffer(BESIDE_M + 1.5 * cell_m), grid_x, grid_y)
    place = track.project(np.column_stack([grid_x[near], grid_y[near]]))
    pixels = np.full(grid_x.shape, np.nan)
    pixels[near], _ = rewards(place.ndist, place.offset_m, 0.0, middle_speed_mps(setup))
    half_m = cell_m / 2
    return RewardGrid(
        speeds_mps=speeds_mps,
        headings_rad=headings_rad,
        offsets_m=offsets_m,
        reward=reward,
        off_track=off_track,
        all_speeds_mps=all_speeds_mps,
        steerings_deg=steerings_deg,
        by_command=np.nanmean(by_command, axis=0),
        pixels=pixels,
        extent=(x[0] - half_m, x[-1] + half_m, y[0] - half_m, y[-1] + half_m),
    )


def state_of(setup: RaceSetup, probe: Probe, n: int = 40) -> State:
    """Find out whether a reward depends on more than the params: on earlier calls, or on randomness.

    `probe` must not have been called before; it collects the failures.
    """
    places = sample(setup, n)
    now = situations(setup, places)
    before = situations(setup, places, earlier=True)
    alone = probe.rewards(now)
    if probe.failures:
        return "none"
    again = Probe(setup)
    if not np.array_equal(alone, again.rewards(now), equal_nan=True):
        return "randomness"
    same = np.array_equal(alone, probe.rewards(now, before), equal_nan=True)
    same = same and np.array_equal(alone, again.rewards(now, now), equal_nan=True)
    return "none" if same else "earlier calls"


def draw_reward_map(setup: RaceSetup, of: RewardGrid, state: State, path: Path) -> None:
    """Write the picture: the track coloured by the reward for driving along it, and four cuts.

    Raises:
        BadInput: the picture cannot be written.
    """
    track = setup.track
    low, high = Outline.of(track).corners(BESIDE_M + 0.1)
    colors, norm, extend = _scale(of)

    width_in, foot_in, head_in = 12.0, 3.9, 1.0
    map_in = float(np.clip(10.6 * (high - low)[1] / (high - low)[0], 2.6, 7.2))
    height_in = head_in + map_in + foot_in
    figure = Figure(figsize=(width_in, height_in), dpi=_DOTS_PER_INCH, facecolor=GROUND)
    FigureCanvasAgg(figure)
    main = figure.add_axes((0.03, foot_in / height_in, 0.87, map_in / height_in))
    main.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    main.set_axis_off()
    image = main.imshow(
        of.pixels,
        extent=of.extent,
        origin="lower",
        cmap=colors,
        norm=norm,
        interpolation="bilinear",
        zorder=1,
    )
    around = rings_of(track.road.buffer(BESIDE_M))
    image.set_clip_path(area_patch(around, transform=main.transData))
    _draw_course(main, setup)

    bar = figure.colorbar(
        ScalarMappable(norm, colors),
        cax=figure.add_axes((0.925, (foot_in + 0.12 * map_in) / height_in, 0.014, 0.7 * map_in / height_in)),
        extend=extend,
    )
    bar.outline.set_visible(False)
    bar.ax.tick_params(length=0, labelcolor=INK, labelsize=10)
    bar.ax.set_title("reward\nper step", fontsize=10, color=FAINT, loc="left", pad=10)

    _draw_cuts(figure, setup, of, colors, norm, foot_in / height_in)
    top = 1 - 0.42 / height_in
    figure.text(0.035, top, setup.reward.name, fontsize=20, fontweight="bold", color=INK, va="center")
    speed = f"{middle_speed_mps(setup):.1f} m/s"
    lines = [f"Reward on {track.title}: the map is for driving along the track at {speed}, steering straight"]
    if setup.others is not None:
        kinds = ["boxes"] * (setup.others.boxes.count > 0) + ["bots"] * (setup.others.bots.count > 0)
        lines[0] += f"; outlined: {' and '.join(kinds)} as an episode begins"
    if state == "earlier calls":
        lines.append("It depends on earlier calls: each point follows one step of driving there")
    elif state == "randomness":
        lines.append("It is partly random: another picture would look different")
    for k, line in enumerate(lines):
        down_in = 0.34 + 0.24 * k
        figure.text(0.035, top - down_in / height_in, line, fontsize=11, color=FAINT, va="center")
    with writing(f"--output {path}", "", BadInput, ValueError):  # an unknown ending
        figure.savefig(path)


def _scale(of: RewardGrid) -> tuple[Colormap, Normalize, str]:
    """Choose colours for the rewards on the track; values beyond, such as a penalty for leaving it, are clipped."""
    everything = _finite(of.reward, of.by_command, of.pixels)
    if not len(everything):
        everything = np.zeros(1)
    on_road = _finite(of.reward[~of.off_track], of.by_command)
    if not len(on_road):
        on_road = everything
    low, high = float(on_road.min()), float(on_road.max())
    if high - low < 1e-9 * max(1.0, abs(high)):
        low, high = low - 0.5, high + 0.5
    below, above = bool(everything.min() < low - 1e-9), bool(everything.max() > high + 1e-9)
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
    if low < 0 < high and -low > 0.05 * high:
        return TAKE_AND_PAY, TwoSlopeNorm(0.0, low, high), extend
    return PAY, Normalize(low, high), extend


def _finite(*rewards: np.ndarray) -> np.ndarray:
    values = np.concatenate([some.ravel() for some in rewards])
    return values[np.isfinite(values)]


def _draw_course(axes: Axes, setup: RaceSetup) -> None:
    track, outline = setup.track, Outline.of(setup.track)
    for border in outline.borders:
        axes.plot(*border.T, color=GROUND, linewidth=3.6, solid_joinstyle="round", zorder=2)
        axes.plot(*border.T, color=INK, linewidth=1.4, solid_joinstyle="round", zorder=3)
    axes.plot(*track.waypoints.T, color=INK, linewidth=0.8, dashes=(6, 6), alpha=0.6, zorder=3)
    halo = [withStroke(linewidth=5.5, foreground=GROUND)]
    axes.plot(*outline.start_line.T, color=INK, linewidth=3.0, zorder=4, path_effects=halo)
    for corners in object_outlines(setup):
        axes.add_patch(
            Polygon(corners, fill=False, edgecolor=INK, linewidth=1.6, zorder=4, path_effects=halo)
        )
    # An arrow ahead of the start line shows the driving direction.
    pose = track.start_pose(np.array([0.35, 0.9]) / track.length_m)
    tail, head = zip(pose.x.tolist(), pose.y.tolist(), strict=True)
    look = {"arrowstyle": "-|>,head_width=0.35,head_length=0.7", "color": INK, "linewidth": 2.2}
    axes.annotate("", head, tail, arrowprops={**look, "path_effects": halo}, zorder=5)


def _draw_cuts(
    figure: Figure, setup: RaceSetup, of: RewardGrid, colors: Colormap, norm: Normalize, top: float
) -> None:
    half_m = setup.track.width_m / 2
    bottom, height = 0.17 * top, 0.62 * top
    left, width, gap = 0.062, 0.19, 0.022
    for k, name in enumerate(("slow", "middle", "fast")):
        axes = figure.add_axes((left + k * (width + gap), bottom, width, height))
        mean = np.nanmean(of.reward[k], axis=0) if np.isfinite(of.reward[k]).any() else of.reward[k][0]
        _draw_cut(axes, mean, (of.offsets_m, np.degrees(of.headings_rad)), colors, norm)
        # The left side of the road is on the left.
        axes.set_xlim(*axes.get_xlim()[::-1])
        for border in (-half_m, half_m):
            axes.axvline(border, color=GROUND, linewidth=2.6)
            axes.axvline(border, color=INK, linewidth=1.2)
        axes.axhline(0.0, color=INK, linewidth=0.8, dashes=(6, 6), alpha=0.5)
        axes.set_title(f"{name}, {of.speeds_mps[k]:.1f} m/s", fontsize=11, color=INK, loc="left")
        axes.xaxis.set_major_formatter(lambda x, _: f"{abs(x):.1f}")
        if k == 1:
            axes.set_xlabel("left  ←  metres from the centre line  →  right", color=FAINT, fontsize=9)
        axes.set_yticks([-180, -90, 0, 90, 180], ["back", "90° right", "ahead", "90° left", "back"])
        if k:
            axes.set_yticklabels([])
    axes = figure.add_axes((left + 3 * (width + gap) + 0.075, bottom, width, height))
    _draw_cut(axes, of.by_command, (of.steerings_deg, of.all_speeds_mps), colors, norm)
    axes.set_xlim(*axes.get_xlim()[::-1])
    if isinstance(setup.actions, DiscreteActions):
        steering_deg, speed_mps = setup.actions.steering_deg, setup.actions.speed_mps
        dots = axes.scatter(steering_deg, speed_mps, s=26, color=INK, edgecolor=GROUND, linewidth=1.0)
        dots.set(clip_on=False, zorder=4)
    axes.set_title("by command, on the centre line", fontsize=11, color=INK, loc="left")
    axes.xaxis.set_major_formatter(lambda x, _: f"{abs(x):g}")
    axes.set_xlabel("left  ←  steering, degrees  →  right", color=FAINT, fontsize=9)
    axes.set_ylabel("speed, m/s", color=FAINT, fontsize=9)
    title = "By offset from the centre line and heading, mean over the lap"
    figure.text(0.035, top * 0.93, title, fontsize=12, fontweight="bold", color=INK, va="center")


def _draw_cut(
    axes: Axes, reward: np.ndarray, ranges: tuple[np.ndarray, np.ndarray], colors: Colormap, norm: Normalize
) -> None:
    x, y = (np.array([v[0] - 0.5, v[0] + 0.5]) if len(v) == 1 else v for v in ranges)
    step_x, step_y = (
        (x[-1] - x[0]) / max(len(ranges[0]) - 1, 1) / 2,
        (y[-1] - y[0]) / max(len(ranges[1]) - 1, 1) / 2,
    )
    axes.imshow(
        reward,
        extent=(x[0] - step_x, x[-1] + step_x, y[0] - step_y, y[-1] + step_y),
        origin="lower",
        aspect="auto",
        cmap=colors,
        norm=norm,
        interpolation="bilinear",
    )
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    axes.tick_params(length=0, labelcolor=FAINT, labelsize=9)
    axes.spines[:].set_visible(False)
