"""What the car chose to do, and where."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .action_classes import ActionClasses, action_classes
from .cells import Grid, means, totals
from .chart import BLUE, ORANGE, PALE, Cells, Chart, Line, Panel, Points, Values
from .log_view import LogView
from .maps import LEAST_STEPS, map_panel, thirds, waypoint_count, waypoints_of
from .sectors import sectors_of

STRAIGHT_SHARE = 0.05
"""Steering below this share of the largest angle is none, where no action of the list steers less."""
TOP_SHARE = 0.99
"""Speed from this share of the highest on is top speed."""
LEAST_TAKEN = 10
"""Actions at a waypoint below which their entropy says nothing."""


def action_use_by_section(view: LogView) -> Chart | None:
    """Show how often each action is taken in each section of the course, in the last third of the iterations."""
    actions = action_classes(view)
    if actions is None or view.course is None:
        return None
    sectors = sectors_of(view.course)
    late = thirds(actions.rows["iteration"].to_numpy()) == 2
    section = sectors.of(actions.rows["lap_position"].to_numpy(np.float64))
    n, m = len(sectors.names), len(actions.names)
    place = np.where((actions.number >= 0) & late, actions.number * n + section, -1)
    counts = totals(place, None, n * m).reshape(m, n)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = 100.0 * counts / np.where(counts.sum(axis=0) > 0, counts.sum(axis=0), np.nan)
    # From left to right, as on the road seen from above.
    share, names = share[::-1], actions.names[::-1]
    table = pd.DataFrame(share, columns=list(sectors.names))
    table.insert(0, "action", names)
    cells = Cells(
        x=list(sectors.names),
        y=list(names),
        values=share.round(1).astype(np.float32),
        scale="% of the section's steps",
        written=n <= 20,
        value_range=(0.0, float(np.ceil(max(np.nanmax(share, initial=0.0), 1.0)))),
    )
    return Chart(
        name="action_use_by_section",
        title="Which actions each section of the course is driven with",
        caption="Of all steps in a section, the share of each action in the last third of the iterations; "
        "sections are split where the curvature of the centre line changes. An action that is "
        "dark everywhere is a candidate to be "
        "taken out of the action space." + _range_words(actions),
        rows=[[Panel(layers=[cells], x_label="section, in driving direction", y_label="")]],
        table=table,
    )


def zero_steering_top_speed(view: LogView) -> Chart | None:
    """Show where the car drives straight ahead, where at top speed, and where both."""
    actions = action_classes(view)
    if actions is None or view.course is None:
        return None
    rows = actions.rows[thirds(actions.rows["iteration"].to_numpy()) == 2]
    steer = np.abs(rows["steer"].to_numpy(np.float64))
    speed = rows["throttle"].to_numpy(np.float64)
    least = STRAIGHT_SHARE * float(np.nanmax(steer))
    if not actions.continuous:
        least = max(least, float(np.abs(actions.steering_deg).min()) + 1e-6)
    straight = steer <= least
    fastest = float(np.nanmax(speed))
    top = speed >= TOP_SHARE * fastest
    grid = Grid.over(view.course, 6_500)
    where = grid.of(rows["X"], rows["Y"])
    flags = {
        f"steering at most {least:.2g}°": straight,
        f"top speed, {fastest:.2g} m/s": top,
        "both": straight & top,
    }
    shares = {name: 100.0 * means(where, flag, grid.count, LEAST_STEPS) for name, flag in flags.items()}
    panels = [
        map_panel(
            view.course,
            [grid.cells(share, "% of steps", value_range=(0.0, _top(share)))],
            f"{name}: {100.0 * flags[name].mean():.0f} % of all",
            numbers=False,
        )
        for name, share in shares.items()
    ]
    return Chart(
        name="zero_steering_top_speed",
        title="Where the car goes straight ahead, and where at top speed",
        caption="The share of steps in each cell, in the last third of the iterations. Straights of the "
        "road that stay dark on the right-hand map are where the car weaves or holds back speed.",
        rows=[panels],
        table=grid.table(
            dict(zip(("straight_pct", "top_speed_pct", "both_pct"), shares.values(), strict=True))
        ),
    )


def entropy_along_track(view: LogView) -> Chart | None:
    """Show along the track how undecided the car is: the entropy of the actions it took at each waypoint."""
    actions = action_classes(view)
    if actions is None or len(actions.names) < 2:
        return None
    n = waypoint_count(view)
    third = thirds(actions.rows["iteration"].to_numpy())
    waypoint = waypoints_of(actions.rows)
    first = action_entropy(actions, np.where(third == 0, waypoint, -1), n)
    last = action_entropy(actions, np.where(third == 2, waypoint, -1), n)
    if not np.isfinite(last).any():
        return None
    most = float(np.log(len(actions.names)))
    at = np.arange(n, dtype=np.float64)
    lines = Panel(
        layers=[
            Line(x=at, y=first, name="first third of the iterations", color=PALE),
            Line(x=at, y=last, name="last third", color=BLUE, width=2.0),
            Line(
                x=at,
                y=np.full(n, most),
                name=f"all {len(actions.names)} actions alike, ln {len(actions.names)} = {most:.2f}",
                color=ORANGE,
                dashed=True,
            ),
        ],
        x_label="waypoint",
        y_label="entropy, nats",
        y_range=(0.0, 1.08 * most),
        x_range=(-1.0, float(n)),
    )
    rows = [[lines]]
    if view.course is not None:
        places = view.course.waypoints[:n]
        spots = Points(
            x=places[:, 0],
            y=places[:, 1],
            values=last[: len(places)],
            scale="entropy in the last third, nats",
            color=BLUE,
            size=6.5,
            hover=[f"waypoint {k}: {value:.2f} nats" for k, value in enumerate(last[: len(places)])],
        )
        rows.insert(0, [map_panel(view.course, [spots])])
    return Chart(
        name="entropy_along_track",
        title="Where the car is sure of what to do",
        caption="Entropy of the mix of actions taken around each waypoint, over all cars that passed "
        "there: low where all do the same. It is the mix over many situations, so at a waypoint "
        "it lies above the policy's own entropy; what counts is where it falls from the first "
        "third to the last and where it does not." + _range_words(actions),
        rows=rows,
        table=pd.DataFrame({"waypoint": np.arange(n), "first_third": first, "last_third": last}),
    )


def _top(share: Values) -> float:
    known = share[np.isfinite(share)]
    return max(float(np.percentile(known, 98)), 1.0) if len(known) else 100.0


def action_entropy(actions: ActionClasses, place: NDArray[np.intp], n: int) -> Values:
    """Return the entropy (nats) of the actions at each of n places; NaN where fewer than `LEAST_TAKEN` were taken.

    Args:
        actions: classes of all rows.
        place: of each row; -1: leave it out.
        n: number of places.
    """
    m = len(actions.names)
    counts = totals(
        np.where((actions.number >= 0) & (place >= 0), place * m + actions.number, -1), None, n * m
    )
    counts = counts.reshape(n, m)
    total = counts.sum(axis=1, keepdims=True)
    share = counts / np.maximum(total, 1.0)
    entropy = -(share * np.log(np.where(share > 0, share, 1.0))).sum(axis=1)
    return np.where(total[:, 0] >= LEAST_TAKEN, entropy, np.nan)


def _range_words(actions: ActionClasses) -> str:
    if not actions.continuous:
        return ""
    return (
        " The action space is continuous: steering counts in five classes (shares of the largest angle, "
        "split at 0.2 and 0.6) and speed in three of the same width."
    )
