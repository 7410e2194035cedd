"""Apply another reward function to recorded steps and compare the rewards of laps and waypoints."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.config.car import CarConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.guard import Guard, Misconduct
from deepracer_exp.rewards.reward import RewardFailed, RewardFunction
from deepracer_exp.rewards.source import RewardSource

from .recorded_params import Ids, RecordedParams

TIME_LIMIT_S = 5.0
"""CPU seconds of one call; the default of trainings."""
_AT_ONCE = 4096
"""Rows whose params are rebuilt together and passed to one call of `reward_batch`; a training's step has hundreds."""
_SPREAD = (0.02, 0.98)
"""Quantiles of the waypoints' means that map to 0 and 1, so that a bonus at the finish does not flatten the rest."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReplayedRewards:
    """Rewards of a view's course under another reward function."""

    reward: str
    """Its name."""
    steps: pd.DataFrame
    """All steps on the course and `new_reward`; NaN where the params could not be rebuilt."""
    laps: pd.DataFrame
    """Episodes that are a whole lap, recorded from its start, highest new reward first: stream, iteration (of the last
    row), episode, time_s, the sums reward and new_reward, rank, new_rank (1: the highest reward) and time_rank (1: the
    fastest); ties share the better rank."""
    correlations: dict[str, float]
    """With at least three laps, Spearman's rank correlations old_new, old_time and new_time, NaN if all values are
    equal. A reward that prefers fast laps correlates with time at -1."""
    waypoints: pd.DataFrame
    """One row per direction (`reversed`) and closest waypoint: visits, means reward and new_reward, and both as share
    and new_share: 0 and 1 are the 2nd and 98th percentile of the waypoints, values beyond are clipped."""


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
        raise BadInput(f"{why}: no step is on a known course, so no reward can be computed")
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
    for one in np.unique(process[params.paid]):
        function = RewardFunction(source, 1, time_limit_s, None)
        own = np.flatnonzero(params.paid & (process == one))
        pay = _at_once if function.is_batch else _one_by_one
        for begin in range(0, len(own), _AT_ONCE):
            some = own[begin : begin + _AT_ONCE]
            new_reward[some] = pay(function, params, steps, some)
    steps["new_reward"] = new_reward
    laps = _laps(steps, episode)
    return ReplayedRewards(
        reward=source.name,
        steps=steps,
        laps=laps,
        correlations=_correlations(laps) if len(laps) >= 3 else {},
        waypoints=_waypoints(steps[params.paid].assign(reversed=params.is_reversed[params.paid])),
    )


def _at_once(
    function: RewardFunction, params: RecordedParams, steps: pd.DataFrame, some: Ids
) -> NDArray[np.float64]:
    try:
        # One car per row: `reward_batch` does not distinguish cars from steps.
        return function(params.columns(some), params.track_params, track_index=params.track_index[some])
    except RewardFailed as error:
        at = f"{len(some):,} steps at once" if error.car is None else _place(steps, some[error.car])
        raise BadInput(f"{function.source.path}: reward_batch {error.what} ({at})") from error


def _one_by_one(
    function: RewardFunction, params: RecordedParams, steps: pd.DataFrame, some: Ids
) -> NDArray[np.float64]:
    paid = np.empty(len(some))
    at = 0
    try:
        with Guard(function.time_limit_s) as guard:
            for at, given in enumerate(params.dicts(some)):
                paid[at] = function.pay(given)
                guard.restart()
    except (RewardFailed, Misconduct) as error:
        what = error.what if isinstance(error, RewardFailed) else str(error)
        raise BadInput(
            f"{function.source.path}: reward_function {what} ({_place(steps, some[at])})"
        ) from error
    return paid


def _place(steps: pd.DataFrame, row: int) -> str:
    at = steps.iloc[row]
    return f"{at['stream']}, episode {at['episode']}, step {at['steps']}"


def _laps(steps: pd.DataFrame, episode: NDArray[np.int64]) -> pd.DataFrame:
    begin = np.flatnonzero(np.diff(episode, prepend=-1) != 0)
    end = np.r_[begin[1:], len(steps)] - 1
    tstamp = steps["tstamp"].to_numpy()
    episodes = steps.iloc[end][["stream", "iteration", "episode"]].reset_index(drop=True)
    episodes["time_s"] = tstamp[end] - tstamp[begin]
    for name in ("reward", "new_reward"):
        episodes[name] = np.add.reduceat(steps[name].to_numpy(), begin)
    # Generations without prepare rows may begin with step 2.
    from_start = steps["steps"].to_numpy()[begin] <= 2
    complete = np.maximum.reduceat(steps["progress"].to_numpy(), begin) >= 100.0
    laps = episodes[complete & from_start & episodes["new_reward"].notna()].copy()
    for name, of, ascending in (
        ("rank", "reward", False),
        ("new_rank", "new_reward", False),
        ("time_rank", "time_s", True),
    ):
        laps[name] = laps[of].rank(method="min", ascending=ascending).astype(int)
    return laps.sort_values("new_rank", kind="stable", ignore_index=True)


def _correlations(laps: pd.DataFrame) -> dict[str, float]:
    pairs = {
        "old_new": ("reward", "new_reward"),
        "old_time": ("reward", "time_s"),
        "new_time": ("new_reward", "time_s"),
    }
    table = laps[["reward", "new_reward", "time_s"]].corr("spearman")
    return {name: float(table.loc[pair]) for name, pair in pairs.items()}


def _waypoints(paid: pd.DataFrame) -> pd.DataFrame:
    means = paid.groupby(["reversed", "closest_waypoint"], as_index=False).agg(
        visits=("reward", "size"), reward=("reward", "mean"), new_reward=("new_reward", "mean")
    )
    for name, of in (("share", "reward"), ("new_share", "new_reward")):
        means[name] = means.groupby("reversed")[of].transform(_share)
    return means


def _share(means: "pd.Series[float]") -> "pd.Series[float]":
    low, high = means.quantile(_SPREAD[0]), means.quantile(_SPREAD[1])
    return ((means - low) / (high - low)).clip(0.0, 1.0) if high > low else means * 0.0 + 0.5
