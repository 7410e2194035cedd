"""Runs side by side: in what their configurations differ, and what came of them."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from deepracer_exp.config import stored
from deepracer_exp.formats.run_files import RunRecord

NOTHING = stored.ABSENT
_NO_MATTER = ("runs_dir", "debug", "report", "tracking")  # whatever they are, the car drives the same
LAST = 10
"""Iterations at the end of a run over which its figures are averaged: single ones wobble."""


def differences(records: Sequence[RunRecord]) -> dict[str, list[Any]]:
    """Return the values in which the runs differ, by dotted key; NOTHING where a run has no such key.

    The reward's text and the code are compared as well, by their hashes.
    """
    configs = [
        {key: value for key, value in record.config.items() if key not in _NO_MATTER} for record in records
    ]
    courses = [course_names(config.get("track")) for config in configs]
    if len(set(courses)) > 1:  # the points of a track say less than its name
        for config, course in zip(configs, courses, strict=True):
            config["track"] = course
    for config, record in zip(configs, records, strict=True):
        sha256 = record.provenance.get("reward", {}).get("sha256")
        config["reward_function.py"] = NOTHING if sha256 is None else f"sha256 {sha256[:8]}"
        config["code"] = str(record.provenance.get("git_commit") or NOTHING)[:16]
    return stored.differences(configs)


def course_names(track: Any) -> str:
    """Return the name of the track of a configuration, or those of several."""
    known = isinstance(track, Mapping)
    return str(track["name"]) if known and "name" in track else ", ".join(track) if known else NOTHING


def value_text(value: Any, most: int = 48) -> str:
    """Return a value as YAML has it, shortened in its middle."""
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= most else f"{text[: most - 15]} … {text[-12:]}"


def final_mean(record: RunRecord, column: str) -> float | None:
    """Return the mean of a metric over the run's last iterations; with several tracks the mean of theirs."""
    rows = record.rows
    columns = [key for key in rows[-1] if key.startswith(f"{column}/")] or [column]
    known = [[row[key] for row in rows[-LAST:] if row.get(key) is not None] for key in columns]
    return sum(sum(values) / len(values) for values in known) / len(known) if all(known) else None


def best_lap_s(record: RunRecord) -> float | None:
    """Return the fastest lap of the training; with several tracks the mean of theirs, None while one has none."""
    last = record.rows[-1]
    times = [value for key, value in last.items() if key.startswith("best_lap_time_s/")]
    times = times or [last["best_lap_time_s"]]
    return None if None in times else sum(times) / len(times)


Result = tuple[str, Callable[[RunRecord], Any], str, int]


def _moment(name: str) -> Callable[[RunRecord], Any]:
    return lambda record: (record.summary.get(name) or {}).get("env_steps")


def _last(name: str) -> Callable[[RunRecord], Any]:
    return lambda record: record.rows[-1].get(name)


def _times(factor: float, value: Callable[[RunRecord], Any]) -> Callable[[RunRecord], Any]:
    def scaled(record: RunRecord) -> Any:
        found = value(record)
        return None if found is None else factor * found

    return scaled


RESULTS: tuple[Result, ...] = (
    ("end", lambda record: record.summary.get("reason") or "goes on, or was killed", "{}", 0),
    ("control steps", _last("env_steps"), "{:,.0f}", 0),
    ("minutes", _times(1 / 60, _last("wall_clock_s")), "{:.1f}", 0),
    ("cost", lambda record: record.summary.get("cost"), "{:.2f}", 0),
    ("laps", _last("laps"), "{:,.0f}", 1),
    ("completion, %", lambda record: final_mean(record, "completion"), "{:.1f}", 1),
    ("complete laps, %", _times(100, _last("lap_share")), "{:.0f}", 1),
    ("best lap, s", best_lap_s, "{:.2f}", -1),
    ("mean lap, s", lambda record: final_mean(record, "mean_lap_time_s"), "{:.2f}", -1),
    ("evaluated completion, %", _last("eval_completion"), "{:.1f}", 1),
    ("held-out completion, %", _last("held_out_completion"), "{:.1f}", 1),
    ("evaluated lap, s", _last("eval_lap_time_s"), "{:.2f}", -1),
    ("steps to the first lap", _moment("first_lap"), "{:,.0f}", -1),
    ("steps until reliable", _moment("reliable"), "{:,.0f}", -1),
    ("mean return", lambda record: final_mean(record, "mean_return"), "{:.1f}", 0),
    ("entropy, nats", lambda record: final_mean(record, "entropy"), "{:.2f}", 0),
)
"""What is compared: name, value, format, and whether a higher value is better (1), a lower one (-1), or neither."""


def results(records: Sequence[RunRecord]) -> list[tuple[str, list[str], int | None]]:
    """Return what came of the runs: name, a text a run, and the number of the best one if there is one.

    What no run has is left out. Completion, lap times, return and entropy are means over the last iterations.
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
