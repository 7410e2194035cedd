"""The rewards that a function returned: by place, by waypoint, by its terms, by step and by episode."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.reports.tables.log_view import LogView, closest_waypoints, thirds
from deepracer_exp.reports.tables.reward_replay import ReplayedRewards
from deepracer_exp.reports.tables.statistics import (
    MOST_ROWS,
    Values,
    histogram,
    lowest_and_highest,
    means,
    quantiles,
    subsample,
)

from .action_charts import action_classes
from .figure import Chart, Layer, Panel, band, bars, color_range, colored_points, in_rows, line, mark, points
from .maps import Grid, map_panel, waypoint_panel
from .style import BLACK, BLUE, CATEGORIES, FAINT, GREEN, INK, ORANGE, PALE, VERMILION

GAMMAS = (0.9, 0.95, 0.99, 0.995, 0.999)
"""Discount factors that racers try."""
STEP_HZ = 15.0
_THIRDS = ("first third of the iterations", "second third", "last third")
_ACTIONS = 3
"""Actions that have a map of their own."""
_COMMON = 20
_MOST_EPISODES = 1500


def reward_map(view: LogView) -> Chart | None:
    """Draw the mean reward of a step over the course: all, complete laps, thirds of the training, actions."""
    rows = view.driven("X", "Y", "iteration", "reward")
    if view.course is None or not len(rows):
        return None
    course, coarse, fine = view.course, Grid.over(view.course, 3_500), Grid.over(view.course, 8_000)
    reward = rows["reward"].to_numpy(np.float64)
    cells = {grid: grid.of(rows["X"], rows["Y"]) for grid in (fine, coarse)}
    inside = cells[fine][cells[fine] >= 0]
    mean = means(cells[fine], reward, fine.count)
    of_steps = mean[inside[subsample(len(inside), MOST_ROWS)]]
    if not np.isfinite(of_steps).any():
        return None
    # Weighted by how often cells are driven: few steps off the road would take all colours.
    colors = color_range(of_steps)

    def panel(values: Values, title: str, grid: Grid) -> Panel:
        layer = grid.cells(values, "reward of a step", value_range=colors)
        return map_panel(course, [layer], title, numbers=grid is fine)

    def row(kind: NDArray[np.intp], titles: Sequence[str]) -> list[Panel]:
        """Return a panel of the rows of each kind, 0, 1, ...; -1 has none."""
        place = kind * coarse.count + cells[coarse]
        place[(kind < 0) | (cells[coarse] < 0)] = -1
        values = means(place, reward, len(titles) * coarse.count).reshape(len(titles), -1)
        return [panel(values[k], title, coarse) for k, title in enumerate(titles)]

    complete = view.episodes["complete"].to_numpy(bool)
    charts = [[panel(mean, "all steps", fine)], row(thirds(rows["iteration"].to_numpy()), _THIRDS)]
    if complete.any():
        in_lap = np.where(complete[view.episode_index][view.is_driven], cells[fine], -1)
        values = means(in_lap, reward, fine.count)
        charts[0].append(panel(values, f"complete laps only ({complete.sum()})", fine))
    actions = action_classes(view)
    if actions is not None:
        used = np.bincount(actions.number[actions.number >= 0], minlength=len(actions.names))
        most = np.argsort(-used, kind="stable")[:_ACTIONS]
        kind = np.full(len(used) + 1, -1, np.intp)  # the last one is of rows without an action
        kind[most] = np.arange(len(most))
        titles = [f"{actions.names[k]} ({100 * used[k] / used.sum():.0f}% of steps)" for k in most]
        charts.append(row(kind[actions.number], titles))
    return Chart(
        name="reward_map",
        title="Reward by place",
        caption="Mean reward of a step in each cell, with the same colours on all maps; the lowest row shows the "
        "actions taken most often. A fast line should be the bright one: where complete laps run through dark cells, "
        "the reward asks for something other than the lap.",
        rows=charts,
    )


def value_map(view: LogView) -> Chart | None:
    """Draw the discounted future reward over the course, measured in the last third."""
    rows = view.recent("X", "Y", "closest_waypoint", "discounted_future_reward")
    if view.course is None or not len(rows):
        return None
    future = rows["discounted_future_reward"].to_numpy(np.float64)
    cells = Grid.over(view.course, 12_000).means(rows, future, "future reward, discounted")
    n, waypoint, part = view.waypoint_count, closest_waypoints(rows), subsample(len(rows), MOST_ROWS)
    low, high = quantiles(waypoint[part], future[part], n, (0.1, 0.9))
    layers = [
        band(np.arange(n), low, high, BLUE, "10th to 90th percentile"),
        line(np.arange(n), means(waypoint, future, n), BLUE, "mean", width=2.5),
    ]
    return Chart(
        name="value_map",
        title="The value of a place: discounted future reward",
        caption="Mean sum of the reward of this step and of all later ones of the episode, discounted by "
        f"{view.discount:g} per step, as measured in the last third of the iterations; the critic learns to predict "
        "it. Dark places lead off the road or are close to the end of the lap, and the spread at a waypoint is what "
        "good driving gains there.",
        rows=[
            [map_panel(view.course, [cells])],
            [waypoint_panel(layers, "future reward", n)],
        ],
    )


def reward_by_waypoint(view: LogView) -> Chart | None:
    """Draw mean, median, best and worst reward of a step, and of all later ones, at each waypoint."""
    rows = view.driven("closest_waypoint", "reward", "discounted_future_reward")
    if not len(rows):
        return None
    n, waypoint, part = view.waypoint_count, closest_waypoints(rows), subsample(len(rows), MOST_ROWS)
    waypoints = np.arange(n)
    panels = []
    for column, label in (
        ("reward", "reward of a step"),
        ("discounted_future_reward", "future reward, discounted"),
    ):
        values = rows[column].to_numpy(np.float64)
        quarter, median, three_quarters = quantiles(waypoint[part], values[part], n, (0.25, 0.5, 0.75))
        worst, best = lowest_and_highest(waypoint, values, n)
        usual: list[Layer] = [
            band(waypoints, quarter, three_quarters, BLUE, "middle half"),
            line(waypoints, means(waypoint, values, n), INK, "mean", width=2.5),
            line(waypoints, median, ORANGE, "median", dashed=True, width=2.5),
        ]
        extremes = [
            line(waypoints, best, GREEN, "best"),
            line(waypoints, worst, VERMILION, "worst"),
        ]
        panels += [waypoint_panel(usual, label, n), waypoint_panel(extremes, label, n)]
    return Chart(
        name="reward_by_waypoint",
        title="Reward by waypoint",
        caption="The reward of a step at each waypoint over the whole training, and below it the sum of all later "
        "rewards. A best far above the median marks a place where few episodes find the reward; a dip of both is a "
        "place that the reward function punishes whatever the car does.",
        rows=in_rows(panels, 1),
        share_x=True,
    )


def reward_terms(view: LogView, terms: pd.DataFrame) -> Chart | None:
    """Draw the contributions of the reward function's terms, by waypoint and over the training.

    `terms` has a column for each term, in units of the reward; its index holds labels of rows of `view.steps`.
    """
    if terms.empty:
        return None
    rows = view.steps.loc[terms.index]
    n, waypoint, iteration = view.waypoint_count, closest_waypoints(rows), rows["iteration"].to_numpy(np.intp)
    last = int(iteration.max()) + 1
    iterations = np.unique(iteration)
    waypoints = np.arange(n)
    by_waypoint: list[Layer] = []
    by_iteration: list[Layer] = []
    curves = [("sum of all", terms.sum(axis=1), PALE, 4.5)]
    for number, name in enumerate(terms.columns):
        words = f"{str(name).replace('_', ' ')} ({terms[name].mean():.3g})"
        curves.append((words, terms[name], CATEGORIES[number % len(CATEGORIES)], 2.0))
    for words, values, color, width in curves:
        by_waypoint.append(line(waypoints, means(waypoint, values, n), color, words, width=width))
        by_iteration.append(line(iterations, means(iteration, values, last)[iterations], color, width=width))
    unit = "reward of a step"
    return Chart(
        name="reward_terms",
        title="What the terms of the reward function contribute",
        caption="Mean of each term of the reward by waypoint, and below it by iteration; the number in brackets is "
        "the mean over all steps shown. A term that is flat or much smaller than another one teaches nothing: change "
        "its weight or remove it.",
        rows=[
            [waypoint_panel(by_waypoint, unit, n)],
            [Panel(layers=by_iteration, x_label="iteration", y_label=unit)],
        ],
    )


def reward_distribution(view: LogView) -> Chart | None:
    """Draw the distributions of rewards over steps and over episodes."""
    if view.laps_only:
        return None
    rewards = view.driven("reward")["reward"].dropna().to_numpy(np.float64)
    episodes = view.episodes[view.episodes["ended"]]
    if not len(rewards) or not len(episodes):
        return None
    low, median, most, high = np.percentile(rewards, [0.1, 50.0, 90.0, 99.9])
    inside = rewards[(rewards >= low) & (rewards <= high)]
    steps = histogram(inside, least=20)
    sums, complete = episodes["reward"].to_numpy(np.float64), episodes["complete"].to_numpy(bool)
    bins = histogram(sums, least=20)
    place = np.clip(((sums - bins.centers[0]) / bins.width).round().astype(int), 0, len(bins.centers) - 1)
    others, laps = (np.bincount(place[which], minlength=len(bins.centers)) for which in (~complete, complete))
    of_steps = [bars(steps.centers, steps.counts, GREEN, width=steps.width)]
    of_episodes = [
        bars(bins.centers, others, ORANGE, "not complete", width=bins.width),
        bars(bins.centers, laps, BLUE, "complete laps", base=others, width=bins.width),
    ]
    outside = len(rewards) - len(inside)
    left_out = f" {outside} steps beyond the percentiles 0.1 and 99.9 are not drawn." if outside else ""
    return Chart(
        name="reward_distribution",
        title="Rewards of steps and of episodes",
        caption=f"Half of the steps earn at least {median:.3g}, one in ten at least {most:.3g}. If complete laps do "
        "not clearly earn more than other episodes, the reward "
        f"does not ask for laps.{left_out}",
        rows=[
            [
                Panel(title="Reward of a step", x_label="reward", y_label="control steps", layers=of_steps),
                Panel(title="Reward of an episode", x_label="reward", y_label="episodes", layers=of_episodes),
            ]
        ],
    )


def common_rewards(view: LogView) -> Chart | None:
    """Draw the rewards that steps earn most often."""
    counts = view.driven("reward")["reward"].dropna().round(4).value_counts()
    if not len(counts):
        return None
    common = counts.head(_COMMON).sort_index()
    share = 100 * common / counts.sum()
    panel = Panel(
        x_label="reward of a step",
        y_label="per cent of the control steps",
        x_names=[f"{value:.4f}".rstrip("0").rstrip(".") for value in common.index],
        layers=[bars(np.arange(len(share)), share, GREEN)],
    )
    return Chart(
        name="common_rewards",
        title="The most common rewards",
        caption=f"The {len(common)} most common of {len(counts)} different rewards, rounded to four digits, account "
        f"for {share.sum():.0f} per cent of all steps. A reward given in many different situations cannot teach the "
        "policy which of them is better.",
        rows=[[panel]],
    )


def scatter_time_reward(view: LogView) -> Chart | None:
    """Draw reward, progress, time and steps of each episode against each other."""
    episodes = view.episodes[view.episodes["ended"]]
    if view.laps_only or len(episodes) < 2:
        return None
    shown = episodes.iloc[subsample(len(episodes), _MOST_EPISODES)]
    panels = []
    for x, y, x_label, y_label in (
        ("progress", "reward", "progress, per cent of the lap", "reward of the episode"),
        ("time_s", "reward", "time of the episode, s", "reward of the episode"),
        ("steps", "time_s", "control steps", "time of the episode, s"),
        ("lap_time_s", "reward", "lap time of complete laps, s", "reward of the lap"),
    ):
        rows = shown[shown[x].notna()]
        layers: list[Layer] = [
            points(some[x], some[y], color, name, size=5.0)
            for complete, name, color in ((False, "not complete", ORANGE), (True, "complete lap", BLUE))
            if len(some := rows[rows["complete"] == complete])
        ]
        if layers:
            panels.append(Panel(x_label=x_label, y_label=y_label, layers=layers))
    r = view.comparable["lap_time_s"].corr(view.comparable["reward"], min_periods=3)
    words = (
        f"Lap time and reward of complete laps correlate with r = {r:+.2f}: below zero, the reward asks for speed."
        if np.isfinite(r)
        else "There are too few complete laps to say whether the reward asks for speed."
    )
    part = f" {len(shown)} of {len(episodes)} episodes are drawn." if len(shown) < len(episodes) else ""
    return Chart(
        name="scatter_time_reward",
        title="Episodes: reward, progress and time",
        caption="Each point is an episode; a reward that grows steadily with progress is easy to learn from. "
        f"{words}{part}",
        rows=in_rows(panels),
    )


def discount_factors(view: LogView) -> Chart | None:
    """Draw the weight of later rewards under several discount factors."""
    episodes = view.episodes
    if not len(episodes):
        return None
    complete = bool(episodes["lap_time_s"].notna().any())
    longest = view.comparable["lap_time_s"].idxmin() if complete else episodes["progress"].idxmax()
    count = int(episodes.loc[longest, "steps"])
    ahead = np.arange(0, max(int(1.5 * count), 60), max(1, count // 150))
    layers: list[Layer] = []
    colors = (color for color in CATEGORIES if color != BLACK)
    logged = "discount_factor" in (view.recording.hyperparameters or {})
    whose = "this training" if logged else "the service's default"
    for gamma, color in zip(sorted({*GAMMAS, view.discount}), colors, strict=False):
        is_used = gamma == view.discount
        name = f"{gamma:g}{f' ({whose})' if is_used else ''}"
        layers.append(
            line(ahead, 100 * gamma**ahead, BLACK if is_used else color, name, width=3.2 if is_used else 1.75)
        )
    what = "the fastest lap" if complete else "the longest drive"
    layers.append(mark(count, f"{what}: {count} steps", FAINT, in_legend=True))
    words = "rewards count the same however late they come."
    if view.discount < 1:
        half = np.log(0.5) / np.log(max(view.discount, 1e-9))
        words = (
            f"a reward counts half if it comes {half:.0f} steps ({half / STEP_HZ:.1f} s) later. Rewards far beyond "
            "that, such as a bonus at the end of the lap, hardly reach the decisions of its beginning."
        )
    return Chart(
        name="discount_factors",
        title="The weight of later rewards",
        caption=f"With a discount factor of {view.discount:g} ({whose}), {words}",
        rows=[[Panel(x_label="steps until a reward comes", y_label="weight, per cent", layers=layers)]],
    )


def replayed_charts(replayed: ReplayedRewards) -> list[Chart]:
    """Draw the laps and the places of rewards replayed by another function, as far as there are any."""
    charts = [_replayed_laps(replayed)] if len(replayed.laps) else []
    return [*charts, _replayed_places(replayed)] if len(replayed.places) else charts


def _replayed_laps(replayed: ReplayedRewards) -> Chart:
    laps = replayed.laps
    hover = [
        f"episode {row.episode}: {row.time_s:.2f} s\nranks {row.new_rank} new, {row.rank} recorded"
        for row in laps.itertuples()
    ]
    panels = [
        Panel(
            layers=[points(laps["time_s"], laps[column], color, size=9.0, hover=hover)],
            x_label="lap time, s",
            y_label="reward of the lap",
            title=title,
        )
        for column, color, title in (("reward", ORANGE, "recorded"), ("new_reward", BLUE, replayed.reward))
    ]
    return Chart(
        name="replayed_laps",
        title="The rewards of fast laps",
        caption="Each point is a complete lap, with its lap time and the sum of its rewards. A reward that asks "
        "for speed falls from the left to the right; where slow laps return as much as fast ones, the car has no "
        "reason to be faster.",
        rows=[panels],
    )


def _replayed_places(replayed: ReplayedRewards) -> Chart:
    places, course = replayed.places, replayed.course
    waypoint = places["closest_waypoint"].to_numpy(np.intp)
    lines = [
        line(waypoint, 100 * places[column], color, label)
        for column, color, label in (("share", ORANGE, "recorded"), ("new_share", BLUE, replayed.reward))
    ]
    rows = [[Panel(layers=lines, x_label="waypoint", y_label="per cent of its range", y_range=(-4.0, 104.0))]]
    if waypoint.max() < len(course.waypoints):
        change = 100 * places["change"]
        reach = float(change.abs().max()) or 1.0
        x, y = course.waypoints[waypoint].T
        scale = "change, % of the range"
        spots = colored_points(x, y, change, scale, value_range=(-reach, reach), size=11.0)
        rows.append([map_panel(course, [spots])])
    return Chart(
        name="replayed_places",
        title="Where the new reward is higher, and where lower",
        caption="Mean reward of a step at each waypoint, between the lowest and the highest of each function "
        "(2nd and 98th percentile of the waypoints). The curves differ at places that the new reward considers "
        "more or less important than the recorded one does.",
        rows=rows,
    )
