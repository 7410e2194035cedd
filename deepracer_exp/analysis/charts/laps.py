"""Lap times: their distribution, when they were driven, what they correlate with, and two laps side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.stats import norm

from deepracer_exp.analysis.candidates import candidates_of
from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.analysis.sectors import Sector, sectors_of, time_lost
from deepracer_exp.analysis.statistics import Values, correlation, fit_polynomial, histogram, subsample
from deepracer_exp.analysis.tables import first_rows

from .figure import Chart, Layer, Panel, bars, colored_points, in_rows, line, mark, points
from .style import BLUE, FAINT, GREEN, ORANGE, PALE, SKY, VERMILION
from .training import ITERATION

CHANCES = {-2: float(norm.cdf(-2)), -3: float(norm.cdf(-3))}
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
"""What lap times may correlate with, with unit."""
_SMOOTHED = 5
"""Control steps in the mean of speed and steering along a lap."""
_ENOUGH = 20
"""Laps of the last third of the iterations from which on they have a histogram of their own."""
_FITTED = 8
"""Laps from which on curves are fitted."""
_MOST_LAPS, _MOST_PANELS = 500, 12
_STARTS = 20
"""Parts of the course in which starts are counted together."""


def lap_time_histogram(view: LogView) -> Chart | None:
    """Draw the lap times of all complete laps, and how likely fast ones are."""
    laps = view.episodes[view.episodes["lap_time_s"].notna()]
    if not len(laps):
        return None
    late = laps[laps["iteration"] >= np.ceil(2 / 3 * view.iterations["iteration"].max())]
    parts = {"All complete laps": laps}
    if len(laps) > len(late) >= _ENOUGH:
        parts["Of the last third of the iterations"] = late
    times_s = [part["lap_time_s"].to_numpy(np.float64) for part in parts.values()]
    return Chart(
        name="lap_time_histogram",
        title="Lap times",
        caption=_chances_in_words(times_s[-1], len(laps), len(parts) > 1),
        rows=[[_histogram_panel(title, some) for title, some in zip(parts, times_s, strict=True)]],
        table=laps[["iteration", "episode", "lap_time_s"]],
    )


def _histogram_panel(title: str, times_s: Values) -> Panel:
    found = histogram(times_s)
    best, mean, deviation = float(times_s.min()), float(times_s.mean()), _deviation(times_s)
    layers: list[Layer] = [bars(found.centers, found.counts, SKY, width=found.width)]
    marks = [(mean, f"mean {mean:.2f} s", BLUE), (best, f"best {best:.2f} s", GREEN)]
    if deviation > 0:
        span = np.linspace(min(best, mean - 3.5 * deviation), mean + 3.5 * deviation, 120)
        expected = len(times_s) * found.width * norm.pdf(span, mean, deviation)
        layers.append(line(span, expected, FAINT, "normal distribution", width=1.2))
        for times, color in ((-2, ORANGE), (-3, VERMILION)):
            at = mean + times * deviation
            marks.append((at, f"{times} sd {at:.2f} s: {100 * CHANCES[times]:.3f} %", color))
    return Panel(
        title=f"{title} ({len(times_s)})",
        x_label="lap time, s",
        y_label="laps",
        layers=[*layers, *(mark(at, label, color, in_legend=True) for at, label, color in marks)],
    )


def _deviation(times_s: Values) -> float:
    return float(times_s.std(ddof=1)) if len(times_s) > 2 else 0.0


def _chances_in_words(times_s: Values, count: int, late: bool) -> str:
    deviation = _deviation(times_s)
    which = (
        f"the {len(times_s)} complete laps of the last third of the iterations"
        if late
        else "all complete laps"
    )
    if not deviation:
        return f"There are only {count} complete laps, too few to estimate chances."
    bound = float(times_s.mean()) - 2 * deviation
    measured = 100 * float((times_s <= bound).mean())
    return (
        "In a normal distribution one lap in 44 is two standard deviations faster than the mean, and one in 740 three. "
        f"Of {which} {measured:.2g} per cent are faster than {bound:.2f} s, where 2.275 per cent were expected."
    )


def lap_time_percentile(view: LogView) -> Chart | None:
    """Draw the 25th percentile of the lap times of each iteration, with the candidates for submission."""
    table = view.iterations[view.iterations["lap_time_p25_s"].notna()]
    if not len(table):
        return None
    laps = view.episodes[view.episodes["lap_time_s"].notna()]
    shown = laps.iloc[subsample(len(laps), 2500)]
    share = 100 * table["lap_share"]
    best = candidates_of(view)
    hover = [
        f"iteration {row.iteration}: 25th percentile {row.lap_time_p25_s:.2f} s, best {row.lap_time_best_s:.2f} s, "
        f"{row.complete} of {row.episodes} episodes are complete laps"
        for row in table.itertuples()
    ]
    layers: list[Layer] = [
        points(shown["iteration"], shown["lap_time_s"], PALE, "a lap", size=2.5),
        points(
            best["iteration"],
            best["lap_time_p25_s"],
            VERMILION,
            "candidate for submission" if len(best) else None,
            symbol="star",
            size=18,
        ),
        colored_points(
            table["iteration"],
            table["lap_time_p25_s"],
            share,
            "complete laps, per cent of the episodes",
            value_range=(0.0, max(float(share.max()), 1.0)),
            size=6.5,
            hover=hover,
        ),
    ]
    names = ", ".join(str(number) for number in best["iteration"])
    which = (
        f"Candidates for submission, the best first: iteration{'s' * (len(best) > 1)} {names}."
        if names
        else "No iteration has enough laps to be submitted."
    )
    # The laps of an iteration may be in metrics files only.
    times_s = np.concatenate([shown["lap_time_s"], table["lap_time_p25_s"]])
    low, high = float(times_s.min()), float(np.percentile(times_s, 99))
    rim = 0.06 * max(high - low, 0.1)
    y_range = (low - rim, max(high, float(table["lap_time_p25_s"].max())) + rim)
    return Chart(
        name="lap_time_percentile",
        title="25th percentile of the lap time",
        caption=f"Each coloured point is an iteration: low ones are fast, bright ones often complete the lap. {which}",
        rows=[[Panel(x_label=ITERATION, y_label="lap time, s", layers=layers, y_range=y_range)]],
        table=table,
    )


def lap_delta(view: LogView) -> Chart | None:
    """Draw the fastest lap beside an ordinary one, point by point along the course."""
    laps = view.episodes["lap_time_s"].dropna().sort_values(kind="stable")
    if len(laps) < 2:
        return None
    fastest = int(laps.index[0])
    ordinary = _ordinary_lap(view.episodes, fastest)
    delta = time_lost(view.steps, ordinary, fastest)
    unit, scale = ("m", view.course.length_m) if view.course is not None else ("per cent", 100.0)
    parts = sectors_of(view.course).parts if view.course is not None else ()
    behind: list[Layer] = [
        *(mark(scale * part.begin, part.name, PALE) for part in parts),
        mark(0.0, "", FAINT, horizontal=True),
        line(scale * delta["lap_position"], delta["delta_s"], VERMILION, width=2.0),
    ]
    panels = [Panel(title="Time lost by the ordinary lap", y_label="s", layers=behind)]
    drives = {"ordinary": (ordinary, ORANGE), "fastest": (fastest, BLUE)}
    driven = {name: _along(view, lap) for name, (lap, _) in drives.items()}
    for column, title, label in (
        ("track_speed_mps", f"Speed along the track, mean of {_SMOOTHED} steps", "m/s"),
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
        caption=_loss_in_words(parts, delta)
        + " Where the line rises, time is lost, where it falls, time is gained; lines are broken where a lap began.",
        rows=in_rows(panels, 1),
        share_x=True,
        table=delta,
    )


def _ordinary_lap(episodes: pd.DataFrame, fastest: int) -> int:
    """Return the median lap: if there are enough, of those late laps that began where the fastest did."""
    others = episodes[episodes["lap_time_s"].notna()].drop(fastest)
    # A lap from another start stands still elsewhere, which would be most of the difference.
    same_start = others[others["start_at"] == episodes.loc[fastest, "start_at"]]
    late = same_start[same_start.index >= others.index[len(others) // 2]]
    found = next((part for part in (late, same_start) if len(part) >= 3), others)
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


def _loss_in_words(parts: Sequence[Sector], delta: pd.DataFrame) -> str:
    at, lost_s = (delta[name].to_numpy(np.float64) for name in ("lap_position", "delta_s"))
    slower = f"The ordinary lap is {lost_s[-1]:.2f} s slower"
    if not parts:
        return f"{slower}."
    lost = {part.name: float(np.diff(np.interp([part.begin, part.end], at, lost_s))[0]) for part in parts}
    worst = max(lost, key=lambda name: lost[name])
    return f"{slower} and loses most in sector {worst}: {lost[worst]:.2f} s."


def correlations(view: LogView) -> Chart | None:
    """Draw lap time against everything known of a lap, with linear and quadratic fits, the closest first."""
    if view.episodes["lap_time_s"].notna().sum() < 3:
        return None
    laps = _lap_columns(view)
    table = _correlation_table(laps)
    if not len(table):
        return None
    shown = laps.iloc[subsample(len(laps), _MOST_LAPS)]
    panels = [_correlation_panel(shown, laps, row) for _, row in table.head(_MOST_PANELS).iterrows()]
    closest = table.iloc[0]
    part = f" {len(shown)} of {len(laps)} laps are drawn, all are counted." if len(shown) < len(laps) else ""
    return Chart(
        name="correlations",
        title="What lap time correlates with",
        caption=f"Solid lines are linear fits, dashed ones quadratic, r is Pearson's over {len(laps)} complete laps; "
        f"the closest is {LAP_COLUMNS[closest['column']].rsplit(',', 1)[0]} (r = {closest['r']:+.2f}).{part}",
        rows=in_rows(panels, 3),
        table=table,
    )


def _lap_columns(view: LogView) -> pd.DataFrame:
    """Return `lap_time_s` and `LAP_COLUMNS` of each complete lap."""
    steps, episodes = view.steps, view.episodes
    number = np.cumsum(first_rows(steps)) - 1
    rows = episodes["lap_time_s"].notna().to_numpy()[number]
    lap = number[rows]
    columns = ["steer", "reward", "track_speed_mps", "progress_speed_pps", "slide_deg", "offset_m"]
    part = steps.loc[rows, [*columns, "lap_position", "progress"]]
    changed = part["steer"].diff().abs().where(np.diff(lap, prepend=-1) == 0)
    absolute = {"changed": changed, "slide": part["slide_deg"].abs(), "beside": part["offset_m"].abs()}
    groups = part.assign(**absolute).groupby(lap)
    eighth = groups.cumcount() == 7
    started = part[eighth].set_index(lap[eighth.to_numpy()])
    start = (groups["lap_position"].first() - groups["progress"].first() / 100.0) % 1.0
    found = pd.DataFrame(
        {
            "speed_mean_mps": groups["track_speed_mps"].mean(),
            "speed_top_mps": groups["track_speed_mps"].max(),
            "progress_top_pps": groups["progress_speed_pps"].max(),
            "reward_step": groups["reward"].mean(),
            "reward_last": groups["reward"].last(),
            "steer_change_deg": groups["changed"].mean(),
            "slide_top_deg": groups["slide"].quantile(0.95),
            "offset_mean_m": groups["beside"].mean(),
            "start_speed_mps": started["track_speed_mps"],
            "start": 100.0 * start,
        }
    )
    own = episodes.loc[found.index, ["lap_time_s", "dist_m", "reward", "iteration"]]
    return own.join(found)[["lap_time_s", *LAP_COLUMNS]]


def _correlation_table(laps: pd.DataFrame) -> pd.DataFrame:
    """Return r, rank correlation and the fits' shares of explained variance of each column that varies."""
    time_s = laps["lap_time_s"].to_numpy(np.float64)
    rows = []
    for name in LAP_COLUMNS:
        values = laps[name].to_numpy(np.float64)
        known = np.isfinite(values)
        x, y = values[known], time_s[known]
        r = correlation(x, y)
        if not np.isfinite(r):
            continue
        fits = {
            f"r2_{word}": found.r_squared if (found := fit_polynomial(x, y, degree)) else np.nan
            for degree, word in ((1, "linear"), (2, "quadratic"), (3, "cubic"))
        }
        rank_r = correlation(pd.Series(x).rank().to_numpy(), pd.Series(y).rank().to_numpy())
        rows.append({"column": name, "laps": len(x), "r": r, "rank_r": rank_r, **fits})
    table = pd.DataFrame(rows)
    return table.sort_values("r", key=np.abs, ascending=False, ignore_index=True) if len(table) else table


def _correlation_panel(shown: pd.DataFrame, laps: pd.DataFrame, row: pd.Series) -> Panel:
    name = str(row["column"])
    layers: list[Layer] = [points(shown[name], shown["lap_time_s"], BLUE, size=3.5)]
    known = laps[laps[name].notna()]
    x, y = (known[column].to_numpy(np.float64) for column in (name, "lap_time_s"))
    if len(known) >= _FITTED:
        span = np.linspace(np.percentile(x, 0.5), np.percentile(x, 99.5), 60)
        for degree, color in ((1, VERMILION), (2, ORANGE)):
            if found := fit_polynomial(x, y, degree):
                layers.append(line(span, found.at(span), color, dashed=degree > 1, width=1.8))
    return Panel(
        title=f"r = {row['r']:+.2f}", x_label=LAP_COLUMNS[name], y_label="lap time, s", layers=layers
    )


def start_position(view: LogView) -> Chart | None:
    """Draw how far and how fast episodes drive from each start position."""
    ended = view.episodes["ended"].to_numpy(bool)
    if ended.sum() < 2:
        return None
    first = view.steps.drop_duplicates(["stream", "episode"])
    start = (first["lap_position"] - first["progress"] / 100.0).to_numpy(np.float64)
    place = 100.0 * (start % 1.0)[ended]
    if len(np.unique(place.round(1))) < 2:
        return None
    # Starts at one position differ by where the car settles.
    width = 100.0 / _STARTS
    episodes = view.episodes.loc[ended, ["progress", "complete", "lap_time_s"]].assign(
        at=(place + width / 2) % 100.0 - width / 2, bin=(np.floor(place / width + 0.5) % _STARTS) * width
    )
    groups = episodes.groupby("bin")
    table = pd.DataFrame(
        {
            "episodes": groups.size(),
            "completion_mean": groups["progress"].mean(),
            "lap_share": groups["complete"].mean(),
            "lap_time_mean_s": groups["lap_time_s"].mean(),
            "lap_time_best_s": groups["lap_time_s"].min(),
        }
    )
    if len(table) < 2:
        return None
    x = table.index.to_numpy(np.float64)
    shown: list[tuple[str, str, list[Layer]]] = [
        (title, unit, [bars(x, values, color, width=0.82 * width)])
        for title, unit, values, color in (
            ("Progress, mean", "per cent of the lap", table["completion_mean"], BLUE),
            ("Complete laps", "per cent of the episodes", 100 * table["lap_share"], GREEN),
            ("Episodes", "episodes", table["episodes"], FAINT),
        )
    ]
    laps = episodes[episodes["lap_time_s"].notna()]
    if len(laps):
        laps = laps.iloc[subsample(len(laps), 1500)]
        timed: list[Layer] = [
            points(laps["at"], laps["lap_time_s"], SKY, size=3.5),
            points(x, table["lap_time_mean_s"], BLUE, "mean", symbol="diamond", size=7),
            points(x, table["lap_time_best_s"], VERMILION, "best", symbol="star", size=8),
        ]
        shown.insert(2, ("Lap times", "lap time, s", timed))
    where = "start, per cent of the track from waypoint 0"
    panels = [Panel(title=title, x_label=where, y_label=unit, layers=layers) for title, unit, layers in shown]
    completion = table["completion_mean"]
    worst, best = completion.idxmin(), completion.idxmax()
    return Chart(
        name="start_position",
        title="The effect of the start position",
        caption=f"Episodes that start at {worst:.0f} per cent of the track drive least far, "
        f"{completion[worst]:.0f} per cent of a lap, those from {best:.0f} per cent farthest, "
        f"{completion[best]:.0f} per cent. The fewer episodes a position has, the more of that is chance.",
        rows=in_rows(panels),
        table=table.reset_index(names="start"),
    )
