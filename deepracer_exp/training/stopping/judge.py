"""Stopping rules applied to a whole training in retrospect, for its report.

A run of ours is judged by the values of its own rule, the logs of others by `LOG_RULE` and `LOG_OVERFITTING`.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from deepracer_exp.config.stopping import ConvergedRule, EntropyStopping, OverfittingRule, StoppingConfig
from deepracer_exp.runs.run_result import RELIABLE

from .stopping_rules import Decision, Row, TrendRule

if TYPE_CHECKING:
    import pandas as pd

LOG_RULE = ConvergedRule(
    warmup=0,
    patience=10,
    completion_near=5.0,
    completion_gain=2.0,
    return_gain=0.05,
    laps_gain=0.05,
    entropy_change=0.1,
    best_patience=10,
    best_gain=0.01,
)
"""The values of `conf/stopping/entropy.yaml`, with the warm-up and patience that suit the shorter logs of others."""
PATIENCE_SHARE = 0.2
"""Share of the iterations of such a log that count as patience."""
_WINDOW = 3
"""Iterations of the moving averages."""
POOR = 50.0
"""Completion below which a training that no longer grows has not learned to drive, per cent."""
LOG_OVERFITTING = OverfittingRule(warmup=0, patience=3, held_out_drop=10.0, lap_gain=0.02, return_drop=0.05)
"""The rule of overfitting for the logs of others, which have an evaluation after each iteration."""
_FEWEST_EVALUATIONS = 6


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """Where a training converged."""

    iteration: int | None
    """Iteration at which it converged; None if it has not."""
    completion: float
    """Moving average at the end, per cent."""
    completion_before: float
    """Highest moving average before the last `patience` iterations."""
    completion_best: float
    """Highest moving average."""
    entropy_change: float | None
    """Change within the last `patience` iterations, see `entropy_share`; None where not logged."""
    entropy_flat: bool
    patience: int


def convergence(
    iterations: "pd.DataFrame", action_count: int | None, stopping: Mapping[str, Any] | None = None
) -> Convergence | None:
    """Find the iteration from which on a training no longer grew, None where it is too short to say.

    That is `patience` iterations before the first of those at the end of the training after each of which the rule of
    convergence would have ended it.

    Args:
        iterations: a row each, with `episodes`, `steps`, `completion_mean`, `reward_mean`, `lap_share`, `entropy`,
            `eval_lap_share` and `eval_lap_time_s`.
        action_count: of a discrete policy, None of a continuous one.
        stopping: of a run of ours, its group `stopping`, whose rule of convergence is applied if it has one; None:
            LOG_RULE.
    """
    table = iterations[iterations["episodes"] > 0]
    rule = _rule_for(table, stopping)
    if len(table) < rule.patience + _WINDOW:
        return None
    judge = TrendRule(_only(converged=rule), action_count)
    ends = [judge.observe(row) is not None for row in _rows(table)]
    completion = judge.averages["completion"]
    going = len(ends) - (ends[::-1].index(False) if False in ends else len(ends))
    before, _ = completion.bests(rule.patience)
    change = judge.averages["entropy"].change(rule.patience)
    return Convergence(
        iteration=int(table["iteration"].iloc[going - rule.patience]) if going < len(ends) else None,
        completion=completion.now,
        completion_before=before,
        completion_best=completion.best,
        entropy_change=change,
        entropy_flat=(change or 0.0) <= rule.entropy_change,
        patience=rule.patience,
    )


def iterations_needed(iterations: "pd.DataFrame", stopping: Mapping[str, Any] | None = None) -> int:
    """Return the number of iterations with an episode that `convergence` needs; arguments as there."""
    return _rule_for(iterations[iterations["episodes"] > 0], stopping).patience + _WINDOW


def _rule_for(table: "pd.DataFrame", stopping: Mapping[str, Any] | None) -> ConvergedRule:
    """Return the rule by which a table of iterations with episodes is judged."""
    rule = replace(convergence_rule(stopping), warmup=0)
    if rule != LOG_RULE:
        return rule
    patience = max(rule.patience, math.ceil(PATIENCE_SHARE * len(table)))
    return replace(rule, patience=patience, best_patience=patience)


@dataclass(frozen=True, kw_only=True)
class Overfitting:
    """The evaluations of a training, and whether its rule calls them overfitting."""

    decision: Decision | None
    """Decision of the stopping rule after the last iteration; None without a sign of overfitting."""
    evaluated: str
    """`held-out evaluation` or `evaluation`."""
    best: float
    """Completion, per cent, mean of three evaluations."""
    best_iteration: int
    now: float
    rule: OverfittingRule


def overfitting(iterations: "pd.DataFrame", stopping: Mapping[str, Any] | None = None) -> Overfitting | None:
    """Apply the stopping rule of overfitting to a table of iterations; None with fewer than six evaluations.

    Evaluations on held-out conditions count; in logs without them the others do.

    Args:
        iterations: a row each, with the columns of `convergence`, `held_out_completion` and `eval_completion`.
        stopping: of a run of ours, its group `stopping`, whose rule is applied if it has one; None: LOG_OVERFITTING.
    """
    run_rule = _entropy_stopping(stopping)
    rule = (run_rule and run_rule.overfitting) or LOG_OVERFITTING
    for column, name in (("held_out_completion", "held-out evaluation"), ("eval_completion", "evaluation")):
        if iterations[column].notna().sum() < _FEWEST_EVALUATIONS:
            continue
        judge, decision = TrendRule(_only(overfitting=rule), None), None
        for row, completion in zip(_rows(iterations), iterations[column], strict=True):
            decision = judge.observe({**row, "held_out_completion": completion})
        averages = judge.averages["held_out_completion"]
        return Overfitting(
            decision=decision,
            evaluated=name,
            best=averages.best,
            best_iteration=int(iterations["iteration"].iloc[averages.row_of_best()]),
            now=averages.now,
            rule=rule,
        )
    return None


def convergence_rule(stopping: Mapping[str, Any] | None) -> ConvergedRule:
    """Return the rule of convergence of a group `stopping`, LOG_RULE if it has none."""
    rule = _entropy_stopping(stopping)
    return (rule and rule.converged) or LOG_RULE


def _only(
    converged: ConvergedRule | None = None, overfitting: OverfittingRule | None = None
) -> EntropyStopping:
    return EntropyStopping(
        kind="entropy",
        window=_WINDOW,
        converged=converged,
        overfitting=overfitting,
        collapsed=None,
        not_learning=None,
        laps_slower=None,
    )


def _rows(iterations: "pd.DataFrame") -> Iterator[Row]:
    """Convert iterations to rows of metrics.jsonl, with the columns that the rules of trends read."""
    laps = (iterations["lap_share"] * iterations["episodes"]).fillna(0.0).cumsum()
    reliable = iterations["eval_lap_share"] >= RELIABLE
    table = {
        # The race score is in the metrics of our own runs alone.
        "eval_race_score_s": iterations["eval_lap_time_s"].where(reliable),
        "eval_lap_time_s": iterations["eval_lap_time_s"],
        "eval_lap_share": iterations["eval_lap_share"],
        "completion": iterations["completion_mean"],
        "mean_return": iterations["reward_mean"],
        "entropy": iterations["entropy"],
        "laps": laps,
        "env_steps": iterations["steps"].cumsum(),
    }
    for values in zip(*table.values(), strict=True):
        yield {name: None if math.isnan(value) else value for name, value in zip(table, values, strict=True)}


@cache
def _stopping_adapter() -> "TypeAdapter[StoppingConfig]":
    # Cached: composing it takes 30 ms, and a page needs it four times.
    return TypeAdapter(StoppingConfig)


def _entropy_stopping(stopping: Mapping[str, Any] | None) -> EntropyStopping | None:
    try:
        config = _stopping_adapter().validate_python(stopping)
    except ValidationError:  # none, or of another version
        return None
    return config if isinstance(config, EntropyStopping) else None
