"""The same driving paid by another reward function, in sentences, tables and figures."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pandas as pd

from .charts.figure import Chart, Panel, colored_points, line, points
from .charts.maps import map_panel
from .charts.style import BLUE, ORANGE
from .log_tables import Table, count, number
from .log_view import LogView

MOST_LAPS = 10
MOST_PLACES = 10


class Replayed(Protocol):
    """Recorded steps paid by another reward function, as `evaluation.reward_replay` returns them."""

    @property
    def reward(self) -> str:
        """Its name."""

    @property
    def laps(self) -> pd.DataFrame:
        """Complete laps, the new reward's favourites first.

        Columns: stream, track, iteration, episode, time_s, reward, new_reward, rank, new_rank, time_rank.
        """

    @property
    def correlations(self) -> pd.DataFrame:
        """A row a track: track, laps, old_new, old_time, new_time."""

    @property
    def waypoints(self) -> pd.DataFrame:
        """A row a track, direction and waypoint: reversed, closest_waypoint, visits, share, new_share."""


@dataclass(frozen=True)
class RewardComparison:
    """What a report says about another reward function."""

    sentences: tuple[str, ...]
    tables: tuple[tuple[str, Table], ...]
    """With titles."""
    charts: tuple[Chart, ...]


def compare_rewards(view: LogView, replayed: Replayed) -> RewardComparison:
    """Describe how another reward function would rank the laps and the places of a course.

    Args:
        view: the recording on one course.
        replayed: of the whole recording.
    """
    laps = replayed.laps[replayed.laps["track"].astype(str) == view.track_name]
    places = replayed.waypoints[replayed.waypoints["track"].astype(str) == view.track_name]
    # One direction: the one driven most.
    visits = places.groupby("reversed")["visits"].sum()
    if len(visits):
        places = places[places["reversed"] == visits.idxmax()]
    places = places.assign(change=places["new_share"] - places["share"])
    correlations = replayed.correlations[replayed.correlations["track"].astype(str) == view.track_name]
    tables = []
    if len(laps):
        tables.append((f"The laps that {replayed.reward} pays best", _laps_table(laps)))
    if len(places):
        tables.append(("Waypoints whose pay changes most", _places_table(places)))
    charts = [_laps_chart(laps, replayed.reward), _places_chart(view, places, replayed.reward)]
    return RewardComparison(
        tuple(_sentences(laps, correlations, places, replayed.reward)),
        tuple(tables),
        tuple(chart for chart in charts if chart is not None),
    )


def _sentences(laps: pd.DataFrame, correlations: pd.DataFrame, places: pd.DataFrame, name: str) -> list[str]:
    if not len(laps):
        found = [f"There is no complete lap that {name} could rank."]
    else:
        evaluated = ", evaluations included," if laps["stream"].nunique() > 1 else ""
        best, fastest = laps.iloc[0], laps.sort_values("time_s", kind="stable").iloc[0]
        ranks = f"{_place(best['time_rank'])} by time, {_place(best['rank'])} by the recorded reward"
        found = [
            f"Of {count(len(laps), 'complete lap')}{evaluated} {name} would have paid best the one of episode "
            f"{best['episode']} ({best['time_s']:.2f} s, {ranks}); the fastest lap ({fastest['time_s']:.2f} s) is "
            f"{_place(fastest['new_rank'])} instead of {_place(fastest['rank'])}."
        ]
    if len(correlations):
        one = correlations.iloc[0]
        found.append(
            f"Rank correlation with lap time, -1 being a reward that ranks laps by speed alone: {name} "
            f"{_rank_correlation(one['new_time'])}, recorded reward {_rank_correlation(one['old_time'])}; between both "
            f"rewards {_rank_correlation(one['old_new'])}."
        )
    if len(places):
        up, down = places.loc[places["change"].idxmax()], places.loc[places["change"].idxmin()]
        found.append(
            f"Against the other places of the track, waypoint {up['closest_waypoint']} gains most and waypoint "
            f"{down['closest_waypoint']} loses most."
        )
    return found


def _place(rank: int) -> str:
    ending = "th" if 10 <= rank % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(rank % 10, "th")
    return f"{rank}{ending}"


def _rank_correlation(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "not defined (all equal)"


def _laps_table(laps: pd.DataFrame) -> Table:
    heads = ("By the new reward", "By the recorded one", "By time", "Lap time, s", "Iteration", "Episode")
    rows = [
        (
            *(str(row[name]) for name in ("new_rank", "rank", "time_rank")),
            number(row["time_s"], ".2f"),
            *(str(row[name]) for name in ("iteration", "episode")),
            *(number(row[name], ".5g") for name in ("new_reward", "reward")),
        )
        for row in laps.head(MOST_LAPS).to_dict("records")
    ]
    return Table(
        (*heads, "New reward", "Recorded reward"), tuple(rows), left_out=max(0, len(laps) - MOST_LAPS)
    )


def _places_table(places: pd.DataFrame) -> Table:
    most = places.reindex(places["change"].abs().sort_values(ascending=False, kind="stable").index)
    rows = [
        (
            str(row["closest_waypoint"]),
            f"{row['visits']:,}",
            *(number(row[name], ".4g") for name in ("reward", "new_reward")),
            *(number(100 * row[name], ".0f") for name in ("share", "new_share")),
        )
        for row in most.head(MOST_PLACES).to_dict("records")
    ]
    heads = (
        "Waypoint",
        "Steps",
        "Recorded reward",
        "New reward",
        "Recorded, % of the range",
        "New, % of the range",
    )
    return Table(heads, tuple(rows))


def _laps_chart(laps: pd.DataFrame, name: str) -> Chart | None:
    if not len(laps):
        return None
    hover = [
        f"episode {row.episode}: {row.time_s:.2f} s\nranks {row.new_rank} new, {row.rank} recorded"
        for row in laps.itertuples()
    ]
    panels = [
        Panel(
            layers=[points(laps["time_s"], laps[column], color, size=6.5, hover=hover)],
            x_label="lap time (s)",
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
        share_x=True,
        table=laps,
    )


def _places_chart(view: LogView, places: pd.DataFrame, name: str) -> Chart | None:
    if not len(places):
        return None
    waypoint = places["closest_waypoint"].to_numpy(np.intp)
    lines = [
        line(waypoint, 100 * places[column], color, label)
        for column, color, label in (("share", ORANGE, "recorded"), ("new_share", BLUE, name))
    ]
    rows = [[Panel(layers=lines, x_label="waypoint", y_label="per cent of its range", y_range=(-4.0, 104.0))]]
    if view.course is not None and waypoint.max() < len(view.course.waypoints):
        change = 100 * places["change"]
        reach = float(change.abs().max()) or 1.0
        xy = view.course.waypoints[waypoint]
        scale = "change (% of the range)"
        spots = colored_points(xy[:, 0], xy[:, 1], change, scale, value_range=(-reach, reach), size=8.0)
        rows.append([map_panel(view.course, [spots])])
    return Chart(
        name="replayed_places",
        title="Where the new reward pays more, and where less",
        caption="Mean reward of a step at each waypoint, between the least and the most that each reward function pays "
        "anywhere (2nd and 98th percentile). The curves differ at places that the new reward considers more or less "
        "important than the recorded one does.",
        rows=rows,
        table=places,
    )
