"""Lap times: how they are distributed, when they were driven, what they go with, and two laps side by side."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.stats import norm

from . import sectors
from .candidates import candidates_of
from .chart import (
    BLUE,
    FAINT,
    GREEN,
    ORANGE,
    PALE,
    SKY,
    VERMILION,
    Bars,
    Chart,
    Layer,
    Line,
    Mark,
    Panel,
    Points,
    Values,
    thinned,
)
from .charts_of_training import ITERATION
from .log_view import LogView
from .statistics import histogram

LUCK = {-2: float(norm.cdf(-2)), -3: float(norm.cdf(-3))}
"""Chance of a value so many standard deviations below the mean of a normal distribution: 2.275 and 0.135 per cent."""
_SMOOTHED = 5
"""Control steps in the mean of speed and steering along a lap."""
_ENOUGH = 20
"""Laps from which on those of the last third of the iterations are drawn on their own."""


def lap_time_histogram(view: LogView) -> Chart | None:
    """Draw the lap times of all complete laps, with how lucky one must be for a fast one."""
    laps = view.episodes[view.episodes["lap_time_s"].notna()]
    if not len(laps):
        return None
    late = laps[laps["iteration"] >= np.ceil(2 / 3 * view.iterations["iteration"].max())]
    parts = {"All complete laps": laps}
    if len(laps) > len(late) >= _ENOUGH:
        parts["Of the last third of the iterations"] = late
    panels = [
        _histogram_panel(title, part["lap_time_s"].to_numpy(np.float64)) for title, part in parts.items()
    ]
    last = list(parts.values())[-1]["lap_time_s"].to_numpy(np.float64)
    return Chart(
        name="lap_time_histogram",
        title="Lap times",
        caption=_luck_in_words(last, len(laps), len(parts) > 1),
        rows=[panels],
        table=laps[["iteration", "episode", "lap_time_s"]],
    )


def _histogram_panel(title: str, times_s: Values) -> Panel:
    bars = histogram(times_s)
    layers: list[Layer] = [Bars(x=bars.centers, height=bars.counts, width=bars.width, color=SKY)]
    best, mean, deviation = float(times_s.min()), float(times_s.mean()), _deviation(times_s)
    marks = [
        Mark(at=mean, label=f"mean {mean:.2f} s", color=BLUE),
        Mark(at=best, label=f"best {best:.2f} s", color=GREEN),
    ]
    if deviation > 0:
        span = np.linspace(min(best, mean - 3.5 * deviation), mean + 3.5 * deviation, 120)
        expected = len(times_s) * bars.width * norm.pdf(span, mean, deviation)
        layers.append(Line(x=span, y=expected, name="normal distribution", color=FAINT, width=1.2))
        for times, color in ((-2, ORANGE), (-3, VERMILION)):
            at = mean + times * deviation
            chance = f"{100 * LUCK[times]:.3f} %"
            marks.append(Mark(at=at, label=f"{times} sd {at:.2f} s: {chance}", color=color))
    return Panel(
        title=f"{title} ({len(times_s)})", x_label="lap time, s", y_label="laps", layers=[*layers, *marks]
    )


def _deviation(times_s: Values) -> float:
    return float(times_s.std(ddof=1)) if len(times_s) > 2 else 0.0


def _luck_in_words(times_s: Values, count: int, late: bool) -> str:
    deviation = _deviation(times_s)
    which = f"the {len(times_s)} of the last third of the iterations" if late else f"the {count}"
    if not deviation:
        return f"There are only {count} complete laps: too few to speak of chances."
    bound = float(times_s.mean()) - 2 * deviation
    measured = 100 * float((times_s <= bound).mean())
    return (
        f"One lap in 44 of a normal distribution is two standard deviations faster than the mean, one in 740 three. "
        f"Of {which} complete laps {measured:.2g} per cent are below {bound:.2f} s, where 2.275 per cent were expected."
    )


def lap_time_percentile(view: LogView) -> Chart | None:
    """Draw the 25th percentile of the lap times of each iteration, with the candidates for submission."""
    table = view.iterations[view.iterations["lap_time_p25_s"].notna()]
    if not len(table):
        return None
    laps = view.episodes[view.episodes["lap_time_s"].notna()]
    shown = laps.iloc[thinned(len(laps), 2500)]
    x, y = (table[name].to_numpy(np.float64) for name in ("iteration", "lap_time_p25_s"))
    share = 100 * table["lap_share"].to_numpy(np.float64)
    best = candidates_of(view)
    layers: list[Layer] = [
        Points(
            x=shown["iteration"].to_numpy(np.float64),
            y=shown["lap_time_s"].to_numpy(np.float64),
            name="a lap",
            color=PALE,
            size=2.5,
        ),
        Points(
            x=best["iteration"].to_numpy(np.float64),
            y=best["lap_time_p25_s"].to_numpy(np.float64),
            name="candidate for submission" if len(best) else None,
            color=VERMILION,
            symbol="star",
            size=18,
        ),
        Points(
            x=x,
            y=y,
            color=BLUE,
            values=share,
            value_range=(0.0, max(float(share.max()), 1.0)),
            scale="complete laps, per cent of the episodes",
            size=6.5,
            hover=[
                f"iteration {number}: 25th percentile {usual:.2f} s, best {fastest:.2f} s, "
                f"{complete} of {episodes} episodes are complete laps"
                for number, usual, fastest, complete, episodes in zip(
                    table["iteration"],
                    y,
                    table["lap_time_best_s"],
                    table["complete"],
                    table["episodes"],
                    strict=True,
                )
            ],
        ),
    ]
    names = ", ".join(str(number) for number in best["iteration"])
    told = (
        f"Candidates for submission, the best first: iteration{'s' * (len(best) > 1)} {names}."
        if names
        else "No iteration has laps enough to be submitted."
    )
    # The laps of an iteration may stand in metrics files only.
    times_s = np.concatenate([shown["lap_time_s"].to_numpy(np.float64), y])
    low, high = float(times_s.min()), float(np.percentile(times_s, 99))
    rim = 0.06 * max(high - low, 0.1)
    return Chart(
        name="lap_time_percentile",
        title="25th percentile of the lap time",
        caption=f"Each coloured point is an iteration: low ones are fast, bright ones come round often. {told}",
        rows=[
            [
                Panel(
                    x_label=ITERATION,
                    y_label="lap time, s",
                    layers=layers,
                    y_range=(low - rim, max(high, float(y.max())) + rim),
                )
            ]
        ],
        table=table,
    )


def lap_delta(view: LogView) -> Chart | None:
    """Draw the fastest lap beside a usual one, point by point along the course."""
    laps = view.episodes["lap_time_s"].dropna().sort_values(kind="stable")
    if len(laps) < 2:
        return None
    fastest = int(laps.index[0])
    usual = _usual_lap(view.episodes, fastest)
    delta = sectors.lap_delta(view.steps, usual, fastest)
    unit, scale = ("m", view.course.length_m) if view.course is not None else ("per cent", 100.0)
    place = scale * delta["lap_position"].to_numpy(np.float64)
    lost_s = delta["delta_s"].to_numpy(np.float64)
    parts = sectors.sectors_of(view.course).parts if view.course is not None else ()
    borders: list[Layer] = [Mark(at=scale * part.begin, label=part.name, color=PALE) for part in parts]
    behind: list[Layer] = [
        *borders,
        Mark(at=0.0, label="", color=FAINT, horizontal=True),
        Line(x=place, y=lost_s, color=VERMILION, width=2.0),
    ]
    rows = [[Panel(title="Time lost by the usual lap", y_label="s", layers=behind)]]
    kept = []
    drives = {"usual": (usual, ORANGE), "fastest": (fastest, BLUE)}
    names = {
        name: f"{name} lap, {laps[lap]:.2f} s (iteration {view.episodes.loc[lap, 'iteration']})"
        for name, (lap, _) in drives.items()
    }
    driven = {name: _along(view, lap) for name, (lap, _) in drives.items()}
    for column, title, label in (
        ("track_speed_mps", f"Speed along the track, mean of {_SMOOTHED} steps", "m/s"),
        ("steer", f"Steering commanded, to the left positive, mean of {_SMOOTHED} steps", "degrees"),
        ("offset_m", "Beside the centre line, to the left positive", "m"),
    ):
        if not np.isfinite(driven["fastest"][column]).any():
            continue
        kept.append(column)
        lines = [
            Line(
                x=scale * driven[name]["lap_position"].to_numpy(np.float64),
                y=driven[name][column].to_numpy(np.float64),
                name=names[name] if column == kept[0] else None,
                color=color,
            )
            for name, (_, color) in drives.items()
        ]
        rows.append([Panel(title=title, y_label=label, layers=lines)])
    rows[-1] = [replace(rows[-1][0], x_label=f"place on the track, {unit} from waypoint 0")]
    return Chart(
        name="lap_delta",
        title="Two laps along the track: the fastest and a usual one",
        caption=_loss_in_words(parts, delta, lost_s)
        + " A line that rises is time lost there, one that falls is time won; lines are broken where a lap began.",
        rows=rows,
        share_x=True,
        table=delta,
    )


def _usual_lap(episodes: pd.DataFrame, fastest: int) -> int:
    """Return the median lap, if there are enough of the training's end that began at the same place as the fastest."""
    others = episodes[episodes["lap_time_s"].notna()].drop(fastest)
    chosen = [others]
    # A lap from another place stands still elsewhere, which would be most of the difference.
    chosen.append(others[others["start_at"] == episodes.loc[fastest, "start_at"]])
    chosen.append(chosen[-1][chosen[-1].index >= others.index[len(others) // 2]])
    found = next(part for part in reversed(chosen) if len(part) >= 3 or part is others)
    return int(found.sort_values("lap_time_s", kind="stable").index[len(found) // 2])


def _along(view: LogView, lap: int) -> pd.DataFrame:
    """Return the rows of a lap from the start line on, with a gap where the lap began and ended."""
    number = view.episodes.loc[lap, "episode"]
    rows = view.steps[view.steps["episode"] == number]
    rows = rows[["lap_position", "track_speed_mps", "steer", "offset_m"]].reset_index(drop=True)
    for column in ("track_speed_mps", "steer"):
        rows[column] = rows[column].rolling(_SMOOTHED, center=True, min_periods=1).mean()
    first = int(rows["lap_position"].to_numpy().argmin())
    return pd.concat([rows.iloc[first:], rows.iloc[:0].reindex([0]), rows.iloc[:first]], ignore_index=True)


def _loss_in_words(parts: Sequence[sectors.Sector], delta: pd.DataFrame, lost_s: Values) -> str:
    whole = float(lost_s[-1])
    if not parts:
        return f"The usual lap is {whole:.2f} s slower."
    at = delta["lap_position"].to_numpy(np.float64)
    lost = {part.name: float(np.diff(np.interp([part.begin, part.end], at, lost_s))[0]) for part in parts}
    worst = max(lost, key=lambda name: lost[name])
    return f"The usual lap is {whole:.2f} s slower, and loses most in sector {worst}: {lost[worst]:.2f} s."
