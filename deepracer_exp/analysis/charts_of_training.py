"""How a training went: progress, quarters, updates beside lap times, stability, evaluations."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from .chart import (
    BLUE,
    FAINT,
    GREEN,
    ORANGE,
    PURPLE,
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
from .learning import convergence
from .log_view import LogView
from .statistics import moving_average

ITERATION = "iteration (policy update)"


def training_progress(view: LogView) -> Chart | None:
    """Draw reward, progress, complete laps and entropy of each iteration, and where it converged."""
    table = view.iterations
    if not len(table):
        return None
    found = convergence(table, view.action_count)
    at = None if found is None else found.iteration
    mark = [] if at is None else [Mark(at=float(at), label="converged", color=FAINT)]
    progress: list[Layer] = curve(table, "completion_mean", BLUE, "mean of the episodes")
    for column, color, name in (
        ("eval_completion", ORANGE, "evaluation after the update"),
        ("held_out_completion", VERMILION, "held-out conditions"),
    ):
        if known_values(table, column).any():
            progress += points_and_line(table, column, color, name)
    shares = table.assign(lap_share=100 * table["lap_share"])
    panels = [
        iteration_panel(
            "Reward", "reward of an episode", [*curve(table, "reward_mean", GREEN, "mean"), *mark]
        ),
        iteration_panel("Progress", "per cent of the lap", [*progress, *mark]),
        iteration_panel(
            "Complete laps", "per cent of the episodes", [*curve(shares, "lap_share", BLUE, "share"), *mark]
        ),
    ]
    if known_values(table, "entropy").any():
        entropy = curve(table, "entropy", PURPLE, "mean over the update")
        panels.append(iteration_panel("Entropy of the policy", "nats", [*entropy, *mark]))
    told = "It has not converged yet." if at is None else f"From iteration {at} on it gained no more."
    return Chart(
        name="training_progress",
        title="Training progress",
        caption=f"Points are iterations, lines their moving average of three: reward and progress should rise "
        f"together while entropy falls. {told}",
        rows=[panels[at : at + 2] for at in range(0, len(panels), 2)],
        share_x=True,
        table=table,
    )


def learning_vs_lap_time(view: LogView) -> Chart | None:
    """Draw what the policy updates tell beside the lap times of the same iterations."""
    table = view.iterations
    told = {
        "entropy": ("Entropy of the policy", "nats", PURPLE),
        "kl": ("KL divergence of an update", "nats", BLUE),
        "policy_loss": ("Surrogate loss", "loss", ORANGE),
        "value_loss": ("Value loss", "loss", VERMILION),
        "lr": ("Learning rate", "rate", FAINT),
    }
    known = [name for name in told if known_values(table, name).any()]
    if not known or not known_values(table, "lap_time_mean_s").any():
        return None
    rates = known_values(table, "lr")
    if "lr" in known and np.ptp(rates) <= 1e-6 * rates.max():
        known.remove("lr")
    laps = [
        *points_and_line(table, "lap_time_p25_s", GREEN, "25th percentile"),
        *points_and_line(table, "lap_time_best_s", BLUE, "best"),
    ]
    rows = [[Panel(title="Lap time", y_label="lap time, s", layers=laps)]]
    for name in known:
        title, unit, color = told[name]
        label = ITERATION if name == known[-1] else ""
        rows.append([Panel(title=title, x_label=label, y_label=unit, layers=curve(table, name, color, None))])
    finest = _relation(table, known)
    return Chart(
        name="learning_vs_lap_time",
        title="What the updates tell, beside the lap times of the same iterations",
        caption=f"All panels share their iterations, so that a slower lap can be looked up in the update before it. "
        f"{finest}",
        rows=rows,
        share_x=True,
        table=table[["iteration", "lap_time_p25_s", "lap_time_best_s", *known]],
    )


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
    share = 100 * table["complete"] / table["episodes"]
    names = [_ordinal(int(number)) for number in table.index]
    panels = [
        Panel(
            title=title,
            x_label="quarter of the episodes",
            y_label=unit,
            layers=[Bars(x=names, height=values.to_numpy(np.float64), color=color)],
        )
        for title, unit, values, color in (
            ("Progress, mean", "per cent of the lap", table["completion_mean"], BLUE),
            ("Complete laps", "per cent of the episodes", share, GREEN),
            ("Reward, mean", "reward of an episode", table["reward_mean"], SKY),
        )
    ]
    rows = [panels]
    if episodes["lap_time_s"].notna().any():
        rows = [panels[:2], [panels[2], _lap_times_of_quarters(episodes, table)]]
    counts = ", ".join(str(int(count)) for count in table["complete"])
    return Chart(
        name="quarters",
        title="Quarters of the training",
        caption=f"Each bar is a quarter of the {len(episodes)} episodes in their order. Complete laps per quarter: "
        f"{counts}.",
        rows=rows,
        table=table.reset_index(),
    )


def evaluations(view: LogView) -> Chart | None:
    """Draw the episodes of evaluations and races, beside the training's last ones."""
    episodes = view.evaluation_episodes
    if not len(episodes):
        return None
    names = [str(name) for name in dict.fromkeys(episodes["stream"])]
    place = {name: float(number) for number, name in enumerate(names)}
    x = episodes["stream"].astype(str).map(place).to_numpy(np.float64)
    # Side by side, so that equal results are seen as several.
    x = x + _spread_out(x)
    short = [_shortened(name) for name in names]
    best = view.episodes["lap_time_s"].min()
    complete = episodes["complete"].to_numpy(bool)
    progress: list[Layer] = [
        Points(
            x=x[wanted],
            y=_column(episodes[wanted], "progress"),
            name=name,
            color=color,
            symbol=symbol,
            size=6,
            hover=[
                f"{stream}: {value:.1f} per cent" for stream, value in _told(episodes[wanted], "progress")
            ],
        )
        for wanted, name, color, symbol in (
            (complete, "complete", BLUE, "circle"),
            (~complete, "not complete", VERMILION, "cross"),
        )
        if wanted.any()
    ]
    across = (-0.5, len(names) - 0.5)
    rows = [
        [
            Panel(
                title="Progress",
                y_label="per cent of the lap",
                layers=progress,
                x_names=short,
                x_range=across,
                y_range=(0.0, 104.0),
            )
        ]
    ]
    times = _column(episodes, "lap_time_s")
    if np.isfinite(times).any():
        low, high = float(np.nanmin(times)), float(np.nanmax(times))
        hover = [f"{stream}: {value:.2f} s" for stream, value in _told(episodes, "lap_time_s")]
        laps: list[Layer] = [Points(x=x, y=times, color=BLUE, size=6, hover=hover)]
        if np.isfinite(best):
            laps.append(Mark(at=float(best), label="best of the training", color=GREEN, horizontal=True))
            low, high = min(low, float(best)), max(high, float(best))
        rim = max(0.1 * (high - low), 0.1)
        rows.append(
            [
                Panel(
                    title="Lap time",
                    y_label="lap time, s",
                    layers=laps,
                    x_names=short,
                    x_range=across,
                    y_range=(low - rim, high + rim),
                )
            ]
        )
    return Chart(
        name="evaluations",
        title="Evaluations and races",
        caption=f"Each point is an episode of one of {len(names)} evaluations or races on this course, in the order "
        "they were driven. Laps slower than the best of the training are usual: there the fastest of many is told.",
        rows=rows,
        table=episodes,
    )


def curve(table: pd.DataFrame, column: str, color: str, name: str | None) -> list[Layer]:
    """Return a column's values as points and its moving average as a line over the iterations."""
    x, y = _column(table, "iteration"), _column(table, column)
    shown = thinned(len(x), 1000)
    return [
        Points(x=x[shown], y=y[shown], name=name, color=color, size=3.5),
        Line(
            x=x[shown],
            y=moving_average(y)[shown],
            name=name and "moving average of 3",
            color=color,
            width=2.0,
        ),
    ]


def points_and_line(table: pd.DataFrame, column: str, color: str, name: str) -> list[Layer]:
    """Return the known values of a column as points joined by a thin line."""
    y = _column(table, column)
    known = np.isfinite(y)
    x, y = _column(table, "iteration")[known], y[known]
    return [Line(x=x, y=y, color=color, width=0.8), Points(x=x, y=y, name=name, color=color, size=4.0)]


def known_values(table: pd.DataFrame, column: str) -> Values:
    """Return the finite values of a column."""
    values = _column(table, column)
    return values[np.isfinite(values)]


def _told(episodes: pd.DataFrame, column: str) -> list[tuple[str, float]]:
    return list(zip(episodes["stream"].astype(str), _column(episodes, column), strict=True))


def _column(table: pd.DataFrame, name: str) -> Values:
    return table[name].to_numpy(np.float64)


def iteration_panel(title: str, unit: str, layers: Sequence[Layer]) -> Panel:
    """Return a panel over the iterations."""
    return Panel(title=title, x_label=ITERATION, y_label=unit, layers=layers)


def _relation(table: pd.DataFrame, known: Sequence[str]) -> str:
    """Return in words which of the update's values goes with the lap time."""
    ranks = table[["lap_time_p25_s", *known]].corr(method="spearman", min_periods=8)["lap_time_p25_s"]
    ranks = ranks.drop("lap_time_p25_s").dropna()
    if not len(ranks):
        return "There are too few iterations with laps for a correlation."
    name = str(ranks.abs().idxmax())
    words = {"kl": "KL divergence", "policy_loss": "surrogate loss", "lr": "learning rate"}
    return (
        f"Lap time goes most closely with {words.get(name, name.replace('_', ' '))} "
        f"(rank correlation {ranks[name]:+.2f})."
    )


def _lap_times_of_quarters(episodes: pd.DataFrame, table: pd.DataFrame) -> Panel:
    laps = episodes[episodes["lap_time_s"].notna()]
    laps = laps.iloc[thinned(len(laps), 2000)]
    x = laps["quarter"].to_numpy(np.float64) - 1.0
    # Places beside each other by the order of driving: from left to right within the quarter.
    within = laps.groupby("quarter").cumcount() / laps.groupby("quarter")["quarter"].transform("size")
    at = table.index.to_numpy(np.float64) - 1.0
    return Panel(
        title="Lap times, in their order",
        x_label="quarter of the episodes",
        y_label="lap time, s",
        x_names=[_ordinal(number) for number in (1, 2, 3, 4)],
        x_range=(-0.5, 3.5),
        layers=[
            Points(
                x=x + 0.7 * (within.to_numpy(np.float64) - 0.5),
                y=_column(laps, "lap_time_s"),
                color=SKY,
                size=3.5,
            ),
            Points(
                x=at, y=_column(table, "lap_time_mean_s"), name="mean", color=BLUE, size=8, symbol="diamond"
            ),
            Points(
                x=at, y=_column(table, "lap_time_best_s"), name="best", color=VERMILION, size=9, symbol="star"
            ),
        ],
    )


def _spread_out(x: Values) -> Values:
    """Return small shifts that lay points of one place side by side."""
    order = pd.Series(x).groupby(x).cumcount()
    size = pd.Series(x).groupby(x).transform("size")
    return (0.7 * ((order + 0.5) / size - 0.5)).to_numpy(np.float64)


def _ordinal(number: int) -> str:
    return {1: "1st", 2: "2nd", 3: "3rd"}.get(number, f"{number}th")


def _shortened(name: str, most: int = 26) -> str:
    return name if len(name) <= most else f"{name[: most - 9]}…{name[-8:]}"
