"""What episodes begin with, what they earn, and what later rewards are worth."""

import numpy as np
import pandas as pd

from .chart import (
    BLACK,
    BLUE,
    CATEGORIES,
    FAINT,
    GREEN,
    ORANGE,
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
from .log_view import LogView
from .statistics import Histogram, correlation, histogram

GAMMAS = (0.9, 0.95, 0.99, 0.995, 0.999)
"""Discount factors that racers try."""
_STARTS = 20
"""Places of a lap in which starts are counted together, where they are more."""
_COMMON = 20
_FAR = 10
_MOST_EPISODES = 1500
STEP_HZ = 15.0


def start_position(view: LogView) -> Chart | None:
    """Draw how far and how fast episodes come from each place of the start."""
    ended = view.episodes["ended"].to_numpy(bool)
    episodes = view.episodes[ended]
    if len(episodes) < 2:
        return None
    place = start_places(view)[ended]
    tries = pd.DataFrame(
        {
            "at": place,
            "progress": episodes["progress"].to_numpy(np.float64),
            "complete": episodes["complete"].to_numpy(bool),
            "lap_time_s": episodes["lap_time_s"].to_numpy(np.float64),
        }
    )
    places = np.unique(place.round(1))
    if len(places) < 2:
        return None
    # Starts that are meant to be one place differ by where the car settles.
    width = 100.0 / _STARTS
    tries["at"] = (place + width / 2) % 100.0 - width / 2
    tries["bin"] = (np.floor(place / width + 0.5) % _STARTS) * width
    groups = tries.groupby("bin")
    table = pd.DataFrame(
        {
            "episodes": groups.size(),
            "completion_mean": groups["progress"].mean(),
            "lap_share": groups["complete"].mean(),
            "lap_time_mean_s": groups["lap_time_s"].mean(),
            "lap_time_best_s": groups["lap_time_s"].min(),
        }
    )
    if len(table) < 2:
        return None
    x = table.index.to_numpy(np.float64)
    where = "start, per cent of the track from waypoint 0"

    def bars(title: str, unit: str, values: pd.Series, color: str) -> Panel:
        layer = Bars(x=x, height=values.to_numpy(np.float64), width=0.82 * width, color=color)
        return Panel(title=title, x_label=where, y_label=unit, layers=[layer])

    panels = [
        bars("Progress, mean", "per cent of the lap", table["completion_mean"], BLUE),
        bars("Complete laps", "per cent of the episodes", 100 * table["lap_share"], GREEN),
    ]
    if tries["lap_time_s"].notna().any():
        laps = tries[tries["lap_time_s"].notna()]
        laps = laps.iloc[thinned(len(laps), _MOST_EPISODES)]
        timed: list[Layer] = [
            Points(
                x=laps["at"].to_numpy(np.float64),
                y=laps["lap_time_s"].to_numpy(np.float64),
                color=SKY,
                size=3.5,
            ),
            Points(
                x=x,
                y=table["lap_time_mean_s"].to_numpy(np.float64),
                name="mean",
                color=BLUE,
                symbol="diamond",
                size=7,
            ),
            Points(
                x=x,
                y=table["lap_time_best_s"].to_numpy(np.float64),
                name="best",
                color=VERMILION,
                symbol="star",
                size=8,
            ),
        ]
        panels.append(Panel(title="Lap times", x_label=where, y_label="lap time, s", layers=timed))
    panels.append(bars("Episodes", "episodes", table["episodes"], FAINT))
    worst, best = table["completion_mean"].idxmin(), table["completion_mean"].idxmax()
    return Chart(
        name="start_position",
        title="What the place of the start does",
        caption=f"Episodes from {worst:.0f} per cent of the track come least far, "
        f"{table['completion_mean'][worst]:.0f} per cent of a lap, those from {best:.0f} per cent farthest, "
        f"{table['completion_mean'][best]:.0f} per cent. The fewer episodes a place has, the more of that is chance.",
        rows=[panels[at : at + 2] for at in range(0, len(panels), 2)],
        table=table.reset_index(names="start"),
    )


def start_places(view: LogView) -> Values:
    """Return where each episode began, per cent of the track from waypoint 0."""
    first = view.steps.drop_duplicates(["stream", "episode"])
    at = (first["lap_position"] - first["progress"] / 100.0).to_numpy(np.float64)
    return 100.0 * (at % 1.0)


def reward_distribution(view: LogView) -> Chart | None:
    """Draw how rewards are distributed over steps and over episodes."""
    rewards = view.steps["reward"].to_numpy(np.float64)
    rewards = rewards[np.isfinite(rewards)]
    episodes = view.episodes[view.episodes["ended"]]
    if not len(rewards) or not len(episodes):
        return None
    low, high = np.percentile(rewards, [0.1, 99.9])
    outside = int(((rewards < low) | (rewards > high)).sum())
    inside = rewards[(rewards >= low) & (rewards <= high)]
    of_steps = _bars("Reward of a step", "control steps", histogram(inside, least=20))
    sums = episodes["reward"].to_numpy(np.float64)
    bins = histogram(sums, least=20)
    complete = episodes["complete"].to_numpy(bool)
    place = np.clip(((sums - bins.centers[0]) / bins.width).round().astype(int), 0, len(bins.centers) - 1)
    others, laps = (
        np.bincount(place[which], minlength=len(bins.centers)).astype(np.float64)
        for which in (~complete, complete)
    )
    parts: list[Layer] = [
        Bars(x=bins.centers, height=others, width=bins.width, name="not complete", color=ORANGE),
        Bars(x=bins.centers, height=laps, base=others, width=bins.width, name="complete laps", color=BLUE),
    ]
    of_episodes = Panel(title="Reward of an episode", x_label="reward", y_label="episodes", layers=parts)
    left_out = f" {outside} steps beyond the percentiles 0.1 and 99.9 are not drawn." if outside else ""
    return Chart(
        name="reward_distribution",
        title="Rewards of steps and of episodes",
        caption=f"Half of the steps earn more than {np.median(rewards):.3g}, one in ten more than "
        f"{np.percentile(rewards, 90):.3g}. Where complete laps do not earn clearly more than the others, the reward "
        f"does not ask for laps.{left_out}",
        rows=[[of_steps, of_episodes]],
        table=episodes[["iteration", "episode", "reward", "complete"]],
    )


def _bars(title: str, unit: str, found: Histogram) -> Panel:
    layer = Bars(x=found.centers, height=found.counts, width=found.width, color=GREEN)
    return Panel(title=title, x_label="reward", y_label=unit, layers=[layer])


def common_rewards(view: LogView) -> Chart | None:
    """Draw the rewards that steps earn most often."""
    counts = view.steps["reward"].dropna().round(4).value_counts()
    if not len(counts):
        return None
    common = counts.head(_COMMON).sort_index()
    share = 100 * common / counts.sum()
    distinct = len(counts)
    return Chart(
        name="common_rewards",
        title="The most common rewards",
        caption=f"The {len(common)} most common of {distinct} different rewards, rounded to four digits, make up "
        f"{share.sum():.0f} per cent of all steps. A reward given for many different situations cannot tell the policy "
        "which of them is better.",
        rows=[
            [
                Panel(
                    x_label="reward of a step",
                    y_label="per cent of the control steps",
                    layers=[
                        Bars(
                            x=[f"{value:.4f}".rstrip("0").rstrip(".") for value in common.index],
                            height=share.to_numpy(np.float64),
                            color=GREEN,
                            hover=[
                                f"reward {value:.4g}: {count} steps"
                                for value, count in zip(common.index, common, strict=True)
                            ],
                        )
                    ],
                )
            ]
        ],
        table=counts.rename("steps").reset_index(),
    )


def scatter_time_reward(view: LogView) -> Chart | None:
    """Draw reward, progress, time and steps of each episode against each other."""
    episodes = view.episodes[view.episodes["ended"]]
    if len(episodes) < 2:
        return None
    shown = episodes.iloc[thinned(len(episodes), _MOST_EPISODES)]
    pairs = (
        ("progress", "reward", "progress, per cent of the lap", "reward of the episode"),
        ("time_s", "reward", "time of the episode, s", "reward of the episode"),
        ("steps", "time_s", "control steps", "time of the episode, s"),
        ("lap_time_s", "reward", "lap time of complete laps, s", "reward of the lap"),
    )
    panels = []
    for x, y, x_label, y_label in pairs:
        known = shown[shown[x].notna()]
        if not len(known):
            continue
        layers: list[Layer] = []
        for complete, name, color in ((False, "not complete", ORANGE), (True, "complete lap", BLUE)):
            some = known[known["complete"] == complete]
            if len(some):
                points = Points(
                    x=some[x].to_numpy(np.float64),
                    y=some[y].to_numpy(np.float64),
                    name=name,
                    color=color,
                    size=3.5,
                )
                layers.append(points)
        panels.append(Panel(x_label=x_label, y_label=y_label, layers=layers))
    laps = episodes[episodes["lap_time_s"].notna()]
    r = correlation(laps["lap_time_s"].to_numpy(np.float64), laps["reward"].to_numpy(np.float64))
    told = (
        f"Lap time and reward of complete laps go together with r = {r:+.2f}: below zero, the reward asks for speed."
        if np.isfinite(r)
        else "There are too few complete laps to say whether the reward asks for speed."
    )
    some_drawn = f" {len(shown)} of {len(episodes)} episodes are drawn." if len(shown) < len(episodes) else ""
    return Chart(
        name="scatter_time_reward",
        title="Episodes: reward, progress and time",
        caption=f"Each point is an episode; a reward that grows evenly with progress is one to learn from. "
        f"{told}{some_drawn}",
        rows=[panels[at : at + 2] for at in range(0, len(panels), 2)],
        table=episodes[["iteration", "episode", "progress", "reward", "time_s", "steps", "lap_time_s"]],
    )


def discount_factors(view: LogView) -> Chart | None:
    """Draw what later rewards are worth under several discount factors."""
    episodes = view.episodes
    if not len(episodes):
        return None
    complete = episodes["lap_time_s"].notna()
    lap = int(episodes["lap_time_s"].idxmin()) if complete.any() else int(episodes["progress"].idxmax())
    rows = view.steps[view.steps["episode"] == episodes.loc[lap, "episode"]]
    rewards = np.nan_to_num(rows["reward"].to_numpy(np.float64))
    count = len(rewards)
    gammas = sorted({*GAMMAS, view.discount})
    colors = dict(zip(gammas, [color for color in CATEGORIES if color != BLACK], strict=False))
    ahead = np.arange(0, max(int(1.5 * count), 60), max(1, count // 150)).astype(np.float64)
    weights: list[Layer] = []
    values: list[Layer] = []
    bonus: list[Layer] = []
    remaining = np.arange(count - 1, -1, -1).astype(np.float64)
    table = pd.DataFrame({"steps_to_go": remaining})
    highest = 5.0
    for gamma in gammas:
        own = gamma == view.discount
        color, width = (BLACK, 2.6) if own else (colors[gamma], 1.4)
        name = f"{gamma:g}{' (this training)' if own else ''}"
        weights.append(Line(x=ahead, y=100 * gamma**ahead, name=name, color=color, width=width))
        future = discounted(rewards, gamma)
        last = rewards[-1] * gamma**remaining
        # A sum near zero has no shares.
        share = np.where(np.abs(future) > 1e-9, 100 * last / np.where(future == 0, 1, future), np.nan)
        values.append(Line(x=remaining, y=future, name=name, color=color, width=width))
        far = share[(remaining >= _FAR) & np.isfinite(share)]
        highest = max(highest, float(far.max(initial=0.0)))
        bonus.append(Line(x=remaining, y=np.clip(share, -100, 200), name=name, color=color, width=width))
        table[f"future_reward_{gamma:g}"] = future
    weights.append(Mark(at=float(count), label=f"this lap: {count} steps", color=FAINT))
    half = np.log(0.5) / np.log(view.discount) if 0 < view.discount < 1 else np.inf
    to_go = "steps to go in the episode"
    what = "fastest lap" if complete.any() else "episode that came farthest"
    return Chart(
        name="discount_factors",
        title="What later rewards are worth",
        caption=f"With the discount factor of this training, {view.discount:g}, a reward is worth half if it comes "
        f"{half:.0f} steps ({half / STEP_HZ:.1f} s) later. The two panels below are of the {what}: what is still to "
        "come, and how much of it is the reward of the last step.",
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
                Panel(
                    title="Discounted future reward", x_label=to_go, y_label="reward", layers=_unnamed(values)
                ),
                Panel(
                    title="Share of the last step's reward",
                    x_label=to_go,
                    y_label="per cent of the future reward",
                    layers=_unnamed(bonus),
                    # Of the last steps it is always nearly all.
                    y_range=(0.0, min(1.1 * highest, 105.0)),
                ),
            ],
        ],
        table=table,
    )


def discounted(rewards: Values, gamma: float) -> Values:
    """Return each step's reward and all later ones, discounted."""
    future = np.empty(len(rewards))
    total = 0.0
    for step in range(len(rewards) - 1, -1, -1):
        total = rewards[step] + gamma * total
        future[step] = total
    return future


def _unnamed(layers: list[Layer]) -> list[Layer]:
    """Return lines that the legend of another panel names."""
    return [
        Line(x=layer.x, y=layer.y, color=layer.color, width=layer.width)
        for layer in layers
        if isinstance(layer, Line)
    ]
