"""Apply another reward function to recorded steps and compare the rewards of steps, laps and waypoints."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import spearmanr

from deepracer_exp.analysis.log_course import find_courses
from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.deepracer.recording import LogProblem, Recording
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.guard import Guard, Misconduct
from deepracer_exp.rewards.params import rows, scalar_params, select
from deepracer_exp.rewards.reward import RewardFailed, RewardFunction
from deepracer_exp.rewards.source import RewardSource, named_reward_source
from deepracer_exp.runs.files import CONFIG, read_config
from deepracer_exp.tracks.track import Track

from .recorded_params import Ids, RecordedParams

TIME_LIMIT_S = 5.0
"""CPU seconds of one call; the default of trainings."""
UNPAID = ("prepare", "pause", "park")
"""Statuses at which the service gives no reward and calls no function (deepracer-simapp, rollout_agent_ctrl.py)."""
_AT_ONCE = 4096
"""Rows whose params are rebuilt together and passed to one call of `reward_batch`; a training's step has hundreds."""
_SPREAD = (0.02, 0.98)
"""Quantiles of the waypoints' means that map to 0 and 1, so that a bonus at the finish does not flatten the rest."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReplayedRewards:
    """Rewards of a recording under another reward function."""

    reward: str
    """Its name."""
    steps: pd.DataFrame
    """The recording's steps and `new_reward`; NaN where the params could not be rebuilt."""
    episodes: pd.DataFrame
    """One row per episode: stream, worker, iteration (of its last row), episode, track, time_s, progress, complete
    (a whole lap, recorded from its start), and the sums reward and new_reward (NaN if a row's is)."""
    laps: pd.DataFrame
    """The complete episodes, highest new reward first, with rank, new_rank (1: the highest reward of the track's laps)
    and time_rank (1: the fastest); ties share the better rank."""
    correlations: pd.DataFrame
    """One row per track with at least three laps: track, laps, and Spearman's rank correlations old_new, old_time and
    new_time, NaN if all values are equal. A reward that prefers fast laps correlates with time at -1."""
    waypoints: pd.DataFrame
    """One row per track, direction (`reversed`) and closest waypoint: visits, means reward and new_reward, and both as
    share and new_share: 0 and 1 are the 2nd and 98th percentile of the waypoints, values beyond are clipped."""
    problems: tuple[LogProblem, ...]
    """Why rows have no new reward."""


def replay_reward(
    recording: Recording,
    reward: str,
    courses: Mapping[str, Track] | None = None,
    time_limit_s: float = TIME_LIMIT_S,
) -> ReplayedRewards:
    """Compute the reward of all steps of a recording by another reward function.

    The params are rebuilt from the recorded poses (see `RecordedParams`). A module with `reward_batch` is called with
    many steps at once; any other one step by step, episode by episode in the order of time, with one set of module
    globals for each stream and worker, as in a process of the service.

    Args:
        recording: of a training.
        reward: a name of the reward zoo or a Python file.
        courses: by name in `recording.steps.track`; None: looked up as for figures.
        time_limit_s: CPU seconds per call.

    Raises:
        BadInput: the function is unknown or cannot be loaded; it raised, hung or returned no finite number, with the
            episode and step; no course of the recording is known.
    """
    source = named_reward_source(reward)
    found = find_courses(recording) if courses is None else None
    courses = found.tracks if found is not None else courses or {}
    steps, order = recording.steps, _order(recording.steps)
    ordered = steps.iloc[order]
    episode = _episode_numbers(ordered)
    params = RecordedParams(ordered, episode, courses, _car(recording))
    if not params.known.any():
        why = str(found.problems[0]) if found is not None and found.problems else recording.name
        raise BadInput(f"{why}: no step is on a known course, so no reward can be computed")
    paid = _pay(source, params, ordered, time_limit_s)
    new_reward = np.empty(len(steps))
    new_reward[order] = paid
    episodes = _episodes(ordered, episode, paid)
    laps = _laps(episodes)
    return ReplayedRewards(
        reward=source.name,
        steps=steps.assign(new_reward=new_reward),
        episodes=episodes.drop(columns="from_start"),
        laps=laps,
        correlations=_correlations(laps),
        waypoints=_waypoints(ordered, params, paid),
        problems=_problems(recording, params, found.problems if found is not None else ()),
    )


def _car(recording: Recording) -> CarConfig:
    """Return the car of our own run; the service's has the dimensions of the default one."""
    for file in recording.files:
        if file.name == CONFIG:
            try:
                return parse_experiment(read_config(file.parent)).car
            except BadInput:  # another version, whose cars had the same dimensions
                break
    return compose_experiment([])[0].car


def _order(steps: pd.DataFrame) -> Ids:
    """Return the row indices sorted by stream, worker and episode, keeping the order of time."""
    stream = steps["stream"].astype("category").cat.codes.to_numpy()
    return np.lexsort((steps["episode"].to_numpy(), steps["worker"].to_numpy(), stream))


def _episode_numbers(ordered: pd.DataFrame) -> NDArray[np.int64]:
    """Number the episodes of ordered rows from 0."""
    stream = ordered["stream"].astype("category").cat.codes.to_numpy()
    begins = np.diff(stream, prepend=-2) != 0
    for name in ("worker", "episode"):
        begins |= np.diff(ordered[name].to_numpy().astype(np.int64), prepend=-2) != 0
    return np.cumsum(begins) - 1


def _pay(
    source: RewardSource, params: RecordedParams, ordered: pd.DataFrame, time_limit_s: float
) -> NDArray[np.float64]:
    """Return the reward of each row; 0 where the service gives none, NaN where its params are unknown."""
    paid = np.where(params.known, 0.0, np.nan)
    called = params.known & ~ordered["episode_status"].isin(UNPAID).to_numpy()
    stream = ordered["stream"].astype("category").cat.codes.to_numpy().astype(np.int64)
    process = stream * 2**16 + ordered["worker"].to_numpy()
    for one in np.unique(process[called]):
        function = RewardFunction(source, 1, time_limit_s, None)
        own = np.flatnonzero(called & (process == one))
        for begin in range(0, len(own), _AT_ONCE):
            some = own[begin : begin + _AT_ONCE]
            columns = params.columns(some)
            if function.is_batch:
                paid[some] = _at_once(function, params, columns, ordered, some)
            else:
                paid[some] = _one_by_one(function, params, columns, ordered, some)
    return paid


def _at_once(
    function: RewardFunction,
    params: RecordedParams,
    columns: dict[str, np.ndarray],
    ordered: pd.DataFrame,
    some: Ids,
) -> NDArray[np.float64]:
    try:
        # One car per row: `reward_batch` does not distinguish cars from steps.
        return function(columns, params.track_params, track_index=params.track_index[some])
    except RewardFailed as error:
        at = f"{len(some):,} steps at once" if error.car is None else _place(ordered, some[error.car])
        raise BadInput(f"{function.source.path}: reward_batch {error.what} ({at})") from error


def _one_by_one(
    function: RewardFunction,
    params: RecordedParams,
    columns: dict[str, np.ndarray],
    ordered: pd.DataFrame,
    some: Ids,
) -> NDArray[np.float64]:
    paid = np.empty(len(some))
    track_params = [params.track_params[track_index] for track_index in params.track_index[some].tolist()]
    at = 0
    try:
        with Guard(function.time_limit_s) as guard:
            for at, row in enumerate(rows(select(columns, None))):
                paid[at] = function.pay(scalar_params(row, *track_params[at]))
                guard.restart()
    except (RewardFailed, Misconduct) as error:
        what = error.what if isinstance(error, RewardFailed) else str(error)
        place = _place(ordered, some[at])
        raise BadInput(f"{function.source.path}: reward_function {what} ({place})") from error
    return paid


def _place(ordered: pd.DataFrame, row: int) -> str:
    at = ordered.iloc[row]
    return f"{at['stream']}, episode {at['episode']}, step {at['steps']}"


def _episodes(ordered: pd.DataFrame, episode: NDArray[np.int64], paid: NDArray[np.float64]) -> pd.DataFrame:
    begin = np.flatnonzero(np.diff(episode, prepend=-1) != 0)
    end = np.r_[begin[1:], len(ordered)] - 1
    last, tstamp = ordered.iloc[end], ordered["tstamp"].to_numpy()
    table = last[["stream", "worker", "iteration", "episode", "track"]].reset_index(drop=True)
    progress = np.maximum.reduceat(ordered["progress"].to_numpy(), begin)
    # Generations without prepare rows may begin with step 2.
    from_start = ordered["steps"].to_numpy()[begin] <= 2
    return table.assign(
        time_s=tstamp[end] - tstamp[begin],
        progress=progress,
        from_start=from_start,
        complete=(progress >= 100.0) & from_start,
        reward=np.add.reduceat(ordered["reward"].to_numpy(), begin),
        new_reward=np.add.reduceat(paid, begin),
    )


def _laps(episodes: pd.DataFrame) -> pd.DataFrame:
    laps = episodes[episodes["complete"] & episodes["new_reward"].notna()].drop(
        columns=["complete", "from_start"]
    )
    by_track = laps.groupby("track", observed=True)
    for name, of, ascending in (
        ("rank", "reward", False),
        ("new_rank", "new_reward", False),
        ("time_rank", "time_s", True),
    ):
        laps[name] = by_track[of].rank(method="min", ascending=ascending).astype(int)
    return laps.sort_values(["track", "new_rank"], kind="stable", ignore_index=True)


def _correlations(laps: pd.DataFrame) -> pd.DataFrame:
    found = []
    for track, own in laps.groupby("track", observed=True):
        if len(own) >= 3:
            old, new, time_s = (own[name].to_numpy() for name in ("reward", "new_reward", "time_s"))
            pairs = {"old_new": (old, new), "old_time": (old, time_s), "new_time": (new, time_s)}
            correlations = {name: _spearman(*pair) for name, pair in pairs.items()}
            found.append({"track": track, "laps": len(own), **correlations})
    return pd.DataFrame(found, columns=["track", "laps", "old_new", "old_time", "new_time"])


def _spearman(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return np.nan if np.ptp(a) == 0 or np.ptp(b) == 0 else float(spearmanr(a, b).statistic)


def _waypoints(ordered: pd.DataFrame, params: RecordedParams, paid: NDArray[np.float64]) -> pd.DataFrame:
    counted = params.known & ~ordered["episode_status"].isin(UNPAID).to_numpy()
    table = pd.DataFrame(
        {
            "track": ordered["track"].to_numpy()[counted],
            "reversed": params.is_reversed[counted],
            "closest_waypoint": ordered["closest_waypoint"].to_numpy()[counted],
            "reward": ordered["reward"].to_numpy()[counted],
            "new_reward": paid[counted],
        }
    )
    key = ["track", "reversed", "closest_waypoint"]
    means = table.groupby(key, observed=True, as_index=False).agg(
        visits=("reward", "size"), reward=("reward", "mean"), new_reward=("new_reward", "mean")
    )
    for name, of in (("share", "reward"), ("new_share", "new_reward")):
        means[name] = means.groupby(["track", "reversed"], observed=True)[of].transform(_share)
    return means


def _share(means: "pd.Series[float]") -> "pd.Series[float]":
    low, high = means.quantile(_SPREAD[0]), means.quantile(_SPREAD[1])
    return ((means - low) / (high - low)).clip(0.0, 1.0) if high > low else means * 0.0 + 0.5


def _problems(
    recording: Recording, params: RecordedParams, of_courses: tuple[LogProblem, ...]
) -> tuple[LogProblem, ...]:
    left_out = int((~params.known).sum())
    if not left_out:
        return of_courses
    reason = (
        f"{left_out:,} of {len(params.known):,} steps have no new reward: their course or position is unknown"
    )
    return (*of_courses, LogProblem(recording.name, None, reason))
