"""How a training went: its progress, its quarters, its updates beside lap times, its stability, its evaluations."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.analysis.statistics import Values, histogram, moving_average, percentiles_by, subsample
from deepracer_exp.runs.convergence import convergence

from .figure import Chart, Layer, Panel, band, bars, in_rows, line, mark, points
from .style import BLUE, FAINT, GREEN, ORANGE, PURPLE, SKY, VERMILION

ITERATION = "iteration (policy update)"
_HEALTHY_MS, _TOO_LONG_MS = 1000 / 15, 90.0
"""A control step's length at 15 Hz, and the 95th percentile beyond which deepracer-utils' stability check warns."""
_ORDINALS = ("1st", "2nd", "3rd", "4th")


def training_progress(view: LogView) -> Chart | None:
    """Draw reward, progress, complete laps and entropy of each iteration, and where the training converged."""
    table = view.iterations
    if not len(table):
        return None
    found = convergence(table, view.action_count, view.recording.stopping)
    at = None if found is None else found.iteration
    converged = [] if at is None else [mark(at, "converged", FAINT)]
    progress = curve(table, "completion_mean", BLUE, "mean of the episodes")
    for column, color, name in (
        ("eval_completion", ORANGE, "evaluation after the update"),
        ("held_out_completion", VERMILION, "held-out conditions"),
    ):
        if table[column].notna().any():
            progress += _joined(table, column, color, name)
    shares = table.assign(lap_share=100 * table["lap_share"])
    shown = [
        ("Reward", "reward of an episode", curve(table, "reward_mean", GREEN, "mean")),
        ("Progress", "per cent of the lap", progress),
        ("Complete laps", "per cent of the episodes", curve(shares, "lap_share", BLUE, "share")),
    ]
    if table["entropy"].notna().any():
        shown.append(
            ("Entropy of the policy", "nats", curve(table, "entropy", PURPLE, "mean over the update"))
        )
    when = "It has not converged yet." if at is None else f"It converged at iteration {at}."
    return Chart(
        name="training_progress",
        title="Training progress",
        caption="Points are iterations, lines their moving average of three: reward and progress should rise "
        f"together while entropy falls. {when}",
        rows=in_rows([_over_iterations(title, unit, [*layers, *converged]) for title, unit, layers in shown]),
        share_x=True,
        table=table,
    )


def learning_vs_lap_time(view: LogView) -> Chart | None:
    """Draw the metrics of the policy updates beside the lap times of the same iterations."""
    table = view.iterations
    metrics = {
        "entropy": ("Entropy of the policy", "nats", PURPLE),
        "kl": ("KL divergence of an update", "nats", BLUE),
        "policy_loss": ("Surrogate loss", "loss", ORANGE),
        "value_loss": ("Value loss", "loss", VERMILION),
        "lr": ("Learning rate", "rate", FAINT),
    }
    known = [name for name in metrics if table[name].notna().any()]
    if not known or not table["lap_time_mean_s"].notna().any():
        return None
    rates = table["lr"].dropna()
    if "lr" in known and np.ptp(rates) <= 1e-6 * rates.max():
        known.remove("lr")
    laps = [
        *_joined(table, "lap_time_p25_s", GREEN, "25th percentile"),
        *_joined(table, "lap_time_best_s", BLUE, "best"),
    ]
    rows = [[Panel(title="Lap time", y_label="lap time, s", layers=laps)]]
    for name in known:
        title, unit, color = metrics[name]
        label = ITERATION if name == known[-1] else ""
        rows.append([Panel(title=title, x_label=label, y_label=unit, layers=curve(table, name, color, None))])
    return Chart(
        name="learning_vs_lap_time",
        title="Metrics of the policy updates and lap times",
        caption="All panels show the same iterations, so that a slower lap can be traced to the update before it. "
        f"{_closest_metric(table, known)}",
        rows=rows,
        share_x=True,
        table=table[["iteration", "lap_time_p25_s", "lap_time_best_s", *known]],
    )


def _closest_metric(table: pd.DataFrame, known: Sequence[str]) -> str:
    """Return in words which metric of the updates correlates best with the lap time."""
    ranks = table[["lap_time_p25_s", *known]].corr(method="spearman", min_periods=8)["lap_time_p25_s"]
    ranks = ranks.drop("lap_time_p25_s").dropna()
    if not len(ranks):
        return "There are too few iterations with laps for a correlation."
    name = str(ranks.abs().idxmax())
    words = {"kl": "KL divergence", "policy_loss": "surrogate loss", "lr": "learning rate"}
    metric = words.get(name, name.replace("_", " "))
    return f"Lap time correlates best with {metric} (rank correlation {ranks[name]:+.2f})."


def quarters(view: LogView) -> Chart | None:
    """Draw progress, complete laps, reward and lap times of each quarter of the episodes."""
    episodes = view.episodes[view.episodes["ended"]]
    if len(episodes) < 4:
        return None
    groups = episodes.groupby("quarter")
    laps = groups["lap_time_s"]
    table = pd.DataFrame(
        {
            "episodes": groups.size(),
            "complete": groups["complete"].sum(),
            "completion_mean": groups["progress"].mean(),
            "reward_mean": groups["reward"].mean(),
            "lap_time_mean_s": laps.mean(),
            "lap_time_best_s": laps.min(),
            "lap_time_p25_s": laps.quantile(0.25),
        }
    )
    panels = [
        Panel(
            title=title,
            x_label="quarter of the episodes",
            y_label=unit,
            x_names=_ORDINALS,
            layers=[bars(table.index - 1, values, color)],
        )
        for title, unit, values, color in (
            ("Progress, mean", "per cent of the lap", table["completion_mean"], BLUE),
            ("Complete laps", "per cent of the episodes", 100 * table["complete"] / table["episodes"], GREEN),
            ("Reward, mean", "reward of an episode", table["reward_mean"], SKY),
        )
    ]
    timed = episodes["lap_time_s"].notna().any()
    counts = ", ".join(str(int(count)) for count in table["complete"])
    return Chart(
        name="quarters",
        title="Quarters of the training",
        caption=f"Each bar is a quarter of the {len(episodes)} episodes in their order. Complete laps per quarter: "
        f"{counts}.",
        rows=[panels[:2], [panels[2], _lap_times_of_quarters(episodes, table)]] if timed else [panels],
        table=table.reset_index(),
    )


def _lap_times_of_quarters(episodes: pd.DataFrame, table: pd.DataFrame) -> Panel:
    laps = episodes[episodes["lap_time_s"].notna()]
    laps = laps.iloc[subsample(len(laps), 2000)]
    # Within a quarter from left to right in the order of driving.
    within = laps.groupby("quarter").cumcount() / laps.groupby("quarter")["quarter"].transform("size")
    at = table.index - 1
    return Panel(
        title="Lap times, in their order",
        x_label="quarter of the episodes",
        y_label="lap time, s",
        x_names=_ORDINALS,
        x_range=(-0.5, 3.5),
        layers=[
            points(laps["quarter"] - 1 + 0.7 * (within - 0.5), laps["lap_time_s"], SKY, size=3.5),
            points(at, table["lap_time_mean_s"], BLUE, "mean", size=8, symbol="diamond"),
            points(at, table["lap_time_best_s"], VERMILION, "best", size=9, symbol="star"),
        ],
    )


def evaluations(view: LogView) -> Chart | None:
    """Draw the episodes of evaluations and races, beside the best lap of the training."""
    episodes = view.evaluation_episodes
    if not len(episodes):
        return None
    names = [str(name) for name in dict.fromkeys(episodes["stream"])]
    number = episodes["stream"].astype(str).map({name: at for at, name in enumerate(names)})
    # Side by side, so that equal results do not cover each other.
    order, size = number.groupby(number).cumcount(), number.groupby(number).transform("size")
    episodes = episodes.assign(x=number + 0.7 * ((order + 0.5) / size - 0.5))
    parts = ((True, "complete", BLUE, "circle"), (False, "not complete", VERMILION, "x"))
    progress: list[Layer] = []
    for complete, name, color, symbol in parts:
        some = episodes[episodes["complete"] == complete]
        hover = [f"{row.stream}: {row.progress:.1f} per cent" for row in some.itertuples()]
        if len(some):
            progress.append(
                points(some["x"], some["progress"], color, name, symbol=symbol, size=6, hover=hover)
            )
    axes: dict[str, Any] = {
        "x_names": [_shortened(name) for name in names],
        "x_range": (-0.5, len(names) - 0.5),
    }
    rows = [
        [
            Panel(
                title="Progress", y_label="per cent of the lap", layers=progress, y_range=(0.0, 104.0), **axes
            )
        ]
    ]
    if episodes["lap_time_s"].notna().any():
        hover = [f"{row.stream}: {row.lap_time_s:.2f} s" for row in episodes.itertuples()]
        laps: list[Layer] = [points(episodes["x"], episodes["lap_time_s"], BLUE, size=6, hover=hover)]
        best_s = float(view.episodes["lap_time_s"].min())
        if np.isfinite(best_s):
            laps.append(mark(best_s, "best of the training", GREEN, horizontal=True))
        shown = np.array([episodes["lap_time_s"].min(), episodes["lap_time_s"].max(), best_s])
        low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
        rim = max(0.1 * (high - low), 0.1)
        y_range = (low - rim, high + rim)
        rows.append([Panel(title="Lap time", y_label="lap time, s", layers=laps, y_range=y_range, **axes)])
    return Chart(
        name="evaluations",
        title="Evaluations and races",
        caption=f"Each point is an episode of one of {len(names)} evaluations or races on this course, in the order "
        "in which they were driven. Most laps are slower than the best of the training, which is the fastest of many.",
        rows=rows,
        table=episodes.drop(columns="x"),
    )


def _shortened(name: str, most: int = 26) -> str:
    return name if len(name) <= most else f"{name[: most - 9]}…{name[-8:]}"


def stability(view: LogView) -> Chart | None:
    """Draw how regular the control steps were and how much the results of the episodes scatter."""
    steps, table = view.steps, view.iterations
    times_ms = 1000 * steps["delta_time_s"].to_numpy(np.float64)
    iteration = steps["iteration"].to_numpy()
    driven = times_ms > 0
    if not driven.any():
        return None
    spread = percentiles_by(iteration[driven], times_ms[driven], (50.0, 95.0))
    lengths = histogram(np.clip(times_ms[driven], 0, np.percentile(times_ms[driven], 99.9)), least=20)
    length = Panel(
        title="Length of a control step",
        x_label="ms of simulated time",
        y_label="control steps",
        layers=[
            bars(lengths.centers, lengths.counts, BLUE, width=lengths.width),
            mark(_HEALTHY_MS, "15 Hz", GREEN),
            mark(_TOO_LONG_MS, "too long", VERMILION),
        ],
        x_range=(0.0, max(120.0, 1.05 * float(lengths.centers[-1]))),
    )
    over_time = Panel(
        title="The same over the training",
        x_label=ITERATION,
        y_label="ms",
        layers=[
            line(spread.index, spread[95.0], ORANGE, "95th percentile"),
            line(spread.index, spread[50.0], BLUE, "median"),
            mark(_TOO_LONG_MS, "too long", VERMILION, horizontal=True),
        ],
        y_range=(0.0, max(1.15 * _TOO_LONG_MS, 1.05 * float(spread[95.0].max()))),
    )
    panels = [length, over_time]
    factor = _real_time_factor(steps)
    if factor is not None:
        layers = [line(factor.index, factor, BLUE), mark(1.0, "real time", FAINT, horizontal=True)]
        panels.append(_over_iterations("Real-time factor", "simulated s / real s", layers))
    else:
        table = table.assign(step_ms_median=table["iteration"].map(spread[50.0]))
    episodes = view.episodes[view.episodes["ended"]]
    for column, title, unit, color in (
        ("progress", "Progress of the episodes", "per cent of the lap", BLUE),
        ("reward", "Reward of the episodes", "reward of an episode", GREEN),
    ):
        values = episodes[column].to_numpy(np.float64)
        found = percentiles_by(episodes["iteration"].to_numpy(), values, (25.0, 50.0, 75.0))
        if len(found):
            layers = [
                band(found.index, found[25.0], found[75.0], color, "middle half"),
                line(found.index, found[50.0], color, "median"),
            ]
            panels.append(_over_iterations(title, unit, layers))
    healthy = 100 * float((times_ms[driven] <= _TOO_LONG_MS).mean())
    return Chart(
        name="stability",
        title="Stability of simulation and training",
        caption=f"{healthy:.1f} per cent of the control steps are no longer than {_TOO_LONG_MS:.0f} ms; a simulation "
        "that cannot keep up gives the car fewer decisions per second. If the middle half stays wide while the median "
        "rises, the policy still takes risks.",
        rows=in_rows(panels),
        table=table,
    )


def _real_time_factor(steps: pd.DataFrame) -> pd.Series | None:
    """Return simulated over real seconds of each iteration, None where the log has no real time."""
    real = np.diff(steps["wall_clock"].to_numpy(np.float64), prepend=np.nan)
    simulated = steps["delta_time_s"].to_numpy(np.float64)
    counted = (simulated > 0) & (real > 0)
    if not counted.any():
        return None
    times = pd.DataFrame({"simulated": simulated[counted], "real": real[counted]})
    sums = times.groupby(steps["iteration"].to_numpy()[counted]).sum()
    return sums["simulated"] / sums["real"]


def curve(table: pd.DataFrame, column: str, color: str, name: str | None) -> list[Layer]:
    """Return a column of a table of iterations as points, and its moving average as a line."""
    shown = subsample(len(table), 1000)
    x, y = table["iteration"].to_numpy()[shown], table[column].to_numpy(np.float64)
    average: Values = moving_average(y)[shown]
    return [
        points(x, y[shown], color, name, size=3.5),
        line(x, average, color, name and "moving average of 3", width=2.0),
    ]


def _joined(table: pd.DataFrame, column: str, color: str, name: str) -> list[Layer]:
    """Return the known values of a column as points joined by a thin line."""
    known = table[table[column].notna()]
    x, y = known["iteration"], known[column]
    return [line(x, y, color, width=0.8), points(x, y, color, name, size=4.0)]


def _over_iterations(title: str, unit: str, layers: Sequence[Layer]) -> Panel:
    return Panel(title=title, x_label=ITERATION, y_label=unit, layers=layers)
