"""Where on the course things happened: visits, ends of episodes, the risk to leave the road, waypoints."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.tracks.track import Track

from .cells import Grid, totals, wilson
from .chart import (
    BLACK,
    BLUE,
    ORANGE,
    PALE,
    PURPLE,
    VERMILION,
    Band,
    Bars,
    Chart,
    Line,
    Note,
    Panel,
    Points,
    Values,
    thinned,
)
from .log_view import LogView
from .maps import map_panel, thirds, waypoint_count

WAYPOINT = "waypoint"
OUTCOMES = {
    "off_track": ("off the road", VERMILION, "cross"),
    "crashed": ("crashed", PURPLE, "triangle"),
    "reversed": ("reversed", BLUE, "diamond"),
    "immobilized": ("stood still", BLACK, "star"),
    "time_up": ("time or steps up", ORANGE, "circle"),
}
"""Ways in which an episode ends without a lap: words, colour and symbol."""
REACH = 2
"""Waypoints to either side that count for the risk at a waypoint: accidents at a single one are too rare."""
_WORST = 5


def visits_map(view: LogView) -> Chart | None:
    """Show how many control steps were driven in each cell of the track."""
    if view.course is None or not len(view.steps):
        return None
    half = 10_000
    grid = Grid.over(view.course, half)
    where = grid.of(view.steps["X"], view.steps["Y"])
    third = thirds(view.steps["iteration"].to_numpy())
    visits = totals(where, None, grid.count)
    late = totals(np.where(third == 2, where, -1), None, grid.count)
    panels = []
    for title, count in (("all iterations", visits), ("last third of the iterations", late)):
        seen = np.where(count > 0, count, np.nan)
        # The places of starts would take all colours.
        top = float(np.nanpercentile(seen, 98)) if np.isfinite(seen).any() else 1.0
        layer = grid.cells(
            seen, f"control steps a cell of {100 * grid.side_m:.0f} cm", value_range=(1.0, max(top, 2.0))
        )
        panels.append(map_panel(view.course, [layer], title))
    return Chart(
        name="visits_map",
        title="Where the car drove",
        caption="Each cell counts the control steps in which the front of the car was there; a narrow, "
        "bright band is a line driven again and again. Compare the two maps: what is left of the "
        "wide early exploration in the last third is where the policy still tries things out.",
        rows=[panels],
        table=grid.table({"visits": np.where(visits > 0, visits, np.nan), "visits_last_third": late}),
    )


def episode_ends_map(view: LogView) -> Chart | None:
    """Show where episodes ended that did not complete the lap, and how many at which waypoint."""
    ends = _ends(view)
    if not len(ends):
        return None
    bars: list[Bars] = []
    points: list[Points] = []
    n = waypoint_count(view)
    waypoints = np.arange(n, dtype=np.float64)
    base = np.zeros(n)
    for status, (words, color, symbol) in OUTCOMES.items():
        here = ends[ends["status"] == status]
        if not len(here):
            continue
        count = totals(here["waypoint"].to_numpy(np.intp), None, n)
        name = f"{words} ({len(here)})"
        bars.append(Bars(x=waypoints, height=count, base=base.copy(), name=name, color=color, width=1.0))
        base += count
        shown = here.iloc[thinned(len(here), 1500)]
        hover = [
            f"episode {row.episode}, iteration {row.iteration}\n"
            f"waypoint {row.waypoint}, {row.progress:.1f} % of the lap"
            for row in shown.itertuples()
        ]
        points.append(
            Points(
                x=shown["X"].to_numpy(np.float64),
                y=shown["Y"].to_numpy(np.float64),
                color=color,
                symbol=symbol,
                size=4.5,
                hover=hover,
            )
        )
    rows: list[list[Panel]] = []
    if view.course is not None:
        rows.append([map_panel(view.course, [*points, *_worst_notes(ends, view.course)])])
    rows.append(
        [Panel(layers=bars, x_label=WAYPOINT, y_label="episodes that ended here", x_range=(-1.0, float(n)))]
    )
    return Chart(
        name="episode_ends_map",
        title=f"Where {len(ends)} of {int(view.episodes['ended'].sum())} episodes ended before the lap was complete",
        caption=f"Each symbol is the last recorded place of an episode; the {_WORST} waypoints with most "
        "ends carry their number and count. A pile of ends behind a corner means that the car "
        "enters it too fast or turns in too late.",
        rows=rows,
        table=ends,
    )


def off_track_risk(view: LogView) -> Chart | None:
    """Show how probable it is to leave the road at each waypoint, with the counts it rests on."""
    if not len(view.episodes):
        return None
    n = waypoint_count(view)
    late = thirds(view.episodes["iteration"].to_numpy()) == 2
    everyone = np.ones(len(late), bool)
    passes, off = risk_counts(view, everyone, n)
    late_passes, late_off = risk_counts(view, late, n)
    if not off.any():
        return None
    near_passes, near_off = risk_counts(view, everyone, n, REACH)
    late_near_passes, late_near_off = risk_counts(view, late, n, REACH)
    low, high = wilson(late_near_off, late_near_passes)
    share = 100.0 * near_off / np.where(near_passes > 0, near_passes, np.nan)
    late_share = 100.0 * late_near_off / np.where(late_near_passes > 0, late_near_passes, np.nan)
    at = np.arange(n, dtype=np.float64)
    whole = (-1.0, float(n))
    risk = Panel(
        layers=[
            Band(x=at, low=100.0 * low, high=100.0 * high, name="95 % interval (Wilson)", color=VERMILION),
            Line(x=at, y=share, name="all iterations", color=PALE, width=1.4),
            Line(x=at, y=late_share, name="last third of the iterations", color=VERMILION),
        ],
        y_label=f"risk within {REACH} waypoints, %",
        x_range=whole,
    )
    counts = Panel(
        layers=[
            Bars(
                x=at,
                height=off - late_off,
                name=f"off the road before ({off.sum() - late_off.sum():.0f})",
                color=PALE,
                width=1.0,
            ),
            Bars(
                x=at,
                height=late_off,
                base=off - late_off,
                name=f"in the last third ({late_off.sum():.0f})",
                color=VERMILION,
                width=1.0,
            ),
        ],
        x_label=WAYPOINT,
        y_label="episodes",
        x_range=whole,
    )
    rows = [[risk], [counts]]
    if view.course is not None:
        places = view.course.waypoints[:n]
        spots = Points(
            x=places[:, 0],
            y=places[:, 1],
            values=late_share[: len(places)],
            scale=f"risk within {REACH} waypoints, %, last third",
            color=VERMILION,
            size=6.5,
            hover=[
                f"waypoint {k}: {late_near_off[k]:.0f} of {late_near_passes[k]:.0f} passes left the road "
                f"near it\n{late_share[k]:.2f} %, 95 % interval {100 * low[k]:.2f} to {100 * high[k]:.2f} "
                "%"
                for k in range(len(places))
            ],
            value_range=(0.0, max(float(np.nanmax(late_share, initial=0.0)), 0.1)),
        )
        rows.insert(0, [map_panel(view.course, [spots])])
    return Chart(
        name="off_track_risk",
        title="The risk to leave the road",
        caption=f"Of all passes of a waypoint, the share that left the road within {REACH} waypoints of "
        "it; the shade is the range in which the true share lies with 95 per cent confidence. A "
        "high risk with a narrow shade is a place to work on, a wide shade only says that few "
        "passes came this far.",
        rows=rows,
        table=pd.DataFrame(
            {
                "waypoint": np.arange(n),
                "passes": passes,
                "off_track": off,
                "passes_last_third": late_passes,
                "off_track_last_third": late_off,
                "near_passes_last_third": late_near_passes,
                "near_off_track_last_third": late_near_off,
                "near_risk_last_third": late_share / 100.0,
                "low": low,
                "high": high,
            }
        ),
    )


def waypoint_map(view: LogView) -> Chart | None:
    """Show the course with its waypoints numbered."""
    if view.course is None:
        return None
    course = view.course
    x, y = course.waypoints.T
    dots = Points(
        x=x,
        y=y,
        color=BLUE,
        size=3.0,
        hover=[f"waypoint {k}: x {a:.2f}, y {b:.2f} m" for k, (a, b) in enumerate(zip(x, y, strict=True))],
    )
    tenth = np.arange(0, len(x) - course.closed, 10)
    ahead = course.start_pose(np.array([0.5 * course.width_m / course.length_m]))
    arrow = Points(x=x[tenth], y=y[tenth], color=VERMILION, size=6.0)
    begin = Note(x=float(ahead.x[0]), y=float(ahead.y[0]), text="start")
    return Chart(
        name="waypoint_map",
        title=f"{course.title}: {len(x)} waypoints, {course.length_m:.2f} m",
        caption="The numbers are those of `closest_waypoints` in a reward function and of the waypoint "
        "axes of all other figures; every tenth waypoint is marked. The car drives from low to "
        "high numbers and starts at waypoint 0.",
        rows=[[map_panel(course, [dots, arrow, begin])]],
        table=pd.DataFrame({"waypoint": np.arange(len(x)), "x_m": x, "y_m": y}),
    )


def risk_counts(view: LogView, wanted: NDArray[np.bool_], n: int, reach: int = 0) -> tuple[Values, Values]:
    """Return for each of n waypoints how many of the wanted episodes passed it, and how many left the road there.

    An episode passes every waypoint from its first row's to its last row's, also those that a control step jumped
    over; a complete lap passes all of them.

    Args:
        view: what was recorded.
        wanted: which episodes, (n,) in the order of `view.episodes`.
        n: number of waypoints.
        reach: waypoints to either side that count as well.
    """
    episodes = view.episodes[wanted]
    first, last = (episodes[name].to_numpy(np.int64) for name in ("first_waypoint", "last_waypoint"))
    progress = episodes["progress"].to_numpy(np.float64)
    ahead = (last - first) % n
    # A car that ends a little before or behind its start drove hardly anything or nearly the whole lap.
    back = (ahead > 0.75 * n) & (progress < 50.0)
    first, ahead = np.where(back, last, first), np.where(back, 0, ahead)
    whole = episodes["complete"].to_numpy(bool) | ((ahead < 0.25 * n) & (progress > 50.0))
    ahead = np.minimum(np.where(whole, n, ahead) + 2 * reach, n - 1)
    first = (first - reach) % n
    change = np.zeros(2 * n + 1)
    np.add.at(change, first, 1.0)
    np.add.at(change, first + ahead + 1, -1.0)
    passed = np.cumsum(change)[: 2 * n]
    left = np.bincount(last[(episodes["status"] == "off_track").to_numpy()], minlength=n)
    near = np.sum([np.roll(left, by) for by in range(-reach, reach + 1)], axis=0)
    return passed[:n] + passed[n:], near.astype(np.float64)


def _ends(view: LogView) -> pd.DataFrame:
    """Return the last rows of the episodes that ended without a lap: place, waypoint, outcome, iteration."""
    episode = view.steps["episode"].to_numpy()
    last = np.flatnonzero(np.diff(episode, append=-1) != 0) if len(episode) else np.zeros(0, np.intp)
    table = view.steps.iloc[last][["X", "Y", "closest_waypoint"]].reset_index(drop=True)
    table = table.rename(columns={"closest_waypoint": "waypoint"})
    for name in ("episode", "iteration", "progress", "status"):
        table[name] = view.episodes[name].to_numpy()
    return table[table["status"].isin(list(OUTCOMES))].reset_index(drop=True)


def _worst_notes(ends: pd.DataFrame, course: Track) -> list[Note]:
    """Return numbers and counts of the waypoints with most ends, on the road beside which they lie."""
    counts = ends.groupby("waypoint").size().sort_values(ascending=False, kind="stable")
    n = len(course.waypoints)
    chosen: list[int] = []
    for waypoint in counts.index[counts > 1]:
        # Neighbours would cover each other, and tell the same.
        if waypoint < n and all(min((waypoint - k) % n, (k - waypoint) % n) > n // 20 for k in chosen):
            chosen.append(int(waypoint))
    return [
        Note(x=float(course.waypoints[k, 0]), y=float(course.waypoints[k, 1]), text=f"wp {k}: {counts[k]}")
        for k in chosen[:_WORST]
    ]
