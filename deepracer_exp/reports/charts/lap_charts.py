"""Lap times: their distribution, development and correlations, and two laps side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from statistics import NormalDist

import numpy as np
import pandas as pd
from numpy.polynomial import Polynomial

from deepracer_exp.errors import count
from deepracer_exp.reports.tables.log_view import LEAST_LAPS, LogView, thirds
from deepracer_exp.reports.tables.sector_times import time_lost
from deepracer_exp.reports.tables.statistics import Values, histogram, means, quantiles, subsample
from deepracer_exp.reports.tables.step_columns import first_rows
from deepracer_exp.tracks.sectors import Sector, sectors_of

from .figure import Chart, Layer, Panel, bars, colored_points, in_rows, line, mark, points
from .style import BLUE, FAINT, GREEN, ORANGE, PALE, SKY, VERMILION
from .training_charts import ITERATION

CHANCES = {deviations: NormalDist().cdf(deviations) for deviations in (-2, -3)}
"""Chance of a value so many standard deviations below the mean of a normal distribution: 2.275 and 0.135 per cent."""
LAP_COLUMNS: Mapping[str, str] = {
    "dist_m": "distance driven, m",
    "speed_mean_mps": "speed along the track, mean, m/s",
    "speed_top_mps": "speed along the track, highest, m/s",
    "progress_top_pps": "progress per second, highest, per cent",
    "reward": "reward of the lap",
    "reward_step": "reward of a step, mean",
    "reward_last": "reward of the last step",
    "steer_change_deg": "steering change per step, mean, degrees",
    "slide_top_deg": "slide, 95th percentile, degrees",
    "offset_mean_m": "distance from the centre line, mean, m",
    "start_speed_mps": "speed half a second after the start, m/s",
    "start": "start position, per cent of the track",
    "iteration": ITERATION,
}
"""Columns that lap times may correlate with, with their units."""
_OF_STEPS = (
    *("steer", "reward", "track_speed_mps", "progress_speed_pps", "slide_deg", "offset_m", "lap_position"),
    "progress",
)
"""Columns of the steps that `LAP_COLUMNS` are computed from."""
_SMOOTHED = 5
"""Control steps in the mean of the steering along a lap; the speed is one of as many (`step_columns.SPEED_STEPS`)."""
_ENOUGH = 20
"""Laps of the last third of the iterations from which on they have a histogram of their own."""
_FITTED = 8
"""Laps from which on curves are fitted."""
_MOST_LAPS, _MOST_PANELS = 500, 12
_STARTS = 20
"""Parts of the course in which starts are counted together."""


def lap_time_histogram(view: LogView) -> Chart | None:
    """Draw the lap times of all complete laps, and the probability of fast ones."""
    laps = view.comparable[view.comparable["lap_time_s"].notna()]
    if not len(laps):
        return None
    late = laps[thirds(view.episodes["iteration"].to_numpy())[laps.index] == 2]
    alike = " on usual conditions" if len(view.comparable) < len(view.episodes) else ""
    parts = {f"All complete laps{alike}": laps}
    if len(laps) > len(late) >= _ENOUGH:
        parts["Of the last third of the iterations"] = late
    times_s = [part["lap_time_s"].to_numpy(np.float64) for part in parts.values()]
    return Chart(
        name="lap_time_histogram",
        title="Lap times",
        caption=_chances_in_words(times_s[-1], len(parts) > 1),
        rows=[[_histogram_panel(title, some) for title, some in zip(parts, times_s, strict=True)]],
    )


def _histogram_panel(title: str, times_s: Values) -> Panel:
    bins = histogram(times_s)
    best, mean, deviation = float(times_s.min()), float(times_s.mean()), _deviation(times_s)
    layers: list[Layer] = [bars(bins.centers, bins.counts, SKY, width=bins.width)]
    marks = [(mean, f"mean {mean:.2f} s", BLUE), (best, f"best {best:.2f} s", GREEN)]
    if deviation > 0:
        span = np.linspace(min(best, mean - 3.5 * deviation), mean + 3.5 * deviation, 120)
        density = np.exp(-(((span - mean) / deviation) ** 2) / 2) / (deviation * np.sqrt(2 * np.pi))
        expected = len(times_s) * bins.width * density
        layers.append(line(span, expected, FAINT, "normal distribution", width=1.5))
        for times, color in ((-2, ORANGE), (-3, VERMILION)):
            position = mean + times * deviation
            marks.append((position, f"{times} sd {position:.2f} s: {100 * CHANCES[times]:.3f}%", color))
    layers += [mark(position, label, color, in_legend=True) for position, label, color in marks]
    return Panel(title=f"{title} ({len(times_s)})", x_label="lap time, s", y_label="laps", layers=layers)


def _deviation(times_s: Values) -> float:
    return float(times_s.std(ddof=1)) if len(times_s) >= LEAST_LAPS else 0.0


def _chances_in_words(times_s: Values, late: bool) -> str:
    deviation = _deviation(times_s)
    if not deviation:
        laps = count(len(times_s), "complete lap")
        return f"No chances can be estimated from {laps}: too few, or all of the same time."
    which = (
        f"the {len(times_s)} complete laps of the last third of the iterations"
        if late
        else "all complete laps"
    )
    bound = float(times_s.mean()) - 2 * deviation
    measured = 100 * float((times_s <= bound).mean())
    return (
        "In a normal distribution one lap in 44 is two standard deviations faster than the mean, and one in 740 three. "
        f"Of {which} {measured:.2g} per cent are faster than {bound:.2f} s, where 2.275 per cent were expected."
    )


def lap_time_percentile(view: LogView) -> Chart | None:
    """Draw the 25th percentile of the lap times of each iteration, with the candidates for submission."""
    table = view.judged[view.judged["lap_time_p25_s"].notna()]
    if not len(table):
        return None
    laps = view.comparable[view.comparable["lap_time_s"].notna()]
    shown = laps.iloc[subsample(len(laps), 2500)]
    x, y, share = table["iteration"], table["lap_time_p25_s"], 100 * table["lap_share"]
    best = table[table["iteration"].isin(view.candidates["iteration"])]
    hover = [
        f"iteration {row.iteration}: 25th percentile {row.lap_time_p25_s:.2f} s, best {row.lap_time_best_s:.2f} s, "
        f"{row.complete} of {row.episodes} episodes are complete laps"
        for row in table.itertuples()
    ]
    layers: list[Layer] = [points(shown["iteration"], shown["lap_time_s"], PALE, "a lap", size=3.5)]
    if len(best):
        stars = best["iteration"], best["lap_time_p25_s"], VERMILION, "candidate for submission"
        layers.append(points(*stars, symbol="star", size=24))
    scale, colors = "complete laps, per cent of the episodes", (0.0, max(float(share.max()), 1.0))
    layers.append(colored_points(x, y, share, scale, value_range=colors, hover=hover))
    which = "No iteration has enough laps to be judged by them."
    if view.run is not None:
        which = "A run of ours races with its best kept checkpoint."
    elif len(view.candidates):
        judged = " by their evaluations" if view.candidates["evaluated"].any() else ""
        names = ", ".join(map(str, view.candidates["iteration"]))
        which = f"Candidates, the best{judged} first: {names}."
    unit = "a block of iterations" if view.in_blocks else "an iteration"
    # The laps of an iteration may be in metrics files only.
    times_s = np.concatenate([shown["lap_time_s"], y])
    low, high = float(times_s.min()), max(float(np.percentile(times_s, 99)), float(y.max()))
    rim = max(0.06 * (high - low), 0.1)
    y_range = (low - rim, high + rim)
    return Chart(
        name="lap_time_percentile",
        title="25th percentile of the lap time",
        caption=f"Each coloured point is {unit}: low ones are fast, bright ones often complete the lap. {which}",
        rows=[[Panel(x_label=ITERATION, y_label="lap time, s", layers=layers, y_range=y_range)]],
    )


def lap_delta(view: LogView) -> Chart | None:
    """Draw the fastest lap beside an ordinary one, point by point along the course."""
    laps = view.comparable["lap_time_s"].dropna().sort_values(kind="stable")
    if len(laps) < 2:
        return None
    fastest = int(laps.index[0])
    ordinary = ordinary_lap(view.comparable, fastest)
    delta = time_lost(view.steps, ordinary, fastest)
    unit, scale, sectors = "per cent", 100.0, []
    if view.course is not None:
        unit, scale, sectors = "m", view.course.length_m, sectors_of(view.course)
    panels = [time_lost_panel("Time lost by the ordinary lap", delta, sectors, scale)]
    drives = {"ordinary": (ordinary, ORANGE), "fastest": (fastest, BLUE)}
    driven = {name: _along(view, lap) for name, (lap, _) in drives.items()}
    for column, title, label in (
        ("track_speed_mps", "Speed along the track", "m/s"),
        ("steer", f"Steering angle, positive to the left, mean of {_SMOOTHED} steps", "degrees"),
        ("offset_m", "Distance from the centre line, positive to the left", "m"),
    ):
        if not np.isfinite(driven["fastest"][column]).any():
            continue
        lines = []
        for name, (lap, color) in drives.items():
            text = f"{name} lap, {laps[lap]:.2f} s (iteration {view.episodes.loc[lap, 'iteration']})"
            places = scale * driven[name]["lap_position"]
            lines.append(line(places, driven[name][column], color, text if len(panels) == 1 else None))
        panels.append(Panel(title=title, y_label=label, layers=lines))
    panels[-1] = replace(panels[-1], x_label=f"position on the track, {unit} from waypoint 0")
    return Chart(
        name="lap_delta",
        title="Two laps along the track: the fastest and an ordinary one",
        caption=_loss_in_words(sectors, delta)
        + " Where the line rises, time is lost, where it falls, time is gained; lines are broken where a lap began.",
        rows=in_rows(panels, 1),
        share_x=True,
    )


def time_lost_panel(title: str, delta: pd.DataFrame, sectors: Sequence[Sector], scale: float) -> Panel:
    """Return a panel of `time_lost` along the course, where the lap position 1 is `scale`, and of its sectors."""
    layers: list[Layer] = [
        *(mark(scale * part.begin, part.name, PALE) for part in sectors),
        mark(0.0, "", FAINT, horizontal=True),
        line(scale * delta["lap_position"], delta["delta_s"], VERMILION, width=2.5),
    ]
    low, high = delta["delta_s"].min(), delta["delta_s"].max()
    # The names of the sectors are above the line.
    y_range = (low - 0.05 * (high - low), high + 0.7 * (high - low)) if sectors and high > low else None
    return Panel(title=title, y_label="s", layers=layers, y_range=y_range)


def ordinary_lap(episodes: pd.DataFrame, fastest: int) -> int:
    """Return the median lap: if there are enough, of those late laps that began where the fastest did."""
    others = episodes[episodes["lap_time_s"].notna()].drop(fastest)
    # A lap from another start stands still elsewhere, which would be most of the difference.
    same_start = others[others["start_at"] == episodes.loc[fastest, "start_at"]]
    late = same_start[same_start.index >= others.index[len(others) // 2]]
    ordinary = next((part for part in (late, same_start) if len(part) >= 3), others)
    return int(ordinary.sort_values("lap_time_s", kind="stable").index[len(ordinary) // 2])


def _along(view: LogView, lap: int) -> pd.DataFrame:
    """Return the rows of a lap from the start line on, with a gap where the lap began and ended."""
    steps = view.steps[["lap_position", "track_speed_mps", "steer", "offset_m"]]
    rows = steps.iloc[view.rows_of(view.episodes.index == lap)].reset_index(drop=True)
    rows["steer"] = rows["steer"].rolling(_SMOOTHED, center=True, min_periods=1).mean()
    first = int(rows["lap_position"].to_numpy().argmin())
    return pd.concat([rows.iloc[first:], rows.iloc[:0].reindex([0]), rows.iloc[:first]], ignore_index=True)


def _loss_in_words(sectors: Sequence[Sector], delta: pd.DataFrame) -> str:
    positions, lost_s = (delta[name].to_numpy(np.float64) for name in ("lap_position", "delta_s"))
    slower = f"The ordinary lap is {lost_s[-1]:.2f} s slower than the fastest"
    if not sectors:
        return f"{slower}."
    lost = {
        part.name: float(np.diff(np.interp([part.begin, part.end], positions, lost_s))[0]) for part in sectors
    }
    worst = max(lost, key=lambda name: lost[name])
    return f"{slower} and loses most to it in sector {worst}: {lost[worst]:.2f} s."


def correlations(view: LogView) -> Chart | None:
    """Draw lap time against other figures of a lap, with linear and quadratic fits, the closest first."""
    if view.comparable["lap_time_s"].notna().sum() < 3:
        return None
    laps = _lap_columns(view)
    varying = [name for name in LAP_COLUMNS if laps[name].nunique() > 1]
    r = (
        laps[varying]
        .corrwith(laps["lap_time_s"])
        .dropna()
        .sort_values(key=np.abs, ascending=False, kind="stable")
    )
    if not len(r):
        return None
    shown, lap_s = laps.iloc[subsample(len(laps), _MOST_LAPS)], laps["lap_time_s"].to_numpy(np.float64)
    panels = []
    for name in r.index[:_MOST_PANELS]:
        layers: list[Layer] = [points(shown[name], shown["lap_time_s"], BLUE, size=5)]
        values = laps[name].to_numpy(np.float64)
        is_finite, distinct = np.isfinite(values), laps[name].nunique()
        values, times_s = values[is_finite], lap_s[is_finite]
        for degree, color in ((1, VERMILION), (2, ORANGE)):
            if len(values) >= _FITTED and distinct > degree + 1:
                low, high = np.quantile(values, [0.005, 0.995]).tolist()
                span = np.linspace(low, high, 60)
                fit = Polynomial.fit(values, times_s, degree)
                layers.append(line(span, fit(span), color, dashed=degree > 1))
        panels.append(
            Panel(
                title=f"r = {r[name]:+.2f}", x_label=LAP_COLUMNS[name], y_label="lap time, s", layers=layers
            )
        )
    part = f" {len(shown)} of {len(laps)} laps are drawn, all are counted." if len(shown) < len(laps) else ""
    return Chart(
        name="correlations",
        title="What lap time correlates with",
        caption=f"Solid lines are linear fits, dashed ones quadratic, r is Pearson's over {len(laps)} complete laps; "
        f"the closest is {LAP_COLUMNS[r.index[0]].rsplit(',', 1)[0]} (r = {r.iloc[0]:+.2f}).{part}",
        rows=in_rows(panels, 3),
    )


def _lap_columns(view: LogView) -> pd.DataFrame:
    """Return `lap_time_s` and `LAP_COLUMNS` of each `comparable` lap."""
    wanted = view.comparable["lap_time_s"].reindex(view.episodes.index).notna().to_numpy()
    laps, n = np.flatnonzero(wanted), len(wanted)
    begin, end = view.begins[laps], view.begins[laps + 1] - 1
    part = {name: view.steps[name].to_numpy(np.float64) for name in _OF_STEPS}
    changed = np.abs(np.diff(part["steer"], prepend=np.nan))
    changed[begin] = np.nan
    # The eighth row stands for half a second after the start.
    started = np.where(end - begin >= 7, part["track_speed_mps"][np.minimum(begin + 7, end)], np.nan)
    # Of all episodes: to copy the rows of laps takes longer than to count the others, too.
    mean, first = partial(means, view.episode_index, n=n), view.begins[:-1]
    rows = view.rows_of(wanted)
    slide_deg = np.abs(part["slide_deg"][rows])
    per_lap = pd.DataFrame(
        {
            "speed_mean_mps": mean(part["track_speed_mps"])[laps],
            "speed_top_mps": np.fmax.reduceat(part["track_speed_mps"], first)[laps],
            "progress_top_pps": np.fmax.reduceat(part["progress_speed_pps"], first)[laps],
            "reward_step": mean(part["reward"])[laps],
            "reward_last": part["reward"][end],
            "steer_change_deg": mean(changed)[laps],
            "slide_top_deg": quantiles(view.episode_index[rows], slide_deg, n, (0.95,))[0][laps],
            "offset_mean_m": mean(np.abs(part["offset_m"]))[laps],
            "start_speed_mps": started,
            "start": 100.0 * ((part["lap_position"][begin] - part["progress"][begin] / 100.0) % 1.0),
        }
    ).set_axis(laps)
    summed = view.episodes.loc[per_lap.index, ["lap_time_s", "dist_m", "reward", "iteration"]]
    return summed.join(per_lap)[["lap_time_s", *LAP_COLUMNS]]


def start_position(view: LogView) -> Chart | None:
    """Draw completion and lap time by start position."""
    if view.laps_only:
        return None
    first = view.steps[["lap_position", "progress"]].iloc[np.flatnonzero(first_rows(view.steps))]
    # Starts at one position differ by where the car settles, so that a part begins half of its width earlier.
    place = (first["lap_position"] - first["progress"] / 100.0).to_numpy(np.float64) * _STARTS
    episodes = view.episodes[["progress", "lap_time_s"]].assign(
        at=((place + 0.5) % _STARTS - 0.5) * 100 / _STARTS,
        start=np.floor(place + 0.5) % _STARTS * 100 / _STARTS,
    )[view.episodes["ended"]]
    groups = episodes.groupby("start")
    completion = groups["progress"].mean()
    if len(completion) < 2:
        return None
    x, width = completion.index.to_numpy(np.float64), 0.82 * 100 / _STARTS
    shown: list[tuple[str, str, list[Layer]]] = [
        ("Progress, mean", "per cent of the lap", [bars(x, completion, BLUE, width=width)]),
        ("Episodes", "episodes", [bars(x, groups.size(), FAINT, width=width)]),
    ]
    laps = episodes[episodes["lap_time_s"].notna() & episodes.index.isin(view.comparable.index)]
    if len(laps):
        times_s = laps.groupby("start")["lap_time_s"].agg(["mean", "min"]).reindex(completion.index)
        laps = laps.iloc[subsample(len(laps), 1500)]
        timed: list[Layer] = [
            points(laps["at"], laps["lap_time_s"], SKY, size=5),
            points(x, times_s["mean"], BLUE, "mean", symbol="diamond", size=9),
            points(x, times_s["min"], VERMILION, "best", symbol="star", size=11),
        ]
        shown.append(("Lap times", "lap time, s", timed))
    where = "start, per cent of the track"
    worst, best = completion.idxmin(), completion.idxmax()
    return Chart(
        name="start_position",
        title="The effect of the start position",
        caption=f"Episodes that start at {worst:.0f} per cent of the track drive least far, "
        f"{completion[worst]:.0f} per cent of a lap, those from {best:.0f} per cent farthest, "
        f"{completion[best]:.0f} per cent. The fewer episodes a position has, the more of that is chance.",
        rows=in_rows(
            [Panel(title=t, x_label=where, y_label=unit, layers=some) for t, unit, some in shown], 3
        ),
    )
