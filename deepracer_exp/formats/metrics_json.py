"""Metrics files of the service: what each episode came to."""

import json
import math
from dataclasses import dataclass, field
from typing import IO, Any

from .log_blocks import READ_ERRORS

_MOST_BYTES = 2**26
_LARGEST = 2**31 - 1


@dataclass
class MetricsJson:
    """The episodes of one file."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    """Keys `episode` (from 0), `trial`, `phase`, `reward`, `completion`, `time_s`, `episode_status`, `resets`."""
    refused: list[str] = field(default_factory=list)


def read_metrics_json(stream: IO[bytes]) -> MetricsJson:
    """Read the metrics of a training or of an evaluation.

    Raises:
        ValueError: it holds no list of metrics, or cannot be read; one line says why.
    """
    try:
        raw = stream.read(_MOST_BYTES + 1)
    except READ_ERRORS as error:
        raise ValueError(f"cannot be read ({' '.join(str(error).split())})") from error
    if len(raw) > _MOST_BYTES:
        raise ValueError(f"larger than {_MOST_BYTES // 2**20} MiB")
    try:
        data = json.loads(raw.decode("utf-8-sig", "replace"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON ({' '.join(str(error).split())})") from error
    items = data.get("metrics") if isinstance(data, dict) else None
    if not isinstance(items, list):
        raise ValueError('no metrics; accepted: {"metrics": [...]}')
    metrics = MetricsJson()
    for number, item in enumerate(items):
        try:
            metrics.rows.append(_row(number, item))
        except (ValueError, TypeError, KeyError, OverflowError, AttributeError) as error:
            metrics.refused.append(
                f"metrics[{number}] is no episode ({type(error).__name__}: {' '.join(str(error).split())})"
            )
    return metrics


def _row(number: int, item: dict[str, Any]) -> dict[str, Any]:
    trial = _whole(item.get("trial", number + 1))
    return {
        "episode": _whole(item["episode"] - 1 if "episode" in item else trial - 1),
        "trial": trial,
        "phase": "training" if str(item.get("phase", "evaluation")) == "training" else "evaluation",
        "reward": float(item.get("reward_score", math.nan)),
        "completion": float(item["completion_percentage"]),
        "time_s": float(item["elapsed_time_in_milliseconds"]) / 1000.0,
        "episode_status": str(item.get("episode_status", "")).strip().lower().replace(" ", "_"),
        "resets": float(item.get("reset_count", math.nan)),
    }


def _whole(value: float) -> int:
    whole = int(value)
    if not 0 <= whole <= _LARGEST:
        raise ValueError(f"{whole} is no count")
    return whole
