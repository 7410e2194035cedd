"""What the reward function paid: by place, by waypoint, by its terms, by step and by episode."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.analysis.log_view import LogView, closest_waypoints, thirds
from deepracer_exp.analysis.statistics import Values, correlation, histogram, means, quantiles, subsample

from .actions import action_classes
from .figure import Chart, Layer, Panel, band, bars, in_rows, line, mark, points
from .maps import Grid, map_panel, waypoint_panel
from .style import BLACK, BLUE, CATEGORIES, FAINT, GREEN, INK, ORANGE, PALE, VERMILION

GAMMAS = (0.9, 0.95, 0.99, 0.995, 0.999)
"""Discount factors that racers try."""
STEP_HZ = 15.0
_THIRDS = ("first third of the iterations", "second third", "last third")
_ACTIONS = 3
"""Actions that have a map of their own."""
_ROWS = 200_000
"""Rows beyond which quantiles are those of an evenly spaced part of them."""
_COMMON = 20
_FAR = 10
"""Steps from which on the share of the last step's reward sets the range of the axis."""
_MOST_EPISODES = 1500


def reward_map(view: LogView) -> Chart | None:
    """Draw the mean reward of a step over the course: all, complete laps, thirds of the training, actions."""
    rows = view.driven("X", "Y", "iteration", "reward")
    if view.course is None or not len(rows):
        return None
    course, coarse, fine = view.course, Grid.over(view.course, 3_500), Grid.over(view.course, 8_000)
    reward = rows["reward"].to_numpy(np.float64)
    third = thirds(rows["iteration"].to_numpy())
    complete = view.episodes["complete"].to_numpy(bool)
    in_lap = complete[view.episode_index][view.is_driven]
    cells = {grid: grid.of(rows["X"], rows["Y"]) for grid in (fine, coarse)}
    mean = means(cells[fine], reward, fine.count)
    inside = cells[fine][cells[fine] >= 0]
    of_steps = mean[inside[subsample(len(inside), _ROWS)]]
    of_steps = of_steps[np.isfinite(of_steps)]
    if not len(of_steps):
        return None
    # Weighted by how often cells are driven: few steps off the road would take all colours.
    low, high = (float(end) for end in np.percentile(of_steps, [1, 99]))
    colors = (low, high) if low < high else (low - 0.5, high + 0.5)

    def panel(wanted: NDArray[np.bool_], title: str, grid: Grid) -> Panel:
        values = means(np.where(wanted, cells[grid], -1), reward, grid.count)
        layer = grid.cells(values, "reward of a step", value_range=colors)
        return map_panel(course, [layer], title, numbers=grid is fine)

    top = [panel(np.ones(len(rows), bool), "all steps", fine)]
    if in_lap.any():
        top.append(panel(in_lap, f"complete laps only ({complete.sum()})", fine))
    charts = [top, [panel(third == k, title, coarse) for k, title in enumerate(_THIRDS)]]
    actions = action_classes(view)
    if actions is not None:
        used = np.bincount(actions.number[actions.number >= 0], minlength=len(actions.names))
        most = [int(k) for k in np.argsort(-used, kind="stable")[:_ACTIONS] if used[k]]
        names = {k: f"{actions.names[k]} ({100 * used[k] / used.sum():.0f} % of steps)" for k in most}
        charts.append([panel(actions.number == k, name, coarse) for k, name in names.items()])
    visits = np.bincount(inside, minlength=fine.count)
    return Chart(
        name="reward_map",
        title="What the reward function paid, by place",
        caption="Mean reward of a step in each cell, with the same colours on all maps; the lowest row shows the "
        "actions taken most often. A fast line should be the bright one: where complete laps run through dark cells, "
        "the reward asks for something other than the lap.",
        rows=charts,
        table=fine.table({"reward_mean": mean, "visits": np.where(visits > 0, visits, np.nan)}),
    )


def value_map(view: LogView) -> Chart | None:
    """Draw the discounted future reward over the course, measured in the last third."""
    rows = view.recent("X", "Y", "closest_waypoint", "discounted_future_reward")
    if view.course is None or not len(rows):
        return None
    future = rows["discounted_future_reward"].to_numpy(np.float64)
    grid = Grid.over(view.course, 12_000)
    value = means(grid.of(rows["X"], rows["Y"]), future, grid.count)
    n, waypoint, part = view.waypoint_count, closest_waypoints(rows), subsample(len(rows), _ROWS)
    low, high = quantiles(waypoint[part], future[part], n, (0.1, 0.9))
    layers: list[Layer] = [
        band(np.arange(n), low, high, BLUE, "10th to 90th percentile"),
        line(np.arange(n), means(waypoint, future, n), BLUE, "mean", width=2.0),
    ]
    return Chart(
        name="value_map",
        title="The value of a place: discounted future reward",
        caption="Mean sum of the reward of this step and of all later ones of the episode, discounted by "
        f"{view.discount:g} per step, as measured in the last third of the iterations; the critic learns to predict "
        "it. Dark places lead off the road or are close to the end of the lap, and the spread at a waypoint is what "
        "good driving is worth there.",
        rows=[
            [map_panel(view.course, [grid.cells(value, "future reward, discounted")])],
            [waypoint_panel(layers, "future reward", n)],
        ],
        table=grid.table({"discounted_future_reward": value}),
    )


def reward_by_waypoint(view: LogView) -> Chart | None:
    """Draw mean, median, best and worst reward of a step, and of all later ones, at each waypoint."""
    rows = view.driven("closest_waypoint", "reward", "discounted_future_reward")
    if not len(rows):
        return None
    n, waypoint, part = view.waypoint_count, closest_waypoints(rows), subsample(len(rows), _ROWS)
    at = np.arange(n)
    table = pd.DataFrame({"waypoint": at, "steps": np.bincount(waypoint[waypoint >= 0], minlength=n)})
    panels = []
    for column, label in (
        ("reward", "reward of a step"),
        ("discounted_future_reward", "future reward, discounted"),
    ):
        values = rows[column].to_numpy(np.float64)
        quarter, middle, three_quarters = quantiles(waypoint[part], values[part], n, (0.25, 0.5, 0.75))
        ends = pd.Series(values).groupby(waypoint).agg(["max", "min"]).reindex(range(n))
        found = {
            "mean": means(waypoint, values, n),
            "median": middle,
            "best": ends["max"],
            "worst": ends["min"],
        }
        table = table.assign(**{f"{column}_{name}": found[name] for name in found})
        usual: list[Layer] = [
            band(at, quarter, three_quarters, BLUE, "middle half"),
            line(at, found["mean"], INK, "mean", width=2.0),
            line(at, middle, ORANGE, "median", dashed=True, width=2.0),
        ]
        extremes: list[Layer] = [
            line(at, ends["max"], GREEN, "best"),
            line(at, ends["min"], VERMILION, "worst"),
        ]
        panels += [waypoint_panel(usual, label, n), waypoint_panel(extremes, label, n)]
    return Chart(
        name="reward_by_waypoint",
        title="Reward by waypoint",
        caption="What a step at each waypoint was paid over the whole training, and below it what all later steps "
        "were paid. A best far above the median marks a place where few drivers find what pays; a dip of both is a "
        "place that the reward function punishes whatever the car does.",
        rows=in_rows(panels, 1),
        share_x=True,
        table=table,
    )


def reward_terms(view: LogView, terms: pd.DataFrame) -> Chart | None:
    """Draw what the terms of the reward function contribute, by waypoint and over the training.

    Args:
        view: the recording.
        terms: one column for each term, in units of the reward; the index holds labels of rows of `view.steps`.
    """
    if terms.empty:
        return None
    rows = view.steps.loc[terms.index]
    n, waypoint, iteration = view.waypoint_count, closest_waypoints(rows), rows["iteration"].to_numpy(np.intp)
    last = int(iteration.max()) + 1
    known = np.flatnonzero(np.bincount(iteration, minlength=last))
    at = np.arange(n)
    table = pd.DataFrame({"waypoint": at})
    by_waypoint: list[Layer] = []
    by_iteration: list[Layer] = []
    curves = [("sum", "sum of all", terms.sum(axis=1), PALE, 3.5)]
    for number, name in enumerate(terms.columns):
        words = f"{str(name).replace('_', ' ')} ({terms[name].mean():.3g})"
        curves.append((str(name), words, terms[name], CATEGORIES[number % len(CATEGORIES)], 1.6))
    for name, words, values, color, width in curves:
        table[name] = means(waypoint, values, n)
        by_waypoint.append(line(at, table[name], color, words, width=width))
        by_iteration.append(line(known, means(iteration, values, last)[known], color, width=width))
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
        table=table,
    )


def reward_distribution(view: LogView) -> Chart | None:
    """Draw how rewards are distributed over steps and over episodes."""
    rewards = view.steps["reward"].to_numpy(np.float64)
    rewards = rewards[np.isfinite(rewards)]
    episodes = view.episodes[view.episodes["ended"]]
    if not len(rewards) or not len(episodes):
        return None
    low, high = np.percentile(rewards, [0.1, 99.9])
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
        caption=f"Half of the steps earn more than {np.median(rewards):.3g}, one in ten more than "
        f"{np.percentile(rewards, 90):.3g}. If complete laps do not clearly earn more than other episodes, the reward "
        f"does not ask for laps.{left_out}",
        rows=[
            [
                Panel(title="Reward of a step", x_label="reward", y_label="control steps", layers=of_steps),
                Panel(title="Reward of an episode", x_label="reward", y_label="episodes", layers=of_episodes),
            ]
        ],
        table=episodes[["iteration", "episode", "reward", "complete"]],
    )


def common_rewards(view: LogView) -> Chart | None:
    """Draw the rewards that steps earn most often."""
    counts = view.steps["reward"].dropna().round(4).value_counts()
    if not len(counts):
        return None
    common = counts.head(_COMMON).sort_index()
    share = 100 * common / counts.sum()
    hover = [f"reward {value:.4g}: {count} steps" for value, count in common.items()]
    panel = Panel(
        x_label="reward of a step",
        y_label="per cent of the control steps",
        x_names=[f"{value:.4f}".rstrip("0").rstrip(".") for value in common.index],
        layers=[bars(np.arange(len(share)), share, GREEN, hover=hover)],
    )
    return Chart(
        name="common_rewards",
        title="The most common rewards",
        caption=f"The {len(common)} most common of {len(counts)} different rewards, rounded to four digits, account "
        f"for {share.sum():.0f} per cent of all steps. A reward given in many different situations cannot teach the "
        "policy which of them is better.",
        rows=[[panel]],
        table=counts.rename("steps").reset_index(),
    )


def scatter_time_reward(view: LogView) -> Chart | None:
    """Draw reward, progress, time and steps of each episode against each other."""
    episodes = view.episodes[view.episodes["ended"]]
    if len(episodes) < 2:
        return None
    shown = episodes.iloc[subsample(len(episodes), _MOST_EPISODES)]
    panels = []
    for x, y, x_label, y_label in (
        ("progress", "reward", "progress, per cent of the lap", "reward of the episode"),
        ("time_s", "reward", "time of the episode, s", "reward of the episode"),
        ("steps", "time_s", "control steps", "time of the episode, s"),
        ("lap_time_s", "reward", "lap time of complete laps, s", "reward of the lap"),
    ):
        known = shown[shown[x].notna()]
        layers: list[Layer] = [
            points(some[x], some[y], color, name, size=3.5)
            for complete, name, color in ((False, "not complete", ORANGE), (True, "complete lap", BLUE))
            if len(some := known[known["complete"] == complete])
        ]
        if layers:
            panels.append(Panel(x_label=x_label, y_label=y_label, layers=layers))
    laps = episodes[episodes["lap_time_s"].notna()]
    r = correlation(laps["lap_time_s"].to_numpy(np.float64), laps["reward"].to_numpy(np.float64))
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
        table=episodes[["iteration", "episode", "progress", "reward", "time_s", "steps", "lap_time_s"]],
    )


def discount_factors(view: LogView) -> Chart | None:
    """Draw the weight of later rewards under several discount factors."""
    episodes = view.episodes
    if not len(episodes):
        return None
    complete = episodes["lap_time_s"].notna().any()
    lap = int(episodes["lap_time_s"].idxmin() if complete else episodes["progress"].idxmax())
    rows = view.steps[view.steps["episode"] == episodes.loc[lap, "episode"]]
    rewards = np.nan_to_num(rows["reward"].to_numpy(np.float64))
    count = len(rewards)
    ahead = np.arange(0, max(int(1.5 * count), 60), max(1, count // 150))
    remaining = np.arange(count - 1, -1, -1).astype(np.float64)
    table = pd.DataFrame({"steps_to_go": remaining})
    gammas = sorted({*GAMMAS, view.discount})
    weights: list[Layer] = []
    values: list[Layer] = []
    bonus: list[Layer] = []
    highest = 5.0
    for gamma, color in zip(gammas, (color for color in CATEGORIES if color != BLACK), strict=False):
        own, width = gamma == view.discount, 1.4
        if own:
            color, width = BLACK, 2.6
        future = discounted(rewards, gamma)
        last = rewards[-1] * gamma**remaining
        # A sum near zero has no shares.
        share = np.where(np.abs(future) > 1e-9, 100 * last / np.where(future == 0, 1, future), np.nan)
        far = share[(remaining >= _FAR) & np.isfinite(share)]
        highest = max(highest, float(far.max(initial=0.0)))
        name = f"{gamma:g}{' (this training)' if own else ''}"
        weights.append(line(ahead, 100 * gamma**ahead, color, name, width=width))
        values.append(line(remaining, future, color, width=width))
        bonus.append(line(remaining, np.clip(share, -100, 200), color, width=width))
        table[f"future_reward_{gamma:g}"] = future
    weights.append(mark(count, f"this lap: {count} steps", FAINT))
    half = np.log(0.5) / np.log(view.discount) if 0 < view.discount < 1 else np.inf
    to_go = "steps to go in the episode"
    what = "fastest lap" if complete else "episode that drove farthest"
    return Chart(
        name="discount_factors",
        title="The weight of later rewards",
        caption=f"With the discount factor of this training, {view.discount:g}, a reward counts half if it comes "
        f"{half:.0f} steps ({half / STEP_HZ:.1f} s) later. The two panels below are of the {what}: the future reward, "
        "and how much of it is the reward of the last step.",
        rows=[
            [
                Panel(
                    title="Weight of a reward",
                    x_label="steps until it comes",
                    y_label="per cent",
                    layers=weights,
                )
            ],
            [
                Panel(title="Discounted future reward", x_label=to_go, y_label="reward", layers=values),
                Panel(
                    title="Share of the last step's reward",
                    x_label=to_go,
                    y_label="per cent of the future reward",
                    layers=bonus,
                    # In the last steps it is always nearly all.
                    y_range=(0.0, min(1.1 * highest, 105.0)),
                ),
            ],
        ],
        table=table,
    )


def discounted(rewards: Values, gamma: float) -> Values:
    """Return each step's reward plus all later ones, discounted."""
    future = np.empty(len(rewards))
    total = 0.0
    for step in range(len(rewards) - 1, -1, -1):
        total = rewards[step] + gamma * total
        future[step] = total
    return future
