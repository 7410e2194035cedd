"""How good a run's best checkpoint is, as its summary tells."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepracer_exp.errors import BadInput

from .run_files import read_object

IN_TRAINING = "training"


@dataclass(frozen=True)
class RunResult:
    """What a run came to."""

    measure: str
    """What its evaluations were ranked by; IN_TRAINING: it had none, and its training's episodes are told."""
    rank: tuple[float, float]
    """Compared in order, higher is better; only with runs of the same measure, course and conditions."""
    completion: float | None
    """Per cent of the lap."""
    lap_time_s: float | None
    """Mean of the evaluated complete laps, or the fastest of the training."""

    @property
    def evaluated(self) -> bool:
        """Whether it is that of an evaluation."""
        return self.measure != IN_TRAINING


def read_result(run: Path) -> RunResult | None:
    """Return what a run came to, None if that is not known.

    Raises:
        BadInput: its summary.json is not what a training writes.
    """
    file = run / "summary.json"
    summary = read_object(file)
    try:
        return _result_of(summary)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise BadInput(f"{file}: is not what a training writes: {error!r}") from error


def _result_of(summary: Mapping[str, Any]) -> RunResult | None:
    best = summary.get("best")
    if best is not None:
        first, second = best["rank"]
        return RunResult(
            str(best["metric"]),
            (float(first), float(second)),
            _number(best["eval_completion"]),
            _number(best["eval_lap_time_s"]),
        )
    lap_share, lap_s = _number(summary.get("lap_share")), _number(summary.get("best_lap_time_s"))
    if lap_share is None and lap_s is None:
        return None
    rank = (lap_share or 0.0, -math.inf if lap_s is None else -lap_s)
    return RunResult(IN_TRAINING, rank, _number((summary.get("last") or {}).get("completion")), lap_s)


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
