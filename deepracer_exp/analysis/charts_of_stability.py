"""How evenly the simulation ran and how evenly the training went."""

import numpy as np
import pandas as pd

from .chart import BLUE, FAINT, GREEN, ORANGE, VERMILION, Band, Bars, Chart, Layer, Line, Mark, Panel
from .charts_of_training import ITERATION, iteration_panel
from .log_view import LogView
from .statistics import histogram, percentiles_by

_HEALTHY_MS, _TOO_LONG_MS = 1000 / 15, 90.0
"""A control step's length at 15 Hz, and the 95th percentile beyond which deepracer-utils' stability check warns."""


def stability(view: LogView) -> Chart | None:
    """Draw how evenly the simulation ran and how evenly the training went."""
    steps, table = view.steps, view.iterations
    times = 1000 * steps["delta_time_s"].to_numpy(np.float64)
    iteration = steps["iteration"].to_numpy()
    driven = times > 0
    if not driven.any():
        return None
    spread = percentiles_by(iteration[driven], times[driven], (50.0, 95.0))
    lengths = histogram(np.clip(times[driven], 0, np.percentile(times[driven], 99.9)), least=20)
    length = Panel(
        title="Length of a control step",
        x_label="ms of simulated time",
        y_label="control steps",
        layers=[
            Bars(x=lengths.centers, height=lengths.counts, width=lengths.width, color=BLUE),
            Mark(at=_HEALTHY_MS, label="15 Hz", color=GREEN),
            Mark(at=_TOO_LONG_MS, label="too long", color=VERMILION),
        ],
        x_range=(0.0, max(120.0, 1.05 * float(lengths.centers[-1]))),
    )
    x = spread.index.to_numpy(np.float64)
    over_time: list[Layer] = [
        Line(x=x, y=spread[95.0].to_numpy(), name="95th percentile", color=ORANGE),
        Line(x=x, y=spread[50.0].to_numpy(), name="median", color=BLUE),
        Mark(at=_TOO_LONG_MS, label="too long", color=VERMILION, horizontal=True),
    ]
    panels = [length]
    panels.append(
        Panel(
            title="The same over the training",
            x_label=ITERATION,
            y_label="ms",
            layers=over_time,
            y_range=(0.0, max(1.15 * _TOO_LONG_MS, 1.05 * float(spread[95.0].max()))),
        )
    )
    episodes = view.episodes[view.episodes["ended"]]
    number = episodes["iteration"].to_numpy()
    for column, title, unit, color in (
        ("progress", "Progress of the episodes", "per cent of the lap", BLUE),
        ("reward", "Reward of the episodes", "reward of an episode", GREEN),
    ):
        found = percentiles_by(number, episodes[column].to_numpy(np.float64), (25.0, 50.0, 75.0))
        if not len(found):
            continue
        at = found.index.to_numpy(np.float64)
        panels.append(
            iteration_panel(
                title,
                unit,
                [
                    Band(
                        x=at,
                        low=found[25.0].to_numpy(),
                        high=found[75.0].to_numpy(),
                        name="middle half",
                        color=color,
                    ),
                    Line(x=at, y=found[50.0].to_numpy(), name="median", color=color),
                ],
            )
        )
    factor = real_time_factor(view)
    if factor is not None:
        panels.insert(2, iteration_panel("Real-time factor", "simulated s / real s", factor))
    else:
        table = table.assign(step_ms_median=table["iteration"].map(spread[50.0]))
    healthy = 100 * float((times[driven] <= _TOO_LONG_MS).mean())
    return Chart(
        name="stability",
        title="Stability of simulation and training",
        caption=f"{healthy:.1f} per cent of the control steps are no longer than {_TOO_LONG_MS:.0f} ms; a simulation "
        "that cannot keep up gives the car fewer decisions a second. A middle half that stays wide while the median "
        "rises is a policy that still gambles.",
        rows=[panels[at : at + 2] for at in range(0, len(panels), 2)],
        table=table,
    )


def real_time_factor(view: LogView) -> list[Layer] | None:
    """Return simulated over real seconds of each iteration, None where the log does not tell real time."""
    steps = view.steps
    real = np.diff(steps["wall_clock"].to_numpy(np.float64), prepend=np.nan)
    simulated = steps["delta_time_s"].to_numpy(np.float64)
    counted = (simulated > 0) & (real > 0)
    if not counted.any():
        return None
    sums = (
        pd.DataFrame({"simulated": simulated[counted], "real": real[counted]})
        .groupby(steps["iteration"].to_numpy()[counted])
        .sum()
    )
    factor = (sums["simulated"] / sums["real"]).to_numpy()
    return [
        Line(x=sums.index.to_numpy(np.float64), y=factor, color=BLUE),
        Mark(at=1.0, label="real time", color=FAINT, horizontal=True),
    ]
