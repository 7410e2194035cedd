"""The result of a run from its summary: its ending, and the figures of its best checkpoint."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from deepracer_exp.errors import BadInput

from .run_files import SUMMARY, read_object

FINISHED, STOPPED_EARLY, INTERRUPTED, FAILED = "finished", "stopped early", "interrupted", "failed"
"""`status` of a run that has ended, as in summary.json."""
IN_TRAINING = "training"
RELIABLE = 0.95
"""Share of complete laps on usual conditions from which on a policy counts as reliable."""
BOTH = "race score (usual and held-out)"
"""Name of the race score of an evaluation under both conditions."""
CRITERIA = {
    "race_score": BOTH,
    "reliable_lap": "reliable lap (usual)",
    "lap_time": "mean lap (usual and held-out)",
    "progress": "completion (usual and held-out)",
    IN_TRAINING: "exploring laps",
}
"""Names of the measures; the best of several policies or runs is the one with the highest rank by it."""
TRAINING_LAPS, SWEEP_LAPS, FRESH_LAPS = "the training's evaluations", "the sweep's laps", "fresh laps"
"""Names of the laps that a score may be of: a trial of a sweep has scores of all three."""
FIGURES: tuple[tuple[str, str, str, int], ...] = (
    ("mean usual lap, s", "lap_time_s", "{:.2f}", -1),
    ("usual laps complete, %", "laps_percent", "{:.0f}", 1),
    ("usual completion, %", "completion", "{:.1f}", 1),
    ("held-out completion, %", "held_out_completion", "{:.1f}", 1),
    (f"{BOTH}, s", "race_score_s", "{:.2f}", -1),
)
"""Figures of an evaluated policy wherever they are shown: name and unit, attribute of RunResult, format, and whether a
higher value is better (1) or a lower one (-1)."""


def of_conditions(name: str, has_held_out: bool) -> str:
    """Return the name of a measure of both conditions, shortened to the usual ones if no held-out laps were driven."""
    return name if has_held_out else name.replace("(usual and held-out)", "(usual)")


def with_unit(number: str, unit: str) -> str:
    """Return a number and its unit as English writes them: ``8.02 s``, ``97.3%``."""
    return f"{number}%" if unit == "%" else f"{number} {unit}"


@dataclass(frozen=True)
class Ending:
    """The ending of a run; its fields are keys of summary.json."""

    status: str
    """FINISHED, STOPPED_EARLY (more training would not have helped), INTERRUPTED or FAILED."""
    reason: str
    """A sentence on why it ended."""
    rule: str | None = None
    """Name of the stopping rule or the pruner that ended it; None: something else did."""
    limit: str | None = None
    """Key of the budget that was used up; None: something else ended it."""

    @classmethod
    def by_rule(cls, rule: str, why: str, status: str) -> Self:
        """Return the ending by a stopping rule or a pruner, for a reason in words."""
        return cls(status, f"{rule.replace('_', ' ')}: {why}", rule=rule)

    @classmethod
    def by_budget(cls, limit: str) -> Self:
        """Return the ending of a run that has used up its budget."""
        return cls(FINISHED, f"budget reached: {limit}", limit=limit)

    @classmethod
    def stored(cls, summary: Mapping[str, Any]) -> Self | None:
        """Return the ending in a run's summary, None where the run has not ended."""
        status, reason = summary.get("status"), str(summary.get("reason"))
        return None if status is None else cls(status, reason, summary.get("rule"), summary.get("limit"))

    def __str__(self) -> str:
        """Return the ending in words: ``finished: budget reached: env_steps``."""
        return f"{self.status}: {self.reason}"


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """The figures of a run's best policy."""

    measure: str
    """The measure by which its evaluations were ranked, a key of CRITERIA; IN_TRAINING if it had none, and its
    training's episodes count."""
    rank: tuple[float, float]
    """Numbers compared in order, higher is better; only with runs of the same measure, course and conditions."""
    iteration: int | None = None
    """Iteration after which the policy was evaluated, the number of its checkpoint; None without an evaluation."""
    race_score_s: float | None = None
    """Seconds per complete lap on usual and held-out conditions, failed laps included."""
    laps_percent: float | None = None
    """Complete laps of a hundred tried on the usual conditions."""
    completion: float | None
    """Completion in per cent of the lap, mean over the laps tried on the usual conditions."""
    held_out_completion: float | None = None
    """Completion in per cent on the held-out conditions."""
    lap_time_s: float | None
    """Mean of the evaluated complete laps on the usual conditions, or the fastest exploring lap."""

    @property
    def evaluated(self) -> bool:
        """Whether it is that of an evaluation."""
        return self.measure != IN_TRAINING

    @property
    def criterion(self) -> str:
        """Return the criterion of its rank in words."""
        return of_conditions(CRITERIA.get(self.measure, self.measure), self.held_out_completion is not None)

    def words(self) -> str:
        """Return the known figures: ``mean usual lap 7.97 s, usual laps complete 100%``."""
        if not self.evaluated:
            figures = [
                ("exploring completion, %", self.completion, "{:.0f}"),
                ("fastest exploring lap, s", self.lap_time_s, "{:.2f}"),
            ]
        else:
            # Where all laps are complete, so is each of them.
            all_complete = self.laps_percent == 100
            figures = [
                (self.figure(name), getattr(self, key), "{:.0f}" if name.endswith("%") else form)
                for name, key, form, _ in FIGURES
                if not (all_complete and key == "completion")
            ]
        parts = [
            (*name.split(", "), form.format(value)) for name, value, form in figures if value is not None
        ]
        text = ", ".join(f"{name} {with_unit(value, unit)}" for name, unit, value in parts)
        if self.lap_time_s is None:
            text += ", no complete lap"
        return text

    def figure(self, name: str) -> str:
        """Return the name of one of FIGURES; without held-out conditions, the race score is that of the usual ones."""
        return of_conditions(name, self.held_out_completion is not None)


@dataclass(frozen=True, kw_only=True)
class ReliableLap:
    """The lap of the fastest reliable policy among a run's evaluated ones."""

    iteration: int
    """Iteration after which the policy was evaluated, the number of its checkpoint."""
    lap_time_s: float
    """Mean of the complete laps on the usual conditions, over all tracks together."""
    laps: int
    """Complete laps on the usual conditions."""
    laps_tried: int
    """Laps tried on the usual conditions."""

    def __str__(self) -> str:
        """Return the lap in words: ``checkpoint 40, 6.72 s, 8 of 8``."""
        return f"checkpoint {self.iteration}, {self.lap_time_s:.2f} s, {self.laps} of {self.laps_tried}"


def fastest_reliable(rows: Iterable[Mapping[str, Any]]) -> ReliableLap | None:
    """Return the fastest lap among evaluated policies that completed `RELIABLE` of their usual laps, None without.

    The rows are those of metrics.jsonl.
    """
    reliable = [row for row in rows if reliable_lap_s(row) is not None]
    if not reliable:
        return None
    best = min(reliable, key=lambda row: row["eval_lap_time_s"])
    return ReliableLap(
        iteration=best["iteration"],
        lap_time_s=best["eval_lap_time_s"],
        laps=best["eval_laps"],
        laps_tried=best["eval_laps_tried"],
    )


def why_not_fastest(result: RunResult, rows: Iterable[Mapping[str, Any]]) -> str | None:
    """Return why the best checkpoint is not the one with the fastest reliable lap; None if it is."""
    by_iteration = {row["iteration"]: row for row in rows}
    lap = fastest_reliable(by_iteration.values())
    if lap is None or result.iteration in (None, lap.iteration):
        return None
    fast = f"checkpoint {lap.iteration}"
    score_s = by_iteration[lap.iteration].get("eval_race_score_s")
    if result.measure != "race_score" or result.race_score_s is None:
        return f"checkpoint {result.iteration} ranks above {fast}, which laps faster, by {result.criterion}"
    score = result.figure(BOTH)
    if score_s is None:
        return f"{fast} laps faster, but it has no {score}"
    return f"{fast} laps faster, but its {score} is {score_s:.2f} s"


def reliable_lap_s(row: Mapping[str, Any]) -> float | None:
    """Return the mean lap time of a row's evaluation, None if it has none or completed too few of its usual laps."""
    share, lap_time_s = row.get("eval_lap_share"), row.get("eval_lap_time_s")
    return None if share is None or share < RELIABLE else lap_time_s


def read_result(run: Path) -> RunResult | None:
    """Return the result of a run, None if it is not known.

    Raises:
        BadInput: its summary.json is not what a training writes.
    """
    file = run / SUMMARY
    summary = read_object(file)
    try:
        return result_of(summary)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise BadInput(file, f"is not what a training writes: {error!r}") from error


def result_of(summary: Mapping[str, Any]) -> RunResult | None:
    """Return the result of a run from its summary, None if it is not known."""
    best = summary.get("best")
    if best is not None and best["eval_completion"] is not None:
        first, second = best["rank"]
        share = _number(best.get("eval_lap_share"))
        return RunResult(
            measure=str(best["metric"]),
            rank=(float(first), float(second)),
            iteration=int(best["iteration"]),
            race_score_s=_number(best.get("eval_race_score_s")),
            laps_percent=None if share is None else 100 * share,
            completion=_number(best["eval_completion"]),
            held_out_completion=_number(best.get("held_out_completion")),
            lap_time_s=_number(best["eval_lap_time_s"]),
        )
    lap_share, lap_s = _number(summary.get("lap_share")), _number(summary.get("best_lap_time_s"))
    if lap_share is None and lap_s is None:
        return None
    rank = (lap_share or 0.0, -math.inf if lap_s is None else -lap_s)
    completion = _number((summary.get("last") or {}).get("completion"))
    return RunResult(measure=IN_TRAINING, rank=rank, completion=completion, lap_time_s=lap_s)


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
