"""The results of runs side by side."""

import json
from collections.abc import Sequence
from typing import Any

from deepracer_exp.config.stored import ABSENT as NOTHING
from deepracer_exp.runs.run_files import RunRecord
from deepracer_exp.runs.run_result import FIGURES, result_of


def value_text(value: Any, most: int = 48) -> str:
    """Return a value as YAML has it, shortened in its middle."""
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return shortened(text, most)


def last_value(record: RunRecord, column: str) -> float | None:
    """Return a metric of the last iteration; of lap times, with several tracks, the mean of theirs if each has one."""
    last = record.rows[-1]
    logged = [value for key, value in last.items() if key.startswith(f"{column}/")]
    if last.get(column) is not None or not logged:
        return last.get(column)
    return None if None in logged else sum(logged) / len(logged)


RESULTS: tuple[tuple[str, str, str, int], ...] = (
    ("end", "end", "{}", 0),
    ("control steps", "last env_steps", "{:,.0f}", 0),
    ("minutes", "minutes", "{:.1f}", 0),
    ("best checkpoint", "iteration", "{:d}", 0),
    *FIGURES,
    ("exploring laps", "last laps", "{:,.0f}", 1),
    ("exploring completion, %", "last completion", "{:.1f}", 1),
    ("exploring laps complete, %", "exploring laps_percent", "{:.0f}", 1),
    ("fastest exploring lap, s", "last best_lap_time_s", "{:.2f}", -1),
    ("mean exploring lap, s", "last mean_lap_time_s", "{:.2f}", -1),
    ("steps to the first lap", "first_lap", "{:,.0f}", -1),
    ("steps until reliable", "reliable", "{:,.0f}", -1),
    ("return", "last mean_return", "{:.1f}", 0),
    ("entropy, nats", "last entropy", "{:.2f}", 0),
)
"""The compared results: of the best checkpoint's evaluation, and of the last iteration of the training. Each has a
name, a key of `_values`, a format, and whether a higher value is better (1), a lower one (-1), or neither (0)."""


def _values(record: RunRecord) -> dict[str, Any]:
    """Return the results of a run by key; unknown ones are missing or None."""
    summary, result = record.summary, result_of(record.summary)
    columns = {key.partition("/")[0] for key in record.rows[-1]}
    last = {column: last_value(record, column) for column in columns}
    seconds, share = last.get("wall_clock_s"), last.get("lap_share")
    return {
        "end": summary.get("reason") or "running, or was killed",
        "minutes": None if seconds is None else seconds / 60,
        "exploring laps_percent": None if share is None else 100 * share,
        **{moment: (summary.get(moment) or {}).get("env_steps") for moment in ("first_lap", "reliable")},
        **(vars(result) if result is not None and result.evaluated else {}),
        **{f"last {column}": value for column, value in last.items()},
    }


def results(records: Sequence[RunRecord]) -> list[tuple[str, list[str], int | None]]:
    """Return the results of the runs: name, a text for each run, and the number of the best one if there is one.

    Results that no run has are left out.
    """
    lines, found_of = [], [_values(record) for record in records]
    for name, key, form, better in RESULTS:
        values = [result.get(key) for result in found_of]
        if all(value is None for value in values):
            continue
        measured = [value for value in values if value is not None]
        best = None
        if better and len(measured) > 1 and min(measured) != max(measured):
            best = values.index(max(measured) if better > 0 else min(measured))
        lines.append((name, [NOTHING if value is None else form.format(value) for value in values], best))
    return lines


def shortened(text: str, most: int) -> str:
    """Shorten a text to a number of letters, at least 16, by leaving out its middle."""
    return text if len(text) <= most else f"{text[: most - 15]} … {text[-12:]}"
