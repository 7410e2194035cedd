"""Figures of a physical car's drive over time: what its model was sure of, what it commanded, and how fast."""

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.analysis.car_drive import UNSURE, Decisions, action_names, in_order, lead
from deepracer_exp.aws.logs.car_log import CarLog

from .figure import Chart, Layer, Panel, heatmap, line, mark
from .style import BLUE, ORANGE, PALE, VERMILION

_MOST_COLUMNS = 1500
"""Columns of a heat map; of more pictures, some are drawn as one."""
_TIME = "time, s"


def drive_charts(log: CarLog, policy: Decisions | None = None) -> list[Chart]:
    """Return all figures of a drive for which there is data."""
    charts = [probabilities(log, policy), commands(log, policy), pace(log)]
    return [chart for chart in charts if chart is not None]


def probabilities(log: CarLog, policy: Decisions | None) -> Chart | None:
    """Draw the probability of each action over time, and the lead of the likeliest; None for continuous actions."""
    if not log.is_discrete:
        return None
    order = in_order(log)
    panels = [_actions(log, log.outputs[:, order], "on the car", order)]
    if policy is not None and policy.outputs.shape == log.outputs.shape:
        panels.append(_actions(log, policy.outputs[:, order], policy.name, order))
    sure: list[Layer] = [
        line(log.time_s, lead(log), BLUE, width=1.2),
        mark(UNSURE, "hesitates below", VERMILION, horizontal=True),
    ]
    panels.append(
        Panel(layers=sure, x_label=_TIME, y_label="lead of the likeliest action", y_range=(0.0, 1.0))
    )
    return Chart(
        name="drive_probabilities",
        title="How sure the model was of each action",
        caption="Actions from left to right as the car steers them, from top to bottom; those that it never took "
        "have a number only. Where two rows are alike the policy hesitates, and the car may swing between them.",
        rows=[[panel] for panel in panels],
        share_x=True,
    )


def commands(log: CarLog, policy: Decisions | None) -> Chart | None:
    """Draw steering and throttle over time, beside those of a policy; None where neither is known."""
    if policy is None and not np.isfinite(log.steering).any():
        return None
    rows = []
    for label, driven, other, bounds in (
        (
            "steering, % of full lock, left up",
            log.steering,
            None if policy is None else policy.steering,
            (-105.0, 105.0),
        ),
        ("throttle, %", log.throttle, None if policy is None else policy.throttle, (0.0, 105.0)),
    ):
        layers: list[Layer] = []
        if other is not None:
            layers.append(line(log.time_s, 100 * other, ORANGE, policy.name if policy else None, width=1.2))
        layers.append(line(log.time_s, 100 * driven, BLUE, "the car", width=1.4))
        rows.append([Panel(layers=layers, x_label=_TIME, y_label=label, y_range=bounds)])
    beside = (
        " The other policy decides on the pictures of this drive: where it would have steered otherwise, it would not "
        "have seen the pictures that follow. Its throttle is that of a maximum speed of 100%."
    )
    return Chart(
        name="drive_commands",
        title="What the car did",
        caption="As the car commanded it, with the maximum speed of its console. Steering that jumps between the two "
        "sides on a straight is zig-zag." + beside * (policy is not None),
        rows=rows,
        share_x=True,
    )


def pace(log: CarLog) -> Chart | None:
    """Draw the time between pictures and from each to its command; None of a single picture."""
    if len(log) < 2:
        return None
    layers: list[Layer] = [line(log.time_s[1:], 1000 * np.diff(log.time_s), PALE, "between two pictures")]
    if np.isfinite(log.latency_s).any():
        layers.append(
            line(log.time_s, 1000 * log.latency_s, BLUE, "from the picture to its command", width=1.2)
        )
    return Chart(
        name="drive_pace",
        title="How fast the car saw and decided",
        caption="Peaks are pictures that are missing, or a processor that was busy with something else: the car drove "
        "on with its last command meanwhile.",
        rows=[[Panel(layers=layers, x_label=_TIME, y_label="ms")]],
    )


def _actions(log: CarLog, outputs: NDArray[np.float64], title: str, order: NDArray[np.intp]) -> Panel:
    """Return the probabilities (n, k), sorted as `order`, as cells; the first action is at the top."""
    parts = np.array_split(np.arange(len(log)), min(len(log), _MOST_COLUMNS))
    shown = np.stack([outputs[part].mean(axis=0) for part in parts], axis=1)
    time_s = np.array([log.time_s[part].mean() for part in parts])
    names = [action_names(log)[number] for number in order]
    cells = heatmap(time_s, np.arange(len(names)), 100 * shown, "% probability", value_range=(0.0, 100.0))
    return Panel(layers=[cells], x_label=_TIME, title=title, y_names=names)
