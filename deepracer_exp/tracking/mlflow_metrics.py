"""Metrics of a run: their names and points in MLflow."""

import math
import re
import time
from collections.abc import Mapping, Sequence
from typing import Any

METRICS: Mapping[str, tuple[str, str]] = {
    "eval_race_score_s": (
        "race/score_s",
        "seconds per complete lap on usual and held-out conditions together, failed laps included",
    ),
    "eval_lap_time_s": ("race/lap_time_s", "mean time of the evaluation's complete laps on usual conditions"),
    "eval_completion": ("race/completion", "mean progress of its laps on usual conditions in per cent"),
    "held_out_completion": ("race/held_out_completion", "the same on held-out conditions"),
    "eval_lap_share": (
        "race/lap_share",
        "share of its laps on usual conditions that were completed (0 to 1)",
    ),
    "eval_laps": ("race/laps", "number of these"),
    "eval_laps_tried": ("race/laps_tried", "number of laps tried on usual conditions"),
    "eval_crash_free": (
        "race/crash_free",
        "share of its laps on usual conditions that were completed without running into a box or bot (0 to 1)",
    ),
    "eval_won": (
        "race/won",
        "share of its races on usual conditions that were won, a draw counting half (0 to 1)",
    ),
    "eval_zigzag_per_m": (
        "race/zigzag_per_m",
        "changes of steering from one side to the other a metre of straight, usual conditions",
    ),
    "eval_zigzag_deg": ("race/zigzag_deg", "mean angle to either side in these changes"),
    "eval_zigzag_lost_s": ("race/zigzag_lost_s", "seconds a lap that the detour of the zig-zag takes"),
    "completion": ("train/completion", "mean progress of finished episodes in per cent"),
    "lap_share": (
        "train/lap_share",
        "share of recent episodes with a lap (0 to 1), the lowest of all tracks",
    ),
    "best_lap_time_s": ("train/best_lap_time_s", "fastest exploring lap so far on usual conditions"),
    "mean_lap_time_s": ("train/mean_lap_time_s", "mean time of the iteration's exploring laps"),
    "laps": ("train/laps", "exploring laps completed so far"),
    "mean_return": ("train/mean_return", "mean sum of rewards of finished episodes"),
    "episodes": ("train/episodes", "episodes finished so far"),
    "iteration": ("train/iteration", "training iteration"),
    "entropy": ("update/entropy", "entropy of the policy"),
    "kl": ("update/kl", "KL divergence between the policies before and after the iteration"),
    "policy_loss": ("update/policy_loss", "loss of the policy, clipped with PPO"),
    "value_loss": ("update/value_loss", "loss of the value network, with SAC of the critics"),
    "alpha": ("update/alpha", "temperature of SAC: weight of the entropy"),
    "target_entropy": ("update/target_entropy", "entropy to which SAC's temperature leads"),
    "q_value": ("update/q_value", "what SAC's critics expect of the policy's actions"),
    "replay_steps": ("update/replay_steps", "steps that SAC learns from"),
    "gradient_steps": ("update/gradient_steps", "gradient steps of SAC in this iteration"),
    "lr": ("update/lr", "learning rate"),
    "clip_fraction": ("update/clip_fraction", "share of samples whose policy ratio was clipped"),
    "explained_variance": (
        "update/explained_variance",
        "share of the returns' variance that the critic explains",
    ),
    "grad_norm": ("update/grad_norm", "norm of the gradient before clipping"),
    "env_steps_per_s": ("time/env_steps_per_s", "control steps per second of wall time"),
    "collect_s": ("time/collect_s", "seconds of collection in this iteration"),
    "update_s": ("time/update_s", "seconds of updates in this iteration"),
    "wall_clock_s": ("time/wall_clock_s", "seconds since the first step"),
    "cpu_percent": (
        "system/cpu_utilization_percentage",
        "use of all cores of the machine since the last row",
    ),
    "memory_mb": ("system/system_memory_usage_megabytes", "memory of the machine in use"),
    "memory_percent": ("system/system_memory_usage_percentage", "the same, of all it has"),
    "gpu_memory_mb": ("system/gpu_0_memory_usage_megabytes", "memory of the GPU in use, with device=cuda"),
}
"""Columns of metrics.jsonl: their names in MLflow and their meaning; recorded against env steps.

MLflow's pages group metrics by what precedes the last slash and sort the groups by name: race, time, train, update.
Within `race` the order of recording matters: the comparison of runs opens with the first metric.
"""

MACHINE = "system/"
"""Prefix of the machine's load: recorded beside the rows, not part of the run's record."""

BEST = "race/best/"
"""Prefix of the evaluation of the best checkpoint, recorded when the run ends."""

TRACK_METRICS = ("completion", "lap_share", "best_lap_time_s", "mean_lap_time_s")
"""Metrics recorded per track in a run on several tracks: column `completion/Oval_track`, in MLflow
`train/completion/Oval_track`, so that all tracks are in one group."""


def metric_names(row: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return a row of metrics.jsonl by MLflow's names, in the order of METRICS.

    Columns unknown to METRICS are called `train/COLUMN` and come last.
    """
    rank = {column: place for place, column in enumerate(METRICS)}
    named = sorted(row.items(), key=lambda item: rank.get(item[0].partition("/")[0], len(rank)))
    return {metric_name(column): value for column, value in named}


def best_metrics(summary: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the evaluation of a run's best checkpoint, from its summary, as metrics of the run."""
    best = summary.get("best") or {}
    return {
        BEST + METRICS[column][0].removeprefix("race/"): value
        for column, value in best.items()
        if column in METRICS and METRICS[column][0].startswith("race/")
    }


def without_evaluation(row: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return a row of metrics.jsonl without the columns of an evaluation."""
    return {key: value for key, value in row.items() if not metric_name(key).startswith("race/")}


def evaluate_metric(column: str, track: str | None) -> str:
    """Return MLflow's name of a result of `deepracer-exp evaluate`, on one of several tracks or on all.

    `column` is that of the same result in metrics.jsonl.
    """
    name = f"race/evaluate/{METRICS[column][0].removeprefix('race/')}"
    return name if track is None else f"{name}/{track}"


def metric_name(column: str) -> str:
    """Return MLflow's name of a column of metrics.jsonl."""
    name, slash, track = column.partition("/")
    return (METRICS[name][0] if name in METRICS else f"train/{name}") + slash + track


_LONGEST_LABEL = 80  # MLflow takes 250 characters, older servers fewer; the UI shows about 40


def trial_metrics(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return the values of a trial's best checkpoint by metric; a training has no metrics of these names."""
    return {trial_metric(name): value for name, value in values.items()}


def trial_metric(objective: str) -> str:
    """Return the metric of a study's objective."""
    unit = {"completion": "", "zigzag": "_per_m"}.get(objective, "_s")
    return f"trial/{objective}{unit}"


def track_labels(names: Sequence[str]) -> list[str]:
    """Return unique labels of tracks that MLflow accepts as part of a metric's name.

    Letters, digits, `_`, `-` and `.` are kept, anything else becomes `_`. Labels differ by more than case, because
    some databases compare names without it.
    """
    plain = [re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:_LONGEST_LABEL] for name in names]
    # A path component of dots alone would point elsewhere.
    plain = [label if label.strip(".") else f"track_{label}" for label in plain]
    taken = {label.casefold() for label in plain}
    labels: list[str] = []
    used: set[str] = set()
    for label in plain:
        chosen, number = label, 1
        while chosen.casefold() in used or (number > 1 and chosen.casefold() in taken):
            number += 1
            chosen = f"{label}-{number}"
        used.add(chosen.casefold())
        labels.append(chosen)
    return labels


Point = tuple[str, float, int, int]
"""Key, value, time in ms, step."""


def now_ms() -> int:
    """Return the time in ms since 1970."""
    return time.time_ns() // 1_000_000


def points_of(row: Mapping[str, float | None], step: int, start_ms: int) -> tuple[Point, ...]:
    """Return the points of a row of metrics.jsonl, without None, NaN and infinite values.

    A point's time is the run's start plus the row's `wall_clock_s`, so that a row recorded again, even by another
    process, is the same point, which MLflow keeps once. A row without that column gets the current time.
    """
    clock_s = row.get("wall_clock_s")
    time_ms = now_ms() if clock_s is None else start_ms + round(1000 * clock_s)
    return points_at(recordable_values(row), step, time_ms)


def recordable_values(row: Mapping[str, float | None]) -> dict[str, float]:
    """Return the values of a row of metrics.jsonl by MLflow's names, without None, NaN and infinite values."""
    named = metric_names({key: value for key, value in row.items() if key != "env_steps"})
    return {key: value for key, value, *_ in points_at(named, 0, 0)}


def points_at(metrics: Mapping[str, float | None], step: int, time_ms: int) -> tuple[Point, ...]:
    """Return the points of metrics by MLflow's names, without None, NaN and infinite values."""
    return tuple(
        (key, float(value), time_ms, step)
        for key, value in metrics.items()
        if value is not None and math.isfinite(value)
    )
