"""Rewards of another function for the same driving, by lap and place: in sentences and a table."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.aws.logs.recorded import TRAINING
from deepracer_exp.config.car import CarConfig
from deepracer_exp.errors import BadInput, count
from deepracer_exp.rewards.reward import Failure, RewardFailed, RewardFunction
from deepracer_exp.rewards.source import RewardSource
from deepracer_exp.tracks.track import Track

from .log_tables import Table, table_of
from .log_view import LogView
from .recorded_params import Ids, RecordedParams

TIME_LIMIT_S = 5.0
"""CPU seconds of one call; the default of trainings."""
MOST_LAPS = 10
_LAP_COLUMNS = {
    "new_rank": ("By the new reward", "d"),
    "rank": ("By the recorded one", "d"),
    "time_rank": ("By time", "d"),
    "time_s": ("Lap time, s", ".2f"),
    "iteration": ("Iteration", "d"),
    "episode": ("Episode", "d"),
    "new_reward": ("New reward", ".5g"),
    "reward": ("Recorded reward", ".5g"),
}
_AT_ONCE = 4096
"""Rows whose params are rebuilt together and passed to one call of `reward_batch`; a training's step has hundreds."""
_SPREAD = (0.02, 0.98)
"""Quantiles of the waypoints' means that map to 0 and 1, so that a bonus at the finish does not flatten the rest."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReplayedRewards:
    """Rewards of a view's course under another reward function."""

    reward: str
    """Name of the function."""
    course: Track
    steps: pd.DataFrame
    """All steps on the course and `new_reward`; NaN where the params could not be rebuilt."""
    laps: pd.DataFrame
    """Episodes that are a whole lap, recorded from its start, highest new reward first: stream, iteration (of the last
    row), episode, time_s, the sums reward and new_reward, rank, new_rank (1: the highest reward) and time_rank (1: the
    fastest); ties share the better rank."""
    waypoints: pd.DataFrame
    """One row per direction (`reversed`) and closest waypoint: visits, means reward and new_reward, and both as share
    and new_share: 0 and 1 are the 2nd and 98th percentile of the waypoints, values beyond are clipped."""

    @cached_property
    def correlations(self) -> dict[str, float]:
        """Return, of at least three laps, Spearman's rank correlations old_new, old_time and new_time.

        They are NaN if all values are equal. A reward that prefers fast laps correlates with time at -1.
        """
        if len(self.laps) < 3:
            return {}
        table = self.laps[["reward", "new_reward", "time_s"]].corr("spearman")
        return {
            "old_new": float(table.loc["reward", "new_reward"]),
            "old_time": float(table.loc["reward", "time_s"]),
            "new_time": float(table.loc["new_reward", "time_s"]),
        }

    @cached_property
    def places(self) -> pd.DataFrame:
        """Rows of `waypoints` in the direction driven most, with the `change` of the share."""
        rows = self.waypoints
        if len(rows):
            rows = rows[rows["reversed"] == rows.groupby("reversed")["visits"].sum().idxmax()]
        return rows.assign(change=rows["new_share"] - rows["share"])

    @property
    def best_laps(self) -> Table:
        """The laps with the highest new reward."""
        return table_of(self.laps.head(MOST_LAPS), _LAP_COLUMNS, max(0, len(self.laps) - MOST_LAPS))

    @property
    def sentences(self) -> list[str]:
        """Return in sentences how the function would rank laps and places."""
        laps, places, name = self.laps, self.places, self.reward
        lines = [f"There is no complete lap that {name} could rank."]
        if len(laps):
            evaluated = ", evaluations included," if laps["stream"].nunique() > 1 else ""
            best, fastest = laps.iloc[0], laps.loc[laps["time_s"].idxmin()]
            ranks = f"{_ordinal(best['time_rank'])} by time, {_ordinal(best['rank'])} by the recorded reward"
            lines = [
                f"Of {count(len(laps), 'complete lap')}{evaluated} {name} would have rewarded the one of episode "
                f"{best['episode']} most ({best['time_s']:.2f} s, {ranks}); the fastest lap "
                f"({fastest['time_s']:.2f} s) is {_ordinal(fastest['new_rank'])} instead of "
                f"{_ordinal(fastest['rank'])}."
            ]
        if self.correlations:
            texts = {
                key: f"{r:.2f}" if math.isfinite(r) else "not defined (all equal)"
                for key, r in self.correlations.items()
            }
            lines.append(
                f"Rank correlation with lap time (-1: laps are ranked by speed alone): {name} {texts['new_time']}, "
                f"recorded reward {texts['old_time']}; between both rewards {texts['old_new']}."
            )
        if len(places):
            up, down = places.loc[places["change"].idxmax()], places.loc[places["change"].idxmin()]
            lines.append(
                f"Compared with the other places of the track, waypoint {up['closest_waypoint']} gains most and "
                f"waypoint {down['closest_waypoint']} loses most."
            )
        return lines


def _ordinal(rank: int) -> str:
    ending = "th" if 10 <= rank % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(rank % 10, "th")
    return f"{rank}{ending}"


def replay_reward(
    view: LogView, source: RewardSource, car: CarConfig, time_limit_s: float = TIME_LIMIT_S
) -> ReplayedRewards:
    """Compute the reward of all steps of a view, of its training and of its evaluations, by another reward function.

    The params are rebuilt from the recorded poses (see `RecordedParams`). A module with `reward_batch` is called with
    many steps at once; any other one step by step, episode by episode in the order of time, with one set of module
    globals for each stream and worker, as in a process of the service. The time limit is in CPU seconds per call.

    Raises:
        BadInput: the function cannot be loaded; it raised, hung or returned no finite number, with the episode and
            step; the view's course is not known.
    """
    if view.course is None:
        why = str(view.problems[0]) if view.problems else view.name
        raise BadInput(why, "no step is on a known course, so no reward can be computed")
    steps = view.recording.steps
    here = (steps["track"] == view.track_name).to_numpy()
    # A course without a name in the log has been recognised.
    steps = steps[here if here.any() else (steps["track"] == "").to_numpy()]
    stream = steps["stream"].astype("category").cat.codes.to_numpy().astype(np.int64)
    process = stream * 2**16 + steps["worker"].to_numpy()
    order = np.lexsort((steps["episode"].to_numpy(), process))
    steps, process = steps.iloc[order].reset_index(drop=True), process[order]
    number = steps["episode"].to_numpy(np.int64)
    episode = np.cumsum((np.diff(process, prepend=-1) != 0) | (np.diff(number, prepend=-1) != 0)) - 1
    params = RecordedParams(steps, episode, view.course, car)
    new_reward = np.where(params.known, 0.0, np.nan)
    for run_number in np.unique(process[params.paid]):
        function = RewardFunction(source, 1, time_limit_s, None)
        replayed = np.flatnonzero(params.paid & (process == run_number))
        rewards = _at_once if function.is_batch else _one_by_one
        for begin in range(0, len(replayed), _AT_ONCE):
            some = replayed[begin : begin + _AT_ONCE]
            new_reward[some] = rewards(function, params, steps, some)
    steps["new_reward"] = new_reward
    return ReplayedRewards(
        reward=source.name,
        course=view.course,
        steps=steps,
        laps=_laps(steps, episode, view),
        waypoints=_waypoints(steps[params.paid].assign(reversed=params.is_reversed[params.paid])),
    )


def _at_once(
    function: RewardFunction, params: RecordedParams, steps: pd.DataFrame, some: Ids
) -> NDArray[np.float64]:
    try:
        # One car per row: `reward_batch` does not distinguish cars from steps.
        return function(params.columns(some), params.track_params, track_index=params.track_index[some])
    except RewardFailed as error:
        place = f"{len(some):,} steps at once" if error.car is None else _place(steps, some[error.car])
        raise BadInput(function.source.path, f"reward_batch {error.what} ({place})") from error


def _one_by_one(
    function: RewardFunction, params: RecordedParams, steps: pd.DataFrame, some: Ids
) -> NDArray[np.float64]:
    rewards = np.empty(len(some))
    for index, answer in enumerate(function.answers(params.dicts(some))):
        if isinstance(answer, Failure):
            place = _place(steps, some[index])
            raise BadInput(function.source.path, f"reward_function {answer.what} ({place})") from answer.error
        rewards[index] = answer
    return rewards


def _place(steps: pd.DataFrame, row: int) -> str:
    step = steps.iloc[row]
    return f"{step['stream']}, episode {step['episode']}, step {step['steps']}"


def _laps(steps: pd.DataFrame, episode: NDArray[np.int64], view: LogView) -> pd.DataFrame:
    begin = np.flatnonzero(np.diff(episode, prepend=-1) != 0)
    end = np.r_[begin[1:], len(steps)] - 1
    episodes = steps.iloc[end][["stream", "iteration", "episode"]].reset_index(drop=True)
    keys = episodes.astype({"stream": str})
    episodes["time_s"] = keys.merge(_lap_times(view), "left", ["stream", "episode"])["lap_time_s"]
    for name in ("reward", "new_reward"):
        episodes[name] = np.add.reduceat(steps[name].to_numpy(), begin)
    laps = episodes[episodes["time_s"].notna() & episodes["new_reward"].notna()].copy()
    for name, of, ascending in (
        ("rank", "reward", False),
        ("new_rank", "new_reward", False),
        ("time_rank", "time_s", True),
    ):
        laps[name] = laps[of].rank(method="min", ascending=ascending).astype(int)
    return laps.sort_values("new_rank", kind="stable", ignore_index=True)


def _lap_times(view: LogView) -> pd.DataFrame:
    """Return `stream`, `episode` and `lap_time_s` of the episodes of a view whose laps compare."""
    training = [view.comparable.assign(stream=TRAINING)] if view.trained else []
    both = pd.concat([*training, view.evaluation_episodes])[["stream", "episode", "lap_time_s"]]
    return both.astype({"stream": str})


def _waypoints(rewarded: pd.DataFrame) -> pd.DataFrame:
    means = rewarded.groupby(["reversed", "closest_waypoint"], as_index=False).agg(
        visits=("reward", "size"), reward=("reward", "mean"), new_reward=("new_reward", "mean")
    )
    for name, of in (("share", "reward"), ("new_share", "new_reward")):
        means[name] = means.groupby("reversed")[of].transform(_share)
    return means


def _share(means: "pd.Series[float]") -> "pd.Series[float]":
    low, high = means.quantile(_SPREAD[0]), means.quantile(_SPREAD[1])
    return ((means - low) / (high - low)).clip(0.0, 1.0) if high > low else means * 0.0 + 0.5
