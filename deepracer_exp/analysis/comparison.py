"""The results of runs side by side."""

import json
from collections.abc import Callable, Sequence
from typing import Any

from deepracer_exp.config.stored import ABSENT as NOTHING
from deepracer_exp.runs.files import RunRecord
from deepracer_exp.runs.result import FIGURES, result_of


def value_text(value: Any, most: int = 48) -> str:
    """Return a value as YAML has it, shortened in its middle."""
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= most else f"{text[: most - 15]} … {text[-12:]}"


def last_value(record: RunRecord, column: str) -> float | None:
    """Return a metric of the last iteration; of lap times, with several tracks, the mean of theirs if each has one."""
    last = record.rows[-1]
    known = [value for key, value in last.items() if key.startswith(f"{column}/")]
    if last.get(column) is not None or not known:
        return last.get(column)
    return None if None in known else sum(known) / len(known)


Result = tuple[str, Callable[[RunRecord], Any], str, int]


def _moment(name: str) -> Callable[[RunRecord], Any]:
    return lambda record: (record.summary.get(name) or {}).get("env_steps")


def _last(name: str) -> Callable[[RunRecord], Any]:
    return lambda record: last_value(record, name)


def _best(name: str) -> Callable[[RunRecord], Any]:
    def of(record: RunRecord) -> Any:
        result = result_of(record.summary)
        return getattr(result, name) if result is not None and result.evaluated else None

    return of


def _times(factor: float, value: Callable[[RunRecord], Any]) -> Callable[[RunRecord], Any]:
    def scaled(record: RunRecord) -> Any:
        found = value(record)
        return None if found is None else factor * found

    return scaled


RESULTS: tuple[Result, ...] = (
    ("end", lambda record: record.summary.get("reason") or "running, or was killed", "{}", 0),
    ("control steps", _last("env_steps"), "{:,.0f}", 0),
    ("minutes", _times(1 / 60, _last("wall_clock_s")), "{:.1f}", 0),
    ("cost", lambda record: record.summary.get("cost"), "{:.2f}", 0),
    ("best checkpoint", _best("iteration"), "{:06d}", 0),
    *((name, _best(key), form, better) for name, key, form, better in FIGURES),
    ("laps in training", _last("laps"), "{:,.0f}", 1),
    ("completion in training, %", _last("completion"), "{:.1f}", 1),
    ("complete laps in training, %", _times(100, _last("lap_share")), "{:.0f}", 1),
    ("best lap in training, s", _last("best_lap_time_s"), "{:.2f}", -1),
    ("mean lap in training, s", _last("mean_lap_time_s"), "{:.2f}", -1),
    ("steps to the first lap", _moment("first_lap"), "{:,.0f}", -1),
    ("steps until reliable", _moment("reliable"), "{:,.0f}", -1),
    ("return", _last("mean_return"), "{:.1f}", 0),
    ("entropy, nats", _last("entropy"), "{:.2f}", 0),
)
"""The results that are compared: of the evaluation of the best checkpoint, and of the last iteration of the training.
Each has a name, a value, a format, and whether a higher value is better (1), a lower one (-1), or neither (0)."""


def results(records: Sequence[RunRecord]) -> list[tuple[str, list[str], int | None]]:
    """Return the results of the runs: name, a text for each run, and the number of the best one if there is one.

    Results that no run has are left out.
    """
    lines = []
    for name, value, form, better in RESULTS:
        values = [value(record) for record in records]
        if all(found is None for found in values):
            continue
        known = [found for found in values if found is not None]
        best = None
        if better and len(known) > 1 and min(known) != max(known):
            best = values.index(max(known) if better > 0 else min(known))
        lines.append((name, [NOTHING if found is None else form.format(found) for found in values], best))
    return lines
