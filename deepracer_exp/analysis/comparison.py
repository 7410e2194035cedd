"""Runs side by side: in what their configurations differ, and what came of them."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from deepracer_exp.config import stored
from deepracer_exp.formats.run_files import RunRecord
from deepracer_exp.formats.run_result import FIGURES, result_of

NOTHING = stored.ABSENT
_NO_MATTER = ("runs_dir", "debug", "report", "tracking")  # whatever they are, the car drives the same


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
"""What is compared: the best checkpoint as its evaluation found it, and of the training the last iteration, as in its
view and in summary.json. Of each: name, value, format, and whether a higher value is better (1), a lower one (-1), or
neither."""


def results(records: Sequence[RunRecord]) -> list[tuple[str, list[str], int | None]]:
    """Return what came of the runs: name, a text a run, and the number of the best one if there is one.

    What no run has is left out.
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
