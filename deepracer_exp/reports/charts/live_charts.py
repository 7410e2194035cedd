"""The figures of a page that follows a training: its curves so far, and the newest evaluation's laps."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from .figure import Chart, Layer, Panel, colored_points, in_rows, line
from .maps import map_panel, outlines
from .run_pictures import TrackLines
from .style import BLUE, GREEN, ORANGE, PALE, PURPLE, VERMILION

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
            columns = [key for key in table if key == column or key.startswith(f"{column}/")]
            # Not every iteration ends an episode on every track, or is evaluated.
            values = table[columns].astype(float).mean(axis=1).to_numpy()
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
