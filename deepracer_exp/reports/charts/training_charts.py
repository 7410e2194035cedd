"""Charts of a training, live or over: progress, quarters, updates beside lap times, stability, evaluations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.reports.tables.log_view import LogView
from deepracer_exp.reports.tables.statistics import MOST_ROWS, histogram, moving_average, quantiles, subsample

from .figure import Chart, Layer, Panel, band, bars, colored_points, in_rows, line, mark, points
from .maps import map_panel, outlines
from .run_pictures import TrackLines
from .style import BLUE, FAINT, GREEN, ORANGE, PALE, PURPLE, SKY, VERMILION

ITERATION = "iteration (policy update)"
_HEALTHY_MS, _TOO_LONG_MS = 1000 / 15, 90.0
"""A control step's length at 15 Hz, and the 95th percentile beyond which deepracer-utils' stability check warns."""


def training_progress(view: LogView) -> Chart | None:
    """Draw reward, progress, complete laps, lap times and entropy by iteration.

    It shows where the training converged, or the checkpoint that its own evaluations found best.
    """
    table, verdict = view.iterations, view.convergence
    if not len(table):
        return None
    iteration = None if verdict is None else verdict.iteration
    marks = [] if iteration is None else [mark(iteration, "converged", FAINT)]
    best = None if view.run is None else view.run.best.iteration
    if best is not None:
        marks.append(mark(best, "best checkpoint", GREEN))
    progress = curve_layers(table, "completion_mean", BLUE, "mean of the episodes")
    for column, color, name in (
        ("eval_completion", ORANGE, "evaluation"),
        ("held_out_completion", VERMILION, "held-out conditions"),
    ):
        if table[column].notna().any():
            progress += _joined(table, column, color, name)
    shares = table.assign(lap_share=100 * table["lap_share"])
    shown = [
        ("Reward", "reward of an episode", curve_layers(table, "reward_mean", GREEN, "mean")),
        ("Progress", "per cent of the lap", progress),
        ("Complete laps", "per cent of the episodes", curve_layers(shares, "lap_share", BLUE, "share")),
    ]
    laps = [
        layer
        for column, color, name in (
            ("lap_time_mean_s", BLUE, "exploring laps, mean"),
            ("eval_lap_time_s", ORANGE, "evaluated laps, mean"),
        )
        if table[column].notna().any()
        for layer in _joined(table, column, color, name)
    ]
    if laps:
        shown.append(("Lap times", "lap time, s", laps))
    if table["entropy"].notna().any():
        shown.append(
            ("Entropy of the policy", "nats", curve_layers(table, "entropy", PURPLE, "mean over the update"))
        )
    when = "It has not converged yet." if iteration is None else f"It converged at iteration {iteration}."
    if view.decision is not None:
        when = f"The run's stopping rule ended it at iteration {table['iteration'].max()}."
    elif verdict is None:
        when = "It is too short to say whether it has converged."
    return Chart(
        name="training_progress",
        title="Training progress",
        caption="Points are iterations, lines their moving average of three: reward and progress should rise "
        f"together while entropy falls. {when}",
        rows=in_rows([_over_iterations(title, unit, [*layers, *marks]) for title, unit, layers in shown]),
        share_x=True,
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
    # A learning rate that does not change says nothing.
    changing = [name for name in metrics if table[name].nunique() > (name == "lr")]
    if not changing or not table["lap_time_mean_s"].notna().any():
        return None
    laps = [
        *_joined(table, "lap_time_p25_s", GREEN, "25th percentile"),
        *_joined(table, "lap_time_best_s", BLUE, "best"),
    ]
    panels = [Panel(title="Exploring laps", y_label="lap time, s", layers=laps)]
    for name in changing:
        title, unit, color = metrics[name]
        label = ITERATION if name == changing[-1] else ""
        panels.append(
            Panel(title=title, x_label=label, y_label=unit, layers=curve_layers(table, name, color, None))
        )
    return Chart(
        name="learning_vs_lap_time",
        title="Metrics of the policy updates and lap times",
        caption="All panels show the same iterations, so that a slower lap can be traced to the update before it: a "
        "jump of the KL divergence or of a loss just before slower laps is an update that was too large.",
        rows=in_rows(panels, 1),
        share_x=True,
    )


def quarters(view: LogView) -> Chart | None:
    """Draw progress, complete laps, reward and lap times of each quarter of the episodes."""
    episodes = view.episodes[view.episodes["ended"]]
    if view.laps_only or len(episodes) < 4:
        return None
    groups = episodes.groupby("quarter")
    places = np.array(list(groups.groups)) - 1
    complete = groups["complete"].sum()
    shown: list[tuple[str, str, list[Layer]]] = [
        ("Progress, mean", "per cent of the lap", [bars(places, groups["progress"].mean(), BLUE)]),
        ("Complete laps", "per cent of the episodes", [bars(places, 100 * groups["complete"].mean(), GREEN)]),
        ("Reward, mean", "reward of an episode", [bars(places, groups["reward"].mean(), SKY)]),
    ]
    laps = view.comparable[view.comparable["lap_time_s"].notna()]
    if len(laps):
        lap_s = laps.groupby("quarter")["lap_time_s"].agg(["mean", "min"]).reindex(places + 1)
        laps = laps.iloc[subsample(len(laps), 2000)]
        # Within a quarter from left to right in the order of driving.
        within = laps.groupby("quarter").cumcount() / laps.groupby("quarter")["quarter"].transform("size")
        times: list[Layer] = [
            points(laps["quarter"] - 1 + 0.7 * (within - 0.5), laps["lap_time_s"], SKY, size=5),
            points(places, lap_s["mean"], BLUE, "mean", size=11, symbol="diamond"),
            points(places, lap_s["min"], VERMILION, "best", size=12, symbol="star"),
        ]
        shown.append(("Lap times, in their order", "lap time, s", times))
    axis: dict[str, Any] = {
        "x_label": "quarter of the episodes",
        "x_names": ("1st", "2nd", "3rd", "4th"),
        "x_range": (-0.5, 3.5),
    }
    return Chart(
        name="quarters",
        title="Quarters of the training",
        caption=f"Each bar is a quarter of the {len(episodes)} episodes{view.traced} in their order. "
        f"Complete laps per quarter: {', '.join(map(str, complete))}.",
        rows=in_rows(
            [Panel(title=title, y_label=unit, layers=layers, **axis) for title, unit, layers in shown]
        ),
    )


def evaluations(view: LogView) -> Chart | None:
    """Draw the episodes of evaluations and races, beside the fastest exploring lap of the training."""
    episodes = view.evaluation_episodes
    if not len(episodes):
        return None
    names = [str(name) for name in dict.fromkeys(episodes["stream"])]
    number = episodes["stream"].astype(str).map({name: index for index, name in enumerate(names)})
    # Side by side, so that equal results do not cover each other.
    order, size = number.groupby(number).cumcount(), number.groupby(number).transform("size")
    x = number + 0.7 * ((order + 0.5) / size - 0.5)
    complete, put_back = episodes["complete"], episodes["resets"] > 0
    parts = (
        (complete & ~put_back, "complete", BLUE, "circle"),
        (complete & put_back, "complete with resets", ORANGE, "diamond"),
        (~complete, "not complete", VERMILION, "x"),
    )
    progress: list[Layer] = [
        points(x[some], episodes["progress"][some], color, name, symbol=symbol, size=8)
        for some, name, color, symbol in parts
        if some.any()
    ]
    panels = [("Progress", "per cent of the lap", progress, (0.0, 104.0))]
    times_s = [*episodes["lap_time_s"], *episodes["reset_lap_time_s"]]
    if np.isfinite(times_s).any():
        laps: list[Layer] = [
            points(x, episodes["lap_time_s"], BLUE, size=8),
            points(x, episodes["reset_lap_time_s"], ORANGE, size=8, symbol="diamond"),
        ]
        best_s = float(view.episodes["lap_time_s"].min()) if view.trained else np.nan
        if np.isfinite(best_s):
            laps.append(mark(best_s, "fastest exploring lap", GREEN, horizontal=True))
        times_s.append(best_s)
        low, high = np.nanmin(times_s), np.nanmax(times_s)
        rim = max(0.1 * (high - low), 0.1)
        panels.append(("Lap time", "lap time, s", laps, (low - rim, high + rim)))
    which = f"one of {len(names)} evaluations or races" if len(names) > 1 else "an evaluation or race"
    slower = " The fastest exploring lap is that of many."
    short = [name if len(name) <= 26 else f"{name[:17]}…{name[-8:]}" for name in names]
    axis: dict[str, Any] = {"x_names": short, "x_range": (-0.5, len(names) - 0.5)}
    return Chart(
        name="evaluations",
        title="Evaluations and races",
        caption=f"Each point is an episode of {which} on this course, in the order in which they were driven."
        + slower * view.trained,
        rows=[
            [Panel(title=title, y_label=unit, layers=layers, y_range=y_range, **axis)]
            for title, unit, layers, y_range in panels
        ],
    )


def stability(view: LogView) -> Chart | None:
    """Draw the regularity of control steps and the scatter of episode results."""
    times_ms = 1000 * view.steps["delta_time_s"].to_numpy(np.float64)
    iteration = view.steps["iteration"].to_numpy()[times_ms > 0]
    times_ms = times_ms[times_ms > 0]
    if not len(times_ms):
        return None
    lengths = histogram(np.minimum(times_ms, np.percentile(times_ms, 99.9)), least=20)
    count = int(view.steps["iteration"].max()) + 1
    part = subsample(len(times_ms), MOST_ROWS)
    high, middle = quantiles(iteration[part], times_ms[part], count, (0.95, 0.5))
    measured = np.flatnonzero(np.isfinite(middle))
    panels = [
        Panel(
            title="Length of a control step",
            x_label="ms of simulated time",
            y_label="control steps",
            layers=[
                bars(lengths.centers, lengths.counts, BLUE, width=lengths.width),
                mark(_HEALTHY_MS, "15 Hz", GREEN, in_legend=True),
                mark(_TOO_LONG_MS, "too long", VERMILION, in_legend=True),
            ],
            x_range=(0.0, max(120.0, 1.05 * float(lengths.centers[-1]))),
        ),
        Panel(
            title="The same over the training",
            x_label=ITERATION,
            y_label="ms",
            layers=[
                line(measured, high[measured], ORANGE, "95th percentile"),
                line(measured, middle[measured], BLUE, "median"),
                mark(_TOO_LONG_MS, "too long", VERMILION, horizontal=True),
            ],
            y_range=(0.0, max(1.15 * _TOO_LONG_MS, 1.05 * float(np.nanmax(high)))),
        ),
    ]
    episodes = view.episodes[view.episodes["ended"] & (not view.laps_only)]
    for column, title, unit, color in (
        ("progress", "Progress of the episodes", "per cent of the lap", BLUE),
        ("reward", "Reward of the episodes", "reward of an episode", GREEN),
    ):
        low, middle, high = quantiles(
            episodes["iteration"].to_numpy(), episodes[column], count, (0.25, 0.5, 0.75)
        )
        measured = np.flatnonzero(np.isfinite(middle))
        if len(measured):
            layers = [
                band(measured, low[measured], high[measured], color, "middle half"),
                line(measured, middle[measured], color, "median"),
            ]
            panels.append(_over_iterations(title, unit, layers))
    healthy = 100 * float((times_ms <= _TOO_LONG_MS).mean())
    return Chart(
        name="stability",
        title="Stability of simulation and training",
        caption=f"{healthy:.1f} per cent of the control steps are no longer than {_TOO_LONG_MS:.0f} ms; a simulation "
        "that cannot keep up gives the car fewer decisions per second. If the middle half stays wide while the median "
        "rises, the policy still takes risks.",
        rows=in_rows(panels),
    )


def curve_layers(table: pd.DataFrame, column: str, color: str, name: str | None) -> list[Layer]:
    """Return a column of a table of iterations as points, and its moving average as a line."""
    shown = subsample(len(table), 1000)
    x, y = table["iteration"].to_numpy()[shown], table[column].to_numpy(np.float64)
    return [
        points(x, y[shown], color, name, size=5),
        line(x, moving_average(y)[shown], color, name and "moving average of 3", width=2.5),
    ]


def _joined(table: pd.DataFrame, column: str, color: str, name: str) -> list[Layer]:
    """Return the known values of a column as points joined by a thin line."""
    rows = table[table[column].notna()]
    x, y = rows["iteration"], rows[column]
    return [line(x, y, color, width=1.0), points(x, y, color, name, size=5.5)]


def _over_iterations(title: str, unit: str, layers: Sequence[Layer]) -> Panel:
    return Panel(title=title, x_label=ITERATION, y_label=unit, layers=layers)


_CURVES: Mapping[str, tuple[str, Mapping[str, tuple[str | None, str]]]] = {
    "Driven, per cent": (
        "per cent",
        {
            "completion": ("exploring episodes, mean", BLUE),
            "eval_completion": ("evaluated usual laps, mean", ORANGE),
        },
    ),
    "Lap time": (
        "s",
        {
            "mean_lap_time_s": ("exploring laps, mean", BLUE),
            "best_lap_time_s": ("fastest exploring lap", GREEN),
            "eval_lap_time_s": ("evaluated usual laps, mean", ORANGE),
        },
    ),
    "Return of an episode, mean": ("return", {"mean_return": (None, BLUE)}),
    "Entropy of the policy": ("nats", {"entropy": (None, PURPLE)}),
}
"""Panels with their units, and their curves by column of metrics.jsonl, each with its name and colour."""


def curves_so_far(rows: Sequence[Mapping[str, Any]]) -> Chart:
    """Draw the learning curves of a run from the rows of its metrics.jsonl, at least one; of tracks their mean."""
    table = pd.DataFrame(rows)
    steps = table["env_steps"].to_numpy(np.float64) / 1000
    panels = []
    for title, (unit, curves) in _CURVES.items():
        layers: list[Layer] = []
        for column, (name, color) in curves.items():
            columns = [key for key in table if key.startswith(f"{column}/")] or [column]
            by_track = table.reindex(columns=columns).astype(float)
            # Not every iteration ends an episode on every track.
            by_track = by_track if column.startswith("eval_") else by_track.ffill()
            values = by_track.mean(axis=1, skipna=False).to_numpy()
            finite = np.isfinite(values)
            if finite.any():
                layers.append(line(steps[finite], values[finite], color, name))
        panels.append(Panel(title=title, y_label=unit, x_label="thousand control steps", layers=layers))
    return Chart(
        name="curves_so_far",
        title="How it learns",
        caption="Exploring, the policy draws its actions; evaluated, it takes the most probable ones.",
        rows=in_rows(panels),
        share_x=True,
    )


def newest_laps(shown: Sequence[TrackLines]) -> Chart:
    """Draw laps on their tracks, coloured by measured speed, on one scale."""
    speeds = np.concatenate([points[:, 2] for here in shown for points in here.lines] or [np.zeros(1)])
    # The few steps after a standing start would take half of the colours.
    colors = float(np.percentile(speeds, 5)), max(float(speeds.max()), float(np.percentile(speeds, 5)) + 0.1)
    panels = []
    for here in shown:
        layers: list[Layer] = [line(points[:, 0], points[:, 1], PALE, width=1.0) for points in here.lines]
        if here.lines:
            x, y, speed_mps = np.concatenate(here.lines).T
            layers.append(colored_points(x, y, speed_mps, "speed, m/s", size=5.0, value_range=colors))
        if len(here.boxes):
            layers.append(outlines(here.boxes, VERMILION))
        panels.append(map_panel(here.track, layers, title=f"{here.track.title}: {here.words}"))
    return Chart(
        name="newest_laps",
        title="The laps of the newest checkpoint",
        caption="One dot for each control step on the usual conditions, coloured by the speed of the car."
        + " The outlines are boxes; each lap has its own." * any(len(here.boxes) for here in shown),
        rows=in_rows(panels),
    )
