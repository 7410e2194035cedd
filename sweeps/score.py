"""What a policy is worth to a sweep: numbers to be compared, one an objective."""

from collections.abc import Mapping, Sequence
from typing import Any

from deepracer_exp.evaluation.result import USUAL, Evaluation


def values_of(evaluation: Evaluation, objectives: Sequence[str], trial_time_s: float) -> list[float]:
    """Return the values of the objectives, means over tracks; lap time and completion of the usual conditions.

    Args:
        evaluation: of the policy.
        objectives: names in MEASURES.
        trial_time_s: the longest that a trial may take. A policy without a complete lap is worth more than that, the
            more the less of the lap it drives: samplers need a number for it, too.
    """
    usual = evaluation.on(USUAL)
    nothing = without_lap(usual.completion, trial_time_s)
    values = {
        "race_score": evaluation.race_score_s,
        "lap_time": usual.mean_lap_time_s,
        "completion": usual.completion,
    }
    return [nothing if values[one] is None else float(values[one] or 0.0) for one in objectives]


def without_lap(completion: float, trial_time_s: float) -> float:
    """Return seconds for a policy that completes no lap, from one to two times `trial_time_s`.

    Args:
        completion: per cent of the lap that it drives, mean.
        trial_time_s: the longest that a trial may take.
    """
    return trial_time_s * (2 - min(completion, 100.0) / 100)


def value_on_the_way(row: Mapping[str, Any], objective: str, trial_time_s: float) -> float | None:
    """Return the value of an evaluation while training; None if the row of metrics.jsonl is of none."""
    completion = row.get("eval_completion")
    value = row.get({"race_score": "eval_race_score_s", "lap_time": "eval_lap_time_s"}.get(objective, ""))
    if completion is None:
        return None
    if objective == "completion":
        return float(completion)
    return without_lap(completion, trial_time_s) if value is None else float(value)
