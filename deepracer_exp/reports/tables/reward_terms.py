"""The contribution of each term of a reward function at recorded steps."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.recorded import LogProblem
from deepracer_exp.config.car import CarConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.reward import Failure, RewardFunction, Unusable, answers
from deepracer_exp.rewards.source import RewardSource, is_of_zoo

from .log_view import LogView
from .recorded_params import RecordedParams
from .reward_replay import TIME_LIMIT_S

MOST_STEPS = 20_000
"""Number of steps above which only some episodes, evenly spaced over the training, are evaluated."""
_NUMBERS = int, float, np.number
Terms = Callable[[dict[str, Any]], object]


def run_terms(
    view: LogView, car: CarConfig, just_trained: bool = False
) -> tuple[LogView, pd.DataFrame | None]:
    """Return a recorded training's view and the terms of its stored reward function, if it may be run.

    A reward function is a program and a recording may come from anywhere, so only those of the reward zoo are run, and
    one that a training in this process has run already.

    Returns:
        The view, with another problem if the terms could not be computed; the terms as from `contributed_terms`.
    """
    text = view.recording.reward_source
    if text is None or not (just_trained or is_of_zoo(text)):
        return view, None
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    source = RewardSource(view.name, f"{view.name}: reward function", text, sha256, {}, {})
    try:
        return view, contributed_terms(view, source, car)
    except BadInput as error:
        return replace(view, problems=(*view.problems, LogProblem(view.name, None, str(error)))), None


def contributed_terms(
    view: LogView,
    source: RewardSource,
    car: CarConfig,
    most: int = MOST_STEPS,
    time_limit_s: float = TIME_LIMIT_S,
) -> pd.DataFrame | None:
    """Compute the terms of a module's reward at the steps of a training.

    The module provides a function `terms(params)` that returns a dict of numbers whose sum is the reward.
    Whole episodes are evaluated, in the order of time, with one set of module globals: about `most` steps. The time
    limit is in CPU seconds per call.

    Returns:
        One row per step, indexed as in `view.steps`, one column per term in reward units, 0 where a step lacks the
        term. None: the module has no `terms`, or the course is unknown.

    Raises:
        BadInput: the module cannot be loaded; `terms` raised, hung or returned something else, with episode and step.
    """
    if view.course is None or not len(view.steps):
        return None
    # Loading runs the module, which is unnecessary if it does not define `terms`.
    if "terms" not in compile(source.text, source.path, "exec", dont_inherit=True).co_names:
        return None
    function = RewardFunction(source, 1, time_limit_s, None, scalar=True)
    terms = getattr(function.functions[0], "__globals__", {}).get("terms")
    if not callable(terms):
        return None
    steps = _some_episodes(view.steps, most)
    number = np.cumsum(np.diff(steps["episode"].to_numpy(np.int64), prepend=-1) != 0) - 1
    params = RecordedParams(steps, number, view.course, car)
    evaluated = np.flatnonzero(params.paid)
    if not len(evaluated):
        return None
    by_step: list[dict[str, float]] = []
    calls = answers(partial(_checked, terms), params.dicts(evaluated), source.path, time_limit_s)
    for row, answer in zip(evaluated, calls, strict=True):
        if isinstance(answer, Failure):
            step = steps.iloc[row]
            place = f"episode {step['episode']}, step {step['steps']}"
            raise BadInput(source.path, f"terms {answer.what} ({place})") from answer.error
        by_step.append(answer)
    names = dict.fromkeys(name for contributed in by_step for name in contributed)
    columns = {name: np.array([contributed.get(name, 0.0) for contributed in by_step]) for name in names}
    return pd.DataFrame(columns, index=steps.index[evaluated], copy=False)


def _checked(terms: Terms, params: dict[str, Any]) -> dict[str, float]:
    answer = terms(params)
    if not isinstance(answer, dict) or not answer:
        raise Unusable(f"returned {str(answer)[:40]!r}, not a dict of numbers")
    for name, value in answer.items():
        # A type is compared in a tenth of the time in which it is looked up among several.
        is_number = type(value) is float or isinstance(value, _NUMBERS)
        if not is_number or not math.isfinite(value):
            raise Unusable(f"returned {str(value)[:40]!r} for {name!r}; accepted are finite numbers")
    return {str(name): float(value) for name, value in answer.items()}


def _some_episodes(steps: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return evenly spaced whole episodes with about `most` steps in total."""
    episodes, every = steps["episode"].unique(), -(-len(steps) // most)
    return steps[steps["episode"].isin(episodes[every - 1 :: every])] if len(episodes) >= every else steps
