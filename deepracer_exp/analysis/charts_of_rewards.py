"""What the reward function paid, and where."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .action_classes import action_classes
from .cells import Grid, means, quantiles
from .chart import (
    BLUE,
    CATEGORIES,
    GREEN,
    INK,
    ORANGE,
    PALE,
    VERMILION,
    Band,
    Chart,
    Layer,
    Line,
    Panel,
    Values,
    thinned,
)
from .log_view import LogView
from .maps import (
    THIRDS,
    driven,
    episode_places,
    is_driven,
    map_panel,
    recent,
    thirds,
    waypoint_count,
    waypoints_of,
)

_PANELS = 3
"""Actions that have a map of their own."""
_ROWS = 200_000
"""Rows beyond which quantiles are those of a part of them, at even distances."""


def reward_map(view: LogView) -> Chart | None:
    """Show the mean reward of a step over the track: all, complete laps, thirds of the training, actions."""
    rows = driven(view, "X", "Y", "iteration", "reward")
    if view.course is None or not len(rows):
        return None
    grid = Grid.over(view.course, 3_500)
    fine = Grid.over(view.course, 8_000)
    reward = rows["reward"].to_numpy(np.float64)
    third = thirds(rows["iteration"].to_numpy())
    complete = view.episodes["complete"].to_numpy(bool)
    in_lap = complete[episode_places(view)][is_driven(view)]
    every = fine.of(rows["X"], rows["Y"])
    whole = means(every, reward, fine.count)
    of_steps = whole[every[every >= 0][thinned((every >= 0).sum(), _ROWS)]]
    of_steps = of_steps[np.isfinite(of_steps)]
    if not len(of_steps):
        return None
    # As often as they are driven: few steps off the road would take all colours.
    low, high = (float(end) for end in np.percentile(of_steps, [1, 99]))
    colors = (low, high) if low < high else (low - 0.5, high + 0.5)

    def panel(wanted: NDArray[np.bool_], title: str, on: Grid, places: NDArray[np.intp]) -> Panel:
        mean = means(np.where(wanted, places, -1), reward, on.count)
        layer = on.cells(mean, "reward a step", value_range=colors)
        return map_panel(view.course, [layer], title, numbers=on is fine)  # type: ignore[arg-type]

    everywhere = np.ones(len(rows), bool)
    top = [panel(everywhere, "all steps", fine, every)]
    if in_lap.any():
        top.append(panel(in_lap, f"complete laps only ({complete.sum()})", fine, every))
    coarse = grid.of(rows["X"], rows["Y"])
    charts = [top, [panel(third == k, THIRDS[k], grid, coarse) for k in range(3)]]
    actions = action_classes(view)
    if actions is not None:
        used = np.bincount(actions.number[actions.number >= 0], minlength=len(actions.names))
        most = [int(k) for k in np.argsort(-used, kind="stable")[:_PANELS] if used[k]]
        charts.append(
            [
                panel(
                    actions.number == k,
                    f"{actions.names[k]} ({100 * used[k] / used.sum():.0f} % of steps)",
                    grid,
                    coarse,
                )
                for k in most
            ]
        )
    visits = np.bincount(every[every >= 0], minlength=fine.count)
    return Chart(
        name="reward_map",
        title="What the reward function paid, place by place",
        caption="Mean reward of a step in each cell, in one scale of colours on all maps; the lowest row "
        "shows the actions taken most often. A fast line ought to be the bright one: where "
        "complete laps run through dark cells, the reward asks for something else than the lap.",
        rows=charts,
        table=fine.table({"reward_mean": whole, "visits": np.where(visits > 0, visits, np.nan)}),
    )


def value_map(view: LogView) -> Chart | None:
    """Show the value of places: the discounted reward that was still to come, measured in the last third."""
    if view.course is None:
        return None
    rows = recent(view, "X", "Y", "closest_waypoint", "discounted_future_reward")
    if not len(rows):
        return None
    future = rows["discounted_future_reward"].to_numpy(np.float64)
    grid = Grid.over(view.course, 12_000)
    value = means(grid.of(rows["X"], rows["Y"]), future, grid.count)
    n = waypoint_count(view)
    waypoint = waypoints_of(rows)
    part = thinned(len(rows), _ROWS)
    low, high = quantiles(waypoint[part], future[part], n, (0.1, 0.9))
    at = np.arange(n, dtype=np.float64)
    return Chart(
        name="value_map",
        title="The value of being there: discounted reward still to come",
        caption="Mean sum of this and all later rewards of the episode, each step discounted by "
        f"{view.discount:g}, as measured in the last third of the iterations; it is what the "
        "critic learns to predict. Dark places lead off the road or close to the end of the lap, "
        "and the spread at a waypoint is what good driving is worth there.",
        rows=[
            [map_panel(view.course, [grid.cells(value, "reward still to come, discounted")])],
            [
                Panel(
                    layers=[
                        Band(x=at, low=low, high=high, name="10th to 90th percentile", color=BLUE),
                        Line(x=at, y=means(waypoint, future, n), name="mean", color=BLUE, width=2.0),
                    ],
                    x_label="waypoint",
                    y_label="reward to come",
                    x_range=(-1.0, float(n)),
                )
            ],
        ],
        table=grid.table({"discounted_future_reward": value}),
    )


def reward_by_waypoint(view: LogView) -> Chart | None:
    """Show mean, median, best and worst reward of a step, and of what followed it, at each waypoint."""
    rows = driven(view, "closest_waypoint", "reward", "discounted_future_reward")
    if not len(rows):
        return None
    n = waypoint_count(view)
    waypoint = waypoints_of(rows)
    part = thinned(len(rows), _ROWS)
    at = np.arange(n, dtype=np.float64)
    table = pd.DataFrame(
        {"waypoint": np.arange(n), "steps": np.bincount(waypoint[waypoint >= 0], minlength=n)}
    )
    panels = []
    for column, label in (
        ("reward", "reward of a step"),
        ("discounted_future_reward", "reward to come, discounted"),
    ):
        values = rows[column].to_numpy(np.float64)
        quarter, middle, three_quarters = quantiles(waypoint[part], values[part], n, (0.25, 0.5, 0.75))
        mean, (worst, best) = means(waypoint, values, n), _extremes(waypoint, values, n)
        found = {"mean": mean, "median": middle, "best": best, "worst": worst}
        table = table.assign(**{f"{column}_{name}": curve for name, curve in found.items()})
        usual: list[Layer] = [
            Band(x=at, low=quarter, high=three_quarters, name="middle half", color=BLUE),
            Line(x=at, y=mean, name="mean", color=INK, width=2.0),
            Line(x=at, y=middle, name="median", color=ORANGE, dashed=True, width=2.0),
        ]
        ends: list[Layer] = [
            Line(x=at, y=best, name="best", color=GREEN),
            Line(x=at, y=worst, name="worst", color=VERMILION),
        ]
        panels += [_by_waypoint(usual, label, n), _by_waypoint(ends, label, n)]
    return Chart(
        name="reward_by_waypoint",
        title="Reward by waypoint",
        caption="What a step at each waypoint was paid over the whole training, and below it what was "
        "still to come from there. A best far above the median marks a place where few know what "
        "pays; a dip of both is a place that the reward function punishes whatever the car does.",
        rows=[[panel] for panel in panels],
        share_x=True,
        table=table,
    )


def reward_terms(view: LogView, terms: pd.DataFrame) -> Chart | None:
    """Show what the terms of the reward function contribute, by waypoint and over the training.

    Args:
        view: what was recorded.
        terms: one column a term, reward units; its index are row labels of `view.steps`, of all of them or a part.
    """
    if terms.empty:
        return None
    rows = view.steps.loc[terms.index]
    n = waypoint_count(view)
    waypoint = waypoints_of(rows)
    total = terms.sum(axis=1).to_numpy(np.float64)
    at = np.arange(n, dtype=np.float64)
    iteration = rows["iteration"].to_numpy(np.intp)
    last = int(iteration.max()) + 1
    known = np.flatnonzero(np.bincount(iteration, minlength=last))
    by_waypoint = [Line(x=at, y=means(waypoint, total, n), name="sum of all", color=PALE, width=3.5)]
    by_iteration = [
        Line(
            x=known.astype(np.float64),
            y=means(iteration, total, last)[known],
            name=None,
            color=PALE,
            width=3.5,
        )
    ]
    table = pd.DataFrame({"waypoint": np.arange(n), "sum": by_waypoint[0].y})
    for name, color in zip(terms.columns, _many_colors(len(terms.columns)), strict=True):
        values = terms[name].to_numpy(np.float64)
        mean = means(waypoint, values, n)
        words = f"{str(name).replace('_', ' ')} ({values.mean():.3g})"
        by_waypoint.append(Line(x=at, y=mean, name=words, color=color))
        curve = means(iteration, values, last)[known]
        by_iteration.append(Line(x=known.astype(np.float64), y=curve, color=color))
        table[str(name)] = mean
    return Chart(
        name="reward_terms",
        title="What the terms of the reward function contribute",
        caption="Mean of each term of the reward by waypoint, and below it by iteration; the number in "
        "brackets is the mean over all steps shown. A term that is flat or lost under another one "
        "teaches nothing: change its weight or take it out.",
        rows=[
            [
                Panel(
                    layers=by_waypoint,
                    x_label="waypoint",
                    y_label="reward of a step",
                    x_range=(-1.0, float(n)),
                )
            ],
            [Panel(layers=by_iteration, x_label="iteration", y_label="reward of a step")],
        ],
        table=table,
    )


def _by_waypoint(layers: Sequence[Layer], label: str, n: int) -> Panel:
    return Panel(layers=layers, x_label="waypoint", y_label=label, x_range=(-1.0, float(n)))


def _extremes(place: NDArray[np.intp], values: Values, n: int) -> tuple[Values, Values]:
    """Return lowest and highest value at each of n places; NaN where none is known."""
    groups = pd.Series(values).groupby(place)
    found = groups.agg(["min", "max"]).reindex(range(n))
    return found["min"].to_numpy(np.float64), found["max"].to_numpy(np.float64)


def _many_colors(count: int) -> list[str]:
    return [CATEGORIES[k % len(CATEGORIES)] for k in range(count)]
