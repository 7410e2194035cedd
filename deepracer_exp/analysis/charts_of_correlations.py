"""What lap times go with."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from .chart import BLUE, ORANGE, VERMILION, Chart, Layer, Line, Panel, Points, thinned
from .episode_table import first_rows
from .log_view import LogView
from .statistics import correlation, fit

LAP_COLUMNS: Mapping[str, str] = {
    "dist_m": "distance driven, m",
    "speed_mean_mps": "speed along the track, mean, m/s",
    "speed_top_mps": "speed along the track, highest, m/s",
    "progress_top_pps": "progress a second, highest, per cent",
    "reward": "reward of the lap",
    "reward_step": "reward of a step, mean",
    "reward_last": "reward of the last step",
    "steer_change_deg": "steering change a step, mean, degrees",
    "slide_top_deg": "slide, 95th percentile, degrees",
    "offset_mean_m": "distance from the centre line, mean, m",
    "start_speed_mps": "speed half a second after the start, m/s",
    "start": "place of the start, per cent of the track",
    "iteration": "iteration (policy update)",
}
"""What is known of a lap, with unit."""
_FITTED = 8
"""Laps from which on curves are fitted."""
_MOST_LAPS = 500
_MOST_PANELS = 12


def lap_columns(view: LogView) -> pd.DataFrame:
    """Return `lap_time_s` and `LAP_COLUMNS` of each complete lap."""
    steps, episodes = view.steps, view.episodes
    number = np.cumsum(first_rows(steps)) - 1
    wanted = episodes["lap_time_s"].notna().to_numpy()
    rows = wanted[number]
    lap = number[rows]
    part = steps.loc[
        rows,
        [
            "steer",
            "reward",
            "track_speed_mps",
            "progress_speed_pps",
            "slide_deg",
            "offset_m",
            "lap_position",
            "progress",
        ],
    ]
    changed = part["steer"].diff().abs().where(np.diff(lap, prepend=-1) == 0)
    groups = part.assign(
        changed=changed, slide=part["slide_deg"].abs(), beside=part["offset_m"].abs()
    ).groupby(lap)
    after = part[groups.cumcount() == 7].set_index(lap[(groups.cumcount() == 7).to_numpy()])
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
            "start_speed_mps": after["track_speed_mps"],
            "start": 100.0 * start,
        }
    )
    told = episodes.loc[wanted, ["lap_time_s", "dist_m", "reward", "iteration"]]
    return told.join(found)[["lap_time_s", *LAP_COLUMNS]]


def correlations(view: LogView) -> Chart | None:
    """Draw lap time against what it may go with, the closest first."""
    if view.episodes["lap_time_s"].notna().sum() < 3:
        return None
    laps = lap_columns(view)
    table = _table(laps)
    if not len(table):
        return None
    shown = laps.iloc[thinned(len(laps), _MOST_LAPS)]
    panels = [_panel(shown, laps, row) for _, row in table.head(_MOST_PANELS).iterrows()]
    closest = table.iloc[0]
    some = f" {len(shown)} of {len(laps)} laps are drawn, all are counted." if len(shown) < len(laps) else ""
    return Chart(
        name="correlations",
        title="What lap time goes with",
        caption=f"Solid lines are straight fits, dashed ones quadratic, r is Pearson's over {len(laps)} complete laps; "
        f"closest is {LAP_COLUMNS[closest['column']].rsplit(',', 1)[0]} (r = {closest['r']:+.2f}).{some}",
        rows=[panels[at : at + 3] for at in range(0, len(panels), 3)],
        table=table,
    )


def _table(laps: pd.DataFrame) -> pd.DataFrame:
    """Return r, rank correlation and the fits' shares of explained variance of each column that varies."""
    time_s = laps["lap_time_s"].to_numpy(np.float64)
    rows = []
    for name in LAP_COLUMNS:
        x = laps[name].to_numpy(np.float64)
        known = np.isfinite(x)
        r = correlation(x[known], time_s[known])
        if not np.isfinite(r):
            continue
        ranks = correlation(
            pd.Series(x[known]).rank().to_numpy(np.float64),
            pd.Series(time_s[known]).rank().to_numpy(np.float64),
        )
        fits = {
            f"r2_{word}": found.r_squared if (found := fit(x[known], time_s[known], degree)) else np.nan
            for degree, word in ((1, "linear"), (2, "quadratic"), (3, "cubic"))
        }
        rows.append({"column": name, "laps": int(known.sum()), "r": r, "rank_r": ranks, **fits})
    table = pd.DataFrame(rows)
    return table.sort_values("r", key=np.abs, ascending=False, ignore_index=True) if len(table) else table


def _panel(shown: pd.DataFrame, laps: pd.DataFrame, row: pd.Series) -> Panel:
    name = str(row["column"])
    layers: list[Layer] = [
        Points(
            x=shown[name].to_numpy(np.float64),
            y=shown["lap_time_s"].to_numpy(np.float64),
            color=BLUE,
            size=3.5,
        )
    ]
    known = laps[laps[name].notna()]
    x, y = known[name].to_numpy(np.float64), known["lap_time_s"].to_numpy(np.float64)
    if len(known) >= _FITTED:
        span = np.linspace(np.percentile(x, 0.5), np.percentile(x, 99.5), 60)
        for degree, color in ((1, VERMILION), (2, ORANGE)):
            if found := fit(x, y, degree):
                layers.append(Line(x=span, y=found.at(span), color=color, dashed=degree > 1, width=1.8))
    return Panel(
        title=f"r = {row['r']:+.2f}", x_label=LAP_COLUMNS[name], y_label="lap time, s", layers=layers
    )
