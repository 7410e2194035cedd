"""Objectives of a study: units, values of a policy, and the order of trials."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import optuna

from deepracer_exp.errors import BadInput
from deepracer_exp.runs.run_result import of_conditions, with_unit

if TYPE_CHECKING:
    from deepracer_exp.evaluation.results import Evaluation

NONE = "\N{EN DASH}"
"""Shown where there is no value."""
_MOST_CHANGES_PER_M = 10.0
"""Above that of any policy that completes a lap: a change in every third control step at 0.5 m/s."""
_LEAST_SHARE = 0.01  # of the lap; a trial that never moved must not divide by zero


@dataclass(frozen=True)
class Measure:
    """Name, unit and direction of an objective."""

    title: str
    unit: str
    minimize: bool

    @property
    def label(self) -> str:
        """Title and unit, for an axis."""
        return f"{self.title}, {self.unit}"

    @property
    def words(self) -> str:
        """The title within a sentence."""
        return self.title[0].lower() + self.title[1:]


MEASURES: Mapping[str, Measure] = {
    "race_score": Measure("Race score (usual and held-out)", "s", minimize=True),
    "lap_time": Measure("Mean usual lap", "s", minimize=True),
    "completion": Measure("Usual completion", "%", minimize=False),
    "zigzag": Measure("Zig-zag", "changes/m", minimize=True),
}
"""Measures by the name of the objective. Race score: seconds per complete lap, failed laps included; usual and held-out
are conditions. Zig-zag: changes of steering from one side to the other a metre of straight."""


def objectives_of(study: optuna.Study) -> tuple[str, ...]:
    """Return the names of a study's objectives.

    Raises:
        BadInput: the study was not made by a sweep.
    """
    names = study.user_attrs.get("objectives")
    if not isinstance(names, list | tuple) or not set(names) <= set(MEASURES):
        raise BadInput(
            f"study {study.study_name}",
            f"has no objectives that a sweep writes ({', '.join(MEASURES)}); it was not made by `deepracer-exp sweep`",
        )
    return tuple(names)


def cost(objectives: Sequence[str], values: Sequence[float]) -> float:
    """Return the score that trials are sorted by, lower is better.

    One objective: its value. Several: the race score if it is one of them; otherwise lap time over the share of the
    lap driven if that is one, too, which is close to seconds per complete lap, so that a fast car that rarely finishes
    is not the best; without lap time, the share of the lap.
    """
    by_name = dict(zip(objectives, values, strict=True))
    if len(objectives) == 1:
        (name,) = objectives
        return by_name[name] if MEASURES[name].minimize else -by_name[name]
    if "race_score" in by_name:
        return by_name["race_score"]
    if "lap_time" not in by_name:
        return -by_name["completion"]
    return by_name["lap_time"] / max(by_name.get("completion", 100.0) / 100, _LEAST_SHARE)


def objective_values(evaluation: "Evaluation", objectives: Sequence[str], trial_time_s: float) -> list[float]:
    """Return the values of the objectives, means over tracks; all but the race score of the usual conditions.

    A policy without a complete lap gets more seconds than `trial_time_s`, the longest that a trial of the evaluation
    may take, and more the less of the lap it drives, because samplers need a number for it as well. Its zig-zag counts
    as more than that of any lap for the same reason: a car that does not drive does not swerve.
    """
    from deepracer_exp.evaluation.results import USUAL

    usual = evaluation.on(USUAL)
    fallback = without_lap(usual.completion, trial_time_s)
    values = {
        "race_score": evaluation.race_score_s,
        "lap_time": evaluation.lap_time_s,
        "completion": usual.completion,
        "zigzag": counted_zigzag(
            usual.zigzag.changes_per_m, usual.completion, usual.mean_lap_time_s is not None
        ),
    }
    return [fallback if values[name] is None else float(values[name] or 0.0) for name in objectives]


def without_lap(completion: float, trial_time_s: float) -> float:
    """Return seconds for a policy that completes no lap, from one to two times `trial_time_s`.

    `completion` is the mean share of the lap that it drives, per cent.
    """
    return trial_time_s * (2 - min(completion, 100.0) / 100)


def counted_zigzag(changes_per_m: float | None, completion: float, has_lap: bool) -> float:
    """Return the zig-zag for a sweep: without a complete lap or a straight, a value above that of any lap."""
    if has_lap and changes_per_m is not None:
        return changes_per_m
    return without_lap(completion, _MOST_CHANGES_PER_M)


def intermediate_value(row: Mapping[str, Any], objective: str, trial_time_s: float) -> float | None:
    """Return the value of an evaluation during training; None if this row of metrics.jsonl has none."""
    completion = row.get("eval_completion")
    value = row.get({"race_score": "eval_race_score_s", "lap_time": "eval_lap_time_s"}.get(objective, ""))
    if completion is None:
        return None
    if objective == "zigzag":
        return counted_zigzag(
            row.get("eval_zigzag_per_m"), completion, row.get("eval_lap_time_s") is not None
        )
    if objective == "completion":
        return float(completion)
    return without_lap(completion, trial_time_s) if value is None else float(value)


def score_text(objective: str, value: float) -> str:
    """Return a value with its unit: ``9.84 s``, ``97.3%``."""
    digits = 2 if MEASURES[objective].minimize else 1
    return with_unit(f"{value:.{digits}f}", MEASURES[objective].unit)


def shown_or_dash(objective: str, value: float | None) -> str:
    """Return a value for a table: with its unit, or a dash."""
    return NONE if value is None else score_text(objective, value)


def shown_values(objectives: Sequence[str], values: Sequence[float], has_held_out: bool) -> str:
    """Return all values of a trial: ``lap time 9.84 s, completion 97.3%``; `has_held_out`: it drove held-out laps."""
    pairs = zip(objectives, values, strict=True)
    return ", ".join(
        f"{of_conditions(MEASURES[name].words, has_held_out)} {score_text(name, value)}"
        for name, value in pairs
    )
