"""Maps of the rows driven, of the ends of episodes, and of the risk of leaving the road."""

import numpy as np
import pandas as pd

from deepracer_exp.errors import count
from deepracer_exp.reports.tables.log_view import LogView, thirds
from deepracer_exp.reports.tables.off_track import PLACE_M, risk_counts
from deepracer_exp.reports.tables.statistics import count_rows, subsample, wilson
from deepracer_exp.tracks.track import Track

from .figure import Chart, Layer, band, bars, line, note, points
from .maps import Grid, map_panel, waypoint_map_panel, waypoint_panel
from .style import BLACK, BLUE, ORANGE, PALE, PURPLE, VERMILION

OUTCOMES = {
    "off_track": ("off the road", VERMILION, "x"),
    "crashed": ("crashed", PURPLE, "triangle-up"),
    "reversed": ("reversed", BLUE, "diamond"),
    "immobilized": ("stood still", BLACK, "star"),
    "time_up": ("time or steps up", ORANGE, "circle"),
}
"""Ways in which an episode ends without a lap: words, colour and symbol."""
_WORST = 5


def visits_map(view: LogView) -> Chart | None:
    """Draw the number of control steps in each cell of the course."""
    if view.course is None or not len(view.steps):
        return None
    grid = Grid.over(view.course, 10_000)
    cell = grid.of(view.steps["X"], view.steps["Y"])
    late = thirds(view.steps["iteration"].to_numpy()) == 2
    panels = []
    for title, place in (
        ("all iterations", cell),
        ("last third of the iterations", np.where(late, cell, -1)),
    ):
        steps = count_rows(place, grid.count)
        seen = np.where(steps > 0, steps, np.nan)
        # The start positions would take all colours.
        top = float(np.nanpercentile(seen, 98)) if np.isfinite(seen).any() else 1.0
        scale = f"control steps per cell of {100 * grid.side_m:.0f} cm"
        cells = grid.cells(seen, scale, value_range=(1.0, max(top, 2.0)))
        panels.append(map_panel(view.course, [cells], title))
    return Chart(
        name="visits_map",
        title="Where the car drove",
        caption="Each cell counts the control steps in which the front of the car was there; a narrow, bright band is "
        "a line driven again and again. Compare the two maps: where the last third is still as wide as the whole "
        "training, the policy still explores.",
        rows=[panels],
    )


def episode_ends_map(view: LogView) -> Chart | None:
    """Draw where episodes ended without a lap, and how many at which waypoint."""
    ends = _ends(view)
    if not len(ends):
        return None
    n = view.waypoint_count
    counted: list[Layer] = []
    placed: list[Layer] = []
    base = np.zeros(n)
    for status, (words, color, symbol) in OUTCOMES.items():
        here = ends[ends["status"] == status]
        if not len(here):
            continue
        height = count_rows(here["waypoint"].to_numpy(np.intp), n)
        counted.append(bars(np.arange(n), height, color, f"{words} ({len(here)})", base=base, width=1.0))
        base = base + height
        shown = here.iloc[subsample(len(here), 1500)]
        hover = [
            f"episode {row.episode}, iteration {row.iteration}\n"
            f"waypoint {row.waypoint}, {row.progress:.1f}% of the lap"
            for row in shown.itertuples()
        ]
        placed.append(points(shown["X"], shown["Y"], color, symbol=symbol, size=6.0, hover=hover))
    rows = [[waypoint_panel(counted, "episodes that ended here", n)]]
    if view.course is not None:
        rows.insert(0, [map_panel(view.course, [*placed, *_worst_notes(ends, view.course)])])
    of = f"{count(int(view.episodes['ended'].sum()), 'episode')}{view.traced}"
    return Chart(
        name="episode_ends_map",
        title=f"Where {len(ends)} of {of} ended before the lap was complete",
        caption=f"Each symbol is the last recorded position of an episode; the {_WORST} waypoints with most ends "
        "carry their number and count. Many ends behind a corner mean that the car enters it too fast or turns in "
        "too late.",
        rows=rows,
    )


def _ends(view: LogView) -> pd.DataFrame:
    """Return the last rows of the episodes that ended without a lap: place, waypoint, outcome, iteration."""
    last = np.flatnonzero(np.diff(view.episode_index, append=-1) != 0)
    table = view.steps.iloc[last][["X", "Y", "closest_waypoint"]].reset_index(drop=True)
    columns = view.episodes[["episode", "iteration", "progress", "status"]].reset_index(drop=True)
    table = table.rename(columns={"closest_waypoint": "waypoint"}).join(columns)
    return table[table["status"].isin(list(OUTCOMES))].reset_index(drop=True)


def _worst_notes(ends: pd.DataFrame, course: Track) -> list[Layer]:
    """Return the numbers and counts of the waypoints with most ends."""
    counts = ends.groupby("waypoint").size().sort_values(ascending=False, kind="stable")
    n = len(course.waypoints)
    chosen: list[int] = []
    for waypoint in counts.index[counts > 1]:
        # Neighbours would cover each other.
        if waypoint < n and all(min((waypoint - k) % n, (k - waypoint) % n) > n // 20 for k in chosen):
            chosen.append(int(waypoint))
    return [note(course.waypoints[k].tolist(), f"wp {k}: {counts[k]}") for k in chosen[:_WORST]]


def off_track_risk(view: LogView) -> Chart | None:
    """Draw the risk of leaving the road at each waypoint, with the counts behind it."""
    if not len(view.episodes):
        return None
    n = view.waypoint_count
    parts = view.episodes, view.episodes[thirds(view.episodes["iteration"].to_numpy()) == 2]
    off, late_off = (risk_counts(part, n)[1] for part in parts)
    if not off.any():
        return None
    # As far as the finding's places: accidents at a single waypoint are too rare.
    reach = max(1, round(PLACE_M / 2 * n / float(view.steps["track_len"].median())))
    (near_passes, near_off), (late_passes, late_near_off) = (risk_counts(part, n, reach) for part in parts)
    low, high = (100.0 * end for end in wilson(late_near_off, late_passes))
    share = 100.0 * near_off / np.where(near_passes > 0, near_passes, np.nan)
    late_share = 100.0 * late_near_off / np.where(late_passes > 0, late_passes, np.nan)
    x, before = np.arange(n), off - late_off
    risk: list[Layer] = [
        band(x, low, high, VERMILION, "95% interval (Wilson)"),
        line(x, share, PALE, "all iterations"),
        line(x, late_share, VERMILION, "last third of the iterations"),
    ]
    counts: list[Layer] = [
        bars(x, before, PALE, f"off the road before ({before.sum():.0f})", width=1.0),
        bars(x, late_off, VERMILION, f"in the last third ({late_off.sum():.0f})", base=before, width=1.0),
    ]
    label = f"risk within {PLACE_M / 2:g} m, %"
    rows = [[waypoint_panel(risk, label, n)], [waypoint_panel(counts, "episodes", n)]]
    if view.course is not None:
        hover = [
            f"waypoint {k}: {late_near_off[k]:.0f} of {late_passes[k]:.0f} passes left the road near it\n"
            f"{late_share[k]:.2f}%, 95% interval {low[k]:.2f} to {high[k]:.2f}%"
            for k in range(n)
        ]
        colors = (0.0, max(float(np.nanmax(late_share, initial=0.0)), 0.1))
        scale = f"{label}, last third"
        rows.insert(0, [waypoint_map_panel(view.course, late_share, scale, hover, colors)])
    return Chart(
        name="off_track_risk",
        title="The risk of leaving the road",
        caption=f"Of all passes of a waypoint, the share that left the road within {PLACE_M / 2:g} m of it; the shade "
        "is the range that contains the true share with 95 per cent confidence. A high risk with a narrow shade is a "
        "place to work on; a wide shade only means that few passes came this far.",
        rows=rows,
    )
