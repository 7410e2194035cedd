"""Which actions the car takes, and where."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.analysis.log_view import LogView, closest_waypoints, thirds
from deepracer_exp.analysis.sectors import sectors_of
from deepracer_exp.analysis.statistics import Values, means, totals

from .figure import Chart, Layer, Panel, colored_points, heatmap, line
from .maps import LEAST_STEPS, Grid, map_panel, waypoint_panel
from .style import BLUE, ORANGE, PALE

STEERING_EDGES = (-0.6, -0.2, 0.2, 0.6)
"""Bounds of the classes of steering, as shares of the largest angle."""
STEERING_NAMES = ("hard right", "right", "straight", "left", "hard left")
SPEED_EDGES = (1 / 3, 2 / 3)
"""Bounds of the classes of speed, as shares of the range from the lowest to the highest."""
SPEED_NAMES = ("slow", "middle", "fast")
COLUMNS = ("X", "Y", "lap_position", "closest_waypoint", "iteration", "steer", "throttle", "action")
MOST_CLASSES = 40
"""With more different actions than these the action space is not a list."""
STRAIGHT_SHARE = 0.05
"""Steering below this share of the largest angle counts as none, unless every action of the list steers more."""
TOP_SHARE = 0.99
"""Share of the highest speed from which on it counts as top speed."""
LEAST_TAKEN = 10
"""Actions at a waypoint below which their entropy means nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ActionClasses:
    """The actions of a recording as classes, sorted from right to left and from slow to fast."""

    rows: pd.DataFrame
    """`COLUMNS` of the training's driven rows."""
    number: NDArray[np.intp]
    """Class of each row (n,); -1 where no action is logged."""
    names: tuple[str, ...]
    steering_deg: Values
    """Of each class, positive to the left; the mean of its rows if it is a range."""
    continuous: bool
    """Whether classes are ranges of a continuous action space."""


def action_classes(view: LogView) -> ActionClasses | None:
    """Sort the training's actions into classes; None if none is logged."""
    rows = view.driven(*COLUMNS)
    steer, speed = rows["steer"].to_numpy(np.float64), rows["throttle"].to_numpy(np.float64)
    known = np.isfinite(steer) & np.isfinite(speed)
    if not known.any():
        return None
    action = rows["action"].to_numpy(np.float64)
    listed = np.sort(pd.unique(action[known]))
    continuous = not np.isfinite(listed).all() or len(listed) > MOST_CLASSES
    if continuous:
        key, names = _ranges(steer, speed, known)
    else:
        key, names = np.searchsorted(listed, action), []
    key = np.where(known, key, -1)
    count = int(key.max()) + 1
    size = np.bincount(key[known], minlength=count)
    with np.errstate(invalid="ignore"):
        steering_deg = np.bincount(key[known], steer[known], minlength=count) / size
        speed_mps = np.bincount(key[known], speed[known], minlength=count) / size
    if not continuous:
        names = [f"{_angle(a)} {b:.2g} m/s" for a, b in zip(steering_deg, speed_mps, strict=True)]
    # Rounded, because two actions may differ by less than the precision of the log.
    order = np.arange(count) if continuous else np.lexsort([speed_mps.round(3), steering_deg.round(1)])
    order = order[size[order] > 0]
    place = np.full(count + 1, -1)
    place[order] = np.arange(len(order))
    return ActionClasses(
        rows=rows,
        number=place[key],
        names=tuple(names[k] for k in order),
        steering_deg=steering_deg[order],
        continuous=continuous,
    )


def _ranges(steer: Values, speed: Values, known: NDArray[np.bool_]) -> tuple[NDArray[np.intp], list[str]]:
    largest = max(float(np.abs(steer[known]).max()), 1e-9)
    low, high = float(speed[known].min()), float(speed[known].max())
    turn = np.digitize(steer / largest, STEERING_EDGES)
    pace = np.digitize((speed - low) / max(high - low, 1e-9), SPEED_EDGES)
    names = [f"{side}, {pace_name}" for side in STEERING_NAMES for pace_name in SPEED_NAMES]
    return turn * len(SPEED_NAMES) + pace, names


def _angle(steering_deg: float) -> str:
    if abs(steering_deg) < 0.05:
        return "straight"
    return f"{'left' if steering_deg > 0 else 'right'} {abs(steering_deg):.3g}°"


def action_use_by_section(view: LogView) -> Chart | None:
    """Draw how often each action is taken in each section of the course, in the last third of the iterations."""
    actions = action_classes(view)
    if actions is None or view.course is None:
        return None
    sectors = sectors_of(view.course)
    late = thirds(actions.rows["iteration"].to_numpy()) == 2
    section = sectors.of(actions.rows["lap_position"].to_numpy(np.float64))
    n, m = len(sectors.names), len(actions.names)
    place = np.where((actions.number >= 0) & late, actions.number * n + section, -1)
    counts = totals(place, None, n * m).reshape(m, n)
    share = 100.0 * counts / np.where(counts.sum(axis=0) > 0, counts.sum(axis=0), np.nan)
    # From left to right, as on the road seen from above.
    share, names = share[::-1], actions.names[::-1]
    table = pd.DataFrame(share, columns=list(sectors.names))
    table.insert(0, "action", names)
    top = float(np.ceil(max(np.nanmax(share, initial=0.0), 1.0)))
    cells = heatmap(
        np.arange(n),
        np.arange(m),
        share.round(1),
        "% of the section's steps",
        written=n <= 20,
        value_range=(0.0, top),
    )
    panel = Panel(
        layers=[cells], x_label="section, in driving direction", x_names=sectors.names, y_names=names
    )
    return Chart(
        name="action_use_by_section",
        title="Actions taken in each section of the course",
        caption="Of all steps in a section, the share of each action in the last third of the iterations; sections "
        "are split where the curvature of the centre line changes. An action that is dark everywhere could be removed "
        "from the action space." + _range_words(actions),
        rows=[[panel]],
        table=table,
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
    flags = {
        "straight_pct": (f"steering at most {least:.2g}°", straight),
        "top_speed_pct": (f"top speed, {fastest:.2g} m/s", top),
        "both_pct": ("both", straight & top),
    }
    panels, shares = [], {}
    for column, (name, flag) in flags.items():
        share = shares[column] = 100.0 * means(where, flag, grid.count, LEAST_STEPS)
        known = share[np.isfinite(share)]
        highest = max(float(np.percentile(known, 98)), 1.0) if len(known) else 100.0
        cells = grid.cells(share, "% of steps", value_range=(0.0, highest))
        panels.append(
            map_panel(view.course, [cells], f"{name}: {100.0 * flag.mean():.0f} % of all", numbers=False)
        )
    return Chart(
        name="zero_steering_top_speed",
        title="Where the car drives straight ahead, and where at top speed",
        caption="The share of steps in each cell, in the last third of the iterations. On straights of the road that "
        "stay dark on the last map the car weaves or does not use its speed.",
        rows=[panels],
        table=grid.table(shares),
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
    most, at = float(np.log(m)), np.arange(n)
    alike = f"all {m} actions equally often, ln {m} = {most:.2f}"
    lines: list[Layer] = [
        line(at, first, PALE, "first third of the iterations"),
        line(at, last, BLUE, "last third", width=2.0),
        line(at, np.full(n, most), ORANGE, alike, dashed=True),
    ]
    rows = [[waypoint_panel(lines, "entropy, nats", n, y_range=(0.0, 1.08 * most))]]
    if view.course is not None:
        places = view.course.waypoints[:n]
        values = last[: len(places)]
        hover = [f"waypoint {k}: {value:.2f} nats" for k, value in enumerate(values)]
        spots = colored_points(
            places[:, 0], places[:, 1], values, "entropy in the last third, nats", size=6.5, hover=hover
        )
        rows.insert(0, [map_panel(view.course, [spots])])
    return Chart(
        name="entropy_along_track",
        title="Where the policy is sure of its actions",
        caption="Entropy of all actions taken around each waypoint, by all cars that passed there: low where they do "
        "the same. It mixes many situations, so it is above the policy's own entropy; what matters is where it falls "
        "from the first third to the last and where it does not." + _range_words(actions),
        rows=rows,
        table=pd.DataFrame({"waypoint": at, "first_third": first, "last_third": last}),
    )


def _action_entropy(actions: ActionClasses, place: NDArray[np.intp], n: int) -> Values:
    """Return the entropy (nats) of the actions at each of n places; NaN where fewer than `LEAST_TAKEN` were taken.

    Args:
        actions: classes of all rows.
        place: of each row; -1: leave it out.
        n: number of places.
    """
    m = len(actions.names)
    both = np.where((actions.number >= 0) & (place >= 0), place * m + actions.number, -1)
    counts = totals(both, None, n * m).reshape(n, m)
    total = counts.sum(axis=1, keepdims=True)
    share = counts / np.maximum(total, 1.0)
    entropy = -(share * np.log(np.where(share > 0, share, 1.0))).sum(axis=1)
    return np.where(total[:, 0] >= LEAST_TAKEN, entropy, np.nan)


def _range_words(actions: ActionClasses) -> str:
    if not actions.continuous:
        return ""
    return (
        " The action space is continuous: steering is counted in five classes (split at 0.2 and 0.6 of the largest "
        "angle) and speed in three of equal width."
    )
