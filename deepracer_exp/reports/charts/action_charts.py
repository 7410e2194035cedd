"""The actions that the car takes, the places where it takes them, and proposed ones."""

import io
from dataclasses import dataclass

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from deepracer_exp.reports.tables.log_view import LogView, closest_waypoints, once_per_view, thirds
from deepracer_exp.reports.tables.proposed_actions import ActionProposal
from deepracer_exp.reports.tables.statistics import Values, count_rows, means
from deepracer_exp.tracks.sectors import sector_at, sectors_of

from .figure import Chart, Panel, heatmap, line
from .maps import LEAST_STEPS, Grid, map_panel, waypoint_map_panel, waypoint_panel
from .style import BLUE, FAINT, GRID, INK, ORANGE, PALE, PAPER, SPINE

STEERING_EDGES = (-0.6, -0.2, 0.2, 0.6)
"""Bounds of the classes of steering, as shares of the largest angle."""
STEERING_NAMES = ("hard right", "right", "straight", "left", "hard left")
SPEED_EDGES = (1 / 3, 2 / 3)
"""Bounds of the classes of speed, as shares of the range from the lowest to the highest."""
SPEED_NAMES = ("slow", "middle", "fast")
COLUMNS = ("X", "Y", "lap_position", "closest_waypoint", "iteration", "steer", "throttle", "action")
MOST_CLASSES = 40
"""Different actions up to which an action space counts as a list of them."""
STRAIGHT_SHARE = 0.05
"""Steering below this share of the largest angle counts as none, unless every action of the list steers more."""
TOP_SHARE = 0.99
"""Share of the highest speed from which on it counts as top speed."""
LEAST_TAKEN = 10
"""Fewest actions at a waypoint for a meaningful entropy."""
_RANGES = (
    " The action space is continuous: steering is counted in five classes (split at 0.2 and 0.6 of the largest angle) "
    "and speed in three of equal width."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class ActionClasses:
    """The actions of a recording as classes, sorted from right to left and from slow to fast."""

    rows: pd.DataFrame
    """`COLUMNS` of the driven rows."""
    number: NDArray[np.intp]
    """Class of each row (n,); -1 where no action is logged."""
    names: tuple[str, ...]
    steering_deg: Values
    """Steering angle of each class, positive to the left; the mean of its rows if it is a range."""
    continuous: bool
    """Whether classes are ranges of a continuous action space."""


@once_per_view
def action_classes(view: LogView) -> ActionClasses | None:
    """Sort the training's actions into classes; None if none is logged."""
    return classify(view.driven(*COLUMNS))


def classify(rows: pd.DataFrame) -> ActionClasses | None:
    """Sort the actions of rows with `COLUMNS` into classes; None if none is logged."""
    steer, speed = rows["steer"].to_numpy(np.float64), rows["throttle"].to_numpy(np.float64)
    logged = np.isfinite(steer) & np.isfinite(speed)
    if not logged.any():
        return None
    action = rows["action"].to_numpy(np.float64)
    numbered = np.isfinite(action[logged]).all()
    listed = pd.unique(action[logged]) if numbered else action[:0]
    continuous = not numbered or len(listed) > MOST_CLASSES
    if continuous:
        key = _ranges(steer, speed)
        listed = np.flatnonzero(count_rows(np.where(logged, key, -1), int(key.max()) + 1))
        place = np.zeros(int(key.max()) + 1, np.intp)
        place[listed] = np.arange(len(listed))
        code = np.where(logged, place[key], -1)
    else:
        listed = np.sort(listed)
        code = np.where(logged, np.searchsorted(listed, action), -1)
    groups = pd.DataFrame(
        {name: means(code, values, len(listed)) for name, values in (("steer", steer), ("speed", speed))},
        index=listed,
    )
    if continuous:
        both = [f"{side}, {pace}" for side in STEERING_NAMES for pace in SPEED_NAMES]
        names = [both[int(k)] for k in groups.index]
    else:
        # Rounded, because two actions may differ by less than the precision of the log.
        groups = groups.sort_values(
            ["steer", "speed"], key=lambda column: column.round(1 + (column.name != "steer") * 2)
        )
        names = [f"{_angle(group.steer)} {group.speed:.2g} m/s" for group in groups.itertuples()]
    return ActionClasses(
        rows=rows,
        number=np.append(groups.index.get_indexer(listed), -1)[code],
        names=tuple(names),
        steering_deg=groups["steer"].to_numpy(),
        continuous=continuous,
    )


def _ranges(steer: Values, speed: Values) -> NDArray[np.intp]:
    low, high = np.nanmin(speed), np.nanmax(speed)
    share, pace = steer / max(np.nanmax(np.abs(steer)), 1e-9), (speed - low) / max(high - low, 1e-9)
    # Few edges are counted in less time than each value is searched among them.
    number = np.zeros(len(steer), np.int8)
    for edge in STEERING_EDGES:
        number += share >= edge
    number *= len(SPEED_NAMES)
    for edge in SPEED_EDGES:
        number += pace >= edge
    return number.astype(np.intp)


def _angle(steering_deg: float) -> str:
    side = "left" if steering_deg > 0 else "right"
    return "straight" if abs(steering_deg) < 0.05 else f"{side} {abs(steering_deg):.3g}°"


def action_use_by_section(view: LogView) -> Chart | None:
    """Draw the share of each action in each section of the course, in the last third of the iterations."""
    actions = action_classes(view)
    if actions is None or view.course is None:
        return None
    sectors = sectors_of(view.course)
    sections = [part.name for part in sectors]
    late = thirds(actions.rows["iteration"].to_numpy()) == 2
    section = sector_at(sectors, actions.rows["lap_position"].to_numpy(np.float64))
    n, m = len(sections), len(actions.names)
    counted = (actions.number >= 0) & (section >= 0) & late
    counts = count_rows(np.where(counted, actions.number * n + section, -1), n * m).reshape(m, n)
    # From left to right, as on the road seen from above.
    share, names = 100.0 * (counts / np.maximum(counts.sum(axis=0), 1.0))[::-1], actions.names[::-1]
    top = float(np.ceil(max(share.max(), 1.0)))
    scale = "% of the section's steps"
    cells = heatmap(
        np.arange(n), np.arange(m), share.round(1), scale, written=n <= 20, value_range=(0.0, top)
    )
    return Chart(
        name="action_use_by_section",
        title="Actions taken in each section of the course",
        caption="Of all steps in a section, the share of each action in the last third of the iterations; sections "
        "are split where the curvature of the centre line changes. An action that is dark everywhere could be removed "
        "from the action space." + _RANGES * actions.continuous,
        rows=[
            [Panel(layers=[cells], x_label="section, in driving direction", x_names=sections, y_names=names)]
        ],
    )


def zero_steering_top_speed(view: LogView) -> Chart | None:
    """Draw where the car drives straight ahead, where at top speed, and where both."""
    actions = action_classes(view)
    if actions is None or view.course is None:
        return None
    rows = actions.rows[thirds(actions.rows["iteration"].to_numpy()) == 2]
    steer = np.abs(rows["steer"].to_numpy(np.float64))
    speed = rows["throttle"].to_numpy(np.float64)
    least = STRAIGHT_SHARE * float(np.nanmax(steer))
    if not actions.continuous:
        least = max(least, float(np.abs(actions.steering_deg).min()) + 1e-6)
    fastest = float(np.nanmax(speed))
    straight, top = steer <= least, speed >= TOP_SHARE * fastest
    grid = Grid.over(view.course, 6_500)
    where = grid.of(rows["X"], rows["Y"])
    panels = []
    for name, flag in (
        (f"steering at most {least:.2g}°", straight),
        (f"top speed, {fastest:.2g} m/s", top),
        ("both", straight & top),
    ):
        share = 100.0 * means(where, flag, grid.count, LEAST_STEPS)
        finite = share[np.isfinite(share)]
        highest = max(float(np.percentile(finite, 98)), 1.0) if len(finite) else 100.0
        cells = grid.cells(share, "% of steps", value_range=(0.0, highest))
        title = f"{name}: {100.0 * flag.mean():.0f}% of all"
        panels.append(map_panel(view.course, [cells], title, numbers=False))
    return Chart(
        name="zero_steering_top_speed",
        title="Where the car drives straight ahead, and where at top speed",
        caption="The share of steps in each cell, in the last third of the iterations. On straights of the road that "
        "stay dark on the last map the car weaves or does not use its speed.",
        rows=[panels],
    )


def entropy_along_track(view: LogView) -> Chart | None:
    """Draw the entropy of the actions taken at each waypoint."""
    actions = action_classes(view)
    if actions is None or len(actions.names) < 2:
        return None
    n, m = view.waypoint_count, len(actions.names)
    third = thirds(actions.rows["iteration"].to_numpy())
    waypoint = closest_waypoints(actions.rows)
    first, last = (_action_entropy(actions, np.where(third == k, waypoint, -1), n) for k in (0, 2))
    if not np.isfinite(last).any():
        return None
    most, waypoints = float(np.log(m)), np.arange(n)
    alike = f"all {m} actions equally often, ln {m} = {most:.2f}"
    lines = [
        line(waypoints, first, PALE, "first third of the iterations"),
        line(waypoints, last, BLUE, "last third", width=2.5),
        line(waypoints, np.full(n, most), ORANGE, alike, dashed=True),
    ]
    rows = [[waypoint_panel(lines, "entropy, nats", n, y_range=(0.0, 1.08 * most))]]
    if view.course is not None:
        hover = [f"waypoint {k}: {value:.2f} nats" for k, value in enumerate(last)]
        rows.insert(0, [waypoint_map_panel(view.course, last, "entropy in the last third, nats", hover)])
    return Chart(
        name="entropy_along_track",
        title="Where the policy is sure of its actions",
        caption="Entropy of all actions taken around each waypoint, by all cars that passed there: low where they do "
        "the same. It mixes many situations, so it is above the policy's own entropy; what matters is where it falls "
        "from the first third to the last and where it does not." + _RANGES * actions.continuous,
        rows=rows,
    )


def _action_entropy(actions: ActionClasses, place: NDArray[np.intp], n: int) -> Values:
    """Return the entropy (nats) of the actions at each of n places; NaN where fewer than `LEAST_TAKEN` were taken."""
    m = len(actions.names)
    both = np.where((actions.number >= 0) & (place >= 0), place * m + actions.number, -1)
    counts = count_rows(both, n * m).reshape(n, m)
    total = counts.sum(axis=1, keepdims=True)
    share = counts / np.maximum(total, 1.0)
    entropy = -(share * np.log(np.where(share > 0, share, 1.0))).sum(axis=1)
    return np.where(total[:, 0] >= LEAST_TAKEN, entropy, np.nan)


_COLORS = [*matplotlib.color_sequences["tab20"][::2], *matplotlib.color_sequences["tab20"][1::2]]
_SMALLEST, _LARGEST = 40.0, 900.0
"""Areas of an action that is nearest to no command, and to all of them, in square points."""


def proposed_actions_picture(title: str, proposal: ActionProposal) -> bytes:
    """Draw the commands of the laps and the chosen actions, larger the more commands they stand for; return a PNG."""
    listed, shares = np.array(proposal.actions), proposal.shares
    colors = np.array([_COLORS[number % len(_COLORS)] for number in range(len(listed))])
    commands = proposal.commands
    figure = Figure((9.0, 5.4), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.scatter(
        commands.steering_deg,
        commands.speed_mps,
        s=9,
        color=colors[proposal.nearest],
        alpha=0.45,
        linewidth=0,
        zorder=2,
    )
    area = _SMALLEST + (_LARGEST - _SMALLEST) * shares
    for rescue, marker, label in (
        (False, "o", "chosen: centre of a cluster of commands"),
        (True, "s", "added to recover with"),
    ):
        chosen = np.array(proposal.to_recover) == rescue
        axes.scatter(
            listed[chosen, 0],
            listed[chosen, 1],
            s=area[chosen],
            marker=marker,
            color=colors[chosen],
            edgecolor=INK,
            linewidth=1.4,
            clip_on=False,
            zorder=3,
        )
        axes.scatter([], [], s=70, marker=marker, color=PAPER, edgecolor=INK, label=label)
    for number, (steering_deg, speed_mps) in enumerate(listed):
        axes.annotate(
            str(number),
            (steering_deg, speed_mps),
            (0, 4 + np.sqrt(area[number]) / 2),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            color=INK,
        )
    axes.scatter([], [], s=9, color=FAINT, label="commands of the laps")
    figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=9, labelcolor=INK)
    axes.set_title(title, loc="left", fontsize=13, fontweight="bold", color=INK, pad=14)
    # Left is on the left.
    axes.invert_xaxis()
    axes.xaxis.set_major_formatter(lambda x, _: f"{abs(x):g}")
    axes.set_xlabel("left  ←  steering, degrees  →  right", color=FAINT)
    axes.set_ylabel("speed, m/s", color=FAINT)
    axes.margins(0.05, 0.12)
    axes.set_axisbelow(True)
    axes.grid(color=GRID)
    axes.tick_params(length=0, labelcolor=FAINT)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(SPINE)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()
