"""The same driving paid by another reward function, in sentences, a table and figures."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from deepracer_exp.errors import count

from .charts.figure import Chart, Panel, colored_points, line, points
from .charts.maps import map_panel
from .charts.style import BLUE, ORANGE
from .log_tables import Table, table_of
from .log_view import LogView

if TYPE_CHECKING:
    from deepracer_exp.evaluation.reward_replay import ReplayedRewards

MOST_LAPS = 10
_LAP_COLUMNS = {
    "new_rank": ("By the new reward", "d"),
    "rank": ("By the recorded one", "d"),
    "time_rank": ("By time", "d"),
    "time_s": ("Lap time, s", ".2f"),
    "iteration": ("Iteration", "d"),
    "episode": ("Episode", "d"),
    "new_reward": ("New reward", ".5g"),
    "reward": ("Recorded reward", ".5g"),
}


@dataclass(frozen=True)
class RewardComparison:
    """What a report says about another reward function."""

    reward: str
    """Its name."""
    sentences: tuple[str, ...]
    laps: Table
    """The laps that it pays best."""
    charts: tuple[Chart, ...]


def compare_rewards(view: LogView, replayed: "ReplayedRewards") -> RewardComparison:
    """Describe how another reward function would rank the laps and the places of a course."""
    laps, places = replayed.laps, replayed.waypoints
    if len(places):  # one direction: the one driven most
        places = places[places["reversed"] == places.groupby("reversed")["visits"].sum().idxmax()]
    places = places.assign(change=places["new_share"] - places["share"])
    charts = []
    if len(laps):
        charts.append(_laps_chart(laps, replayed.reward))
    if len(places):
        charts.append(_places_chart(view, places, replayed.reward))
    return RewardComparison(
        replayed.reward,
        tuple(_sentences(laps, replayed.correlations, places, replayed.reward)),
        table_of(laps.head(MOST_LAPS), _LAP_COLUMNS, max(0, len(laps) - MOST_LAPS)),
        tuple(charts),
    )


def _sentences(
    laps: pd.DataFrame, correlations: Mapping[str, float], places: pd.DataFrame, name: str
) -> list[str]:
    found = [f"There is no complete lap that {name} could rank."]
    if len(laps):
        evaluated = ", evaluations included," if laps["stream"].nunique() > 1 else ""
        best, fastest = laps.iloc[0], laps.loc[laps["time_s"].idxmin()]
        ranks = f"{_place(best['time_rank'])} by time, {_place(best['rank'])} by the recorded reward"
        found = [
            f"Of {count(len(laps), 'complete lap')}{evaluated} {name} would have paid most for the one of episode "
            f"{best['episode']} ({best['time_s']:.2f} s, {ranks}); the fastest lap ({fastest['time_s']:.2f} s) is "
            f"{_place(fastest['new_rank'])} instead of {_place(fastest['rank'])}."
        ]
    if correlations:
        new, old, both = (
            f"{correlations[column]:.2f}"
            if math.isfinite(correlations[column])
            else "not defined (all equal)"
            for column in ("new_time", "old_time", "old_new")
        )
        found.append(
            f"Rank correlation with lap time (-1: laps are ranked by speed alone): {name} {new}, recorded reward "
            f"{old}; between both rewards {both}."
        )
    if len(places):
        up, down = places.loc[places["change"].idxmax()], places.loc[places["change"].idxmin()]
        found.append(
            f"Compared with the other places of the track, waypoint {up['closest_waypoint']} gains most and waypoint "
            f"{down['closest_waypoint']} loses most."
        )
    return found


def _place(rank: int) -> str:
    ending = "th" if 10 <= rank % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(rank % 10, "th")
    return f"{rank}{ending}"


def _laps_chart(laps: pd.DataFrame, name: str) -> Chart:
    hover = [
        f"episode {row.episode}: {row.time_s:.2f} s\nranks {row.new_rank} new, {row.rank} recorded"
        for row in laps.itertuples()
    ]
    panels = [
        Panel(
            layers=[points(laps["time_s"], laps[column], color, size=9.0, hover=hover)],
            x_label="lap time, s",
            y_label="reward of the lap",
            title=title,
        )
        for column, color, title in (("reward", ORANGE, "recorded"), ("new_reward", BLUE, name))
    ]
    return Chart(
        name="replayed_laps",
        title="The rewards of fast laps",
        caption="Each point is a complete lap, with its lap time and the sum of its rewards. A reward that asks for "
        "speed falls from the left to the right; where slow laps are paid like fast ones, the car has no reason to "
        "be faster.",
        rows=[panels],
    )


def _places_chart(view: LogView, places: pd.DataFrame, name: str) -> Chart:
    waypoint = places["closest_waypoint"].to_numpy(np.intp)
    lines = [
        line(waypoint, 100 * places[column], color, label)
        for column, color, label in (("share", ORANGE, "recorded"), ("new_share", BLUE, name))
    ]
    rows = [[Panel(layers=lines, x_label="waypoint", y_label="per cent of its range", y_range=(-4.0, 104.0))]]
    if view.course is not None and waypoint.max() < len(view.course.waypoints):
        change = 100 * places["change"]
        reach = float(change.abs().max()) or 1.0
        x, y = view.course.waypoints[waypoint].T
        scale = "change, % of the range"
        spots = colored_points(x, y, change, scale, value_range=(-reach, reach), size=11.0)
        rows.append([map_panel(view.course, [spots])])
    return Chart(
        name="replayed_places",
        title="Where the new reward pays more, and where less",
        caption="Mean reward of a step at each waypoint, between the least and the most that each reward function pays "
        "anywhere (2nd and 98th percentile). The curves differ at places that the new reward considers more or less "
        "important than the recorded one does.",
        rows=rows,
    )
