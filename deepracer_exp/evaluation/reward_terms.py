"""What each term of a reward function contributed at recorded steps."""

import hashlib
import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.params import rows, scalar_params, select
from deepracer_exp.env.reward import RewardFunction, Unusable
from deepracer_exp.env.reward_guard import CtrlC, Guard
from deepracer_exp.env.reward_source import RewardSource
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.recording import Recording

from .recorded_params import RecordedParams
from .reward_replay import TIME_LIMIT_S, UNPAID

MOST_STEPS = 20_000
"""Steps beyond which only some episodes are asked about, at even distances over the training."""
Terms = Callable[[dict[str, Any]], object]


def recorded_source(recording: Recording) -> RewardSource | None:
    """Return the reward function that a recording brings along; None: it brings none."""
    text = recording.reward_source
    if text is None:
        return None
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    return RewardSource(recording.name, f"{recording.name}: reward function", text, sha256, {}, {})


def reward_terms(
    view: LogView, source: RewardSource, most: int = MOST_STEPS, time_limit_s: float = TIME_LIMIT_S
) -> pd.DataFrame | None:
    """Ask a reward module for the terms of its reward at the steps of a training.

    A module names them in a function `terms(params)` that returns a dict of numbers, whose sum `reward_function` pays.
    Whole episodes are asked about, in the order of time, with one set of module globals.

    Args:
        view: the training, on a known course.
        source: the module.
        most: steps that are asked about; more by the rest of an episode.
        time_limit_s: seconds of CPU a call may take.

    Returns:
        A row a step, labelled as in `view.steps`, a column a term, reward units; 0 where a step has no such term. None:
        the module names no terms, or the course is not known.

    Raises:
        BadInput: the module cannot be run; `terms` raised, hung or returned something else, with episode and step.
    """
    if view.course is None or not len(view.steps):
        return None
    # Loading runs the module: one that defines no such function need not be run.
    if "terms" not in compile(source.text, source.path, "exec", dont_inherit=True).co_names:
        return None
    function = RewardFunction(source, 1, time_limit_s, None, scalar=True)
    terms = getattr(function.functions[0], "__globals__", {}).get("terms")
    if not callable(terms):
        return None
    steps = _some_episodes(view.steps, most)
    number = np.cumsum(np.diff(steps["episode"].to_numpy(np.int64), prepend=-1) != 0) - 1
    courses = {str(steps["track"].iloc[0]): view.course}
    params = RecordedParams(steps, number, courses, _car())
    asked = np.flatnonzero(params.known & ~steps["episode_status"].isin(UNPAID).to_numpy())
    if not len(asked):
        return None
    roads = [params.roads[which] for which in params.which[asked].tolist()]
    found: list[dict[str, float]] = []
    try:
        with Guard(time_limit_s) as guard:
            for row, road in zip(rows(select(params.columns(asked), None)), roads, strict=True):
                found.append(_checked(terms, scalar_params(row, *road)))
                guard.restart()
    except CtrlC:
        raise
    except BaseException as error:  # noqa: BLE001 - raised again as what it means
        what, cause = function.what_happened(error)
        at = steps.iloc[asked[min(len(found), len(asked) - 1)]]
        place = f"episode {at['episode']}, step {at['steps']}"
        raise BadInput(f"{source.path}: terms {what} ({place})") from cause
    return pd.DataFrame(found, index=steps.index[asked]).fillna(0.0)


@cache
def _car() -> CarConfig:
    """Return the default car, whose wheels stand where the service's do."""
    return compose_experiment([])[0].car


def _checked(terms: Terms, params: dict[str, Any]) -> dict[str, float]:
    answer = terms(params)
    if not isinstance(answer, dict) or not answer:
        raise Unusable(f"returned {str(answer)[:40]!r}, no dict of numbers")
    for name, value in answer.items():
        if not isinstance(value, int | float | np.number) or not math.isfinite(value):
            raise Unusable(f"returned {str(value)[:40]!r} for {name!r}; accepted are finite numbers")
    return {str(name): float(value) for name, value in answer.items()}


def _some_episodes(steps: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return whole episodes with together about `most` steps, at even distances."""
    begin = np.flatnonzero(np.diff(steps["episode"].to_numpy(np.int64), prepend=-1) != 0)
    every = -(-len(steps) // most)
    chosen = np.arange(len(begin)) % every == every - 1 if len(begin) >= every else np.ones(len(begin), bool)
    lengths = np.diff(np.r_[begin, len(steps)])
    return steps[np.repeat(chosen, lengths)]
